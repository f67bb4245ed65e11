# SPDX-License-Identifier: Apache-2.0
"""ResNet-18 and -34 encoders (He et al., 2016) with torchvision's parameter names, so that its weight files load."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the field's name for it

RESNET_BLOCKS: dict[str, tuple[int, int, int, int]] = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3)}
"""Residual blocks per stage."""

_IMAGE_MEAN, _IMAGE_STD = 0.45, 0.225


class BasicBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut; the first may halve the resolution."""

    def __init__(self, in_channels: int, out_channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, out_channels, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(out_channels)
        self.conv2 = nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(out_channels)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or in_channels != out_channels:
            self.downsample = nn.Sequential(
                nn.Conv2d(in_channels, out_channels, 1, stride, bias=False), nn.BatchNorm2d(out_channels)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, in, H, W] to [B, out, H/stride, W/stride]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)), inplace=True)
        return F.relu(self.bn2(self.conv2(x)) + shortcut, inplace=True)


class ResNetBody(nn.Module):
    """The convolutional part of torchvision's ResNet (no `fc`), returning the five feature maps."""

    def __init__(self, blocks: Sequence[int], in_channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = _stage(64, 64, blocks[0], stride=1)
        self.layer2 = _stage(64, 128, blocks[1], stride=2)
        self.layer3 = _stage(128, 256, blocks[2], stride=2)
        self.layer4 = _stage(256, 512, blocks[3], stride=2)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> list[Tensor]:
        """Map [B, C, H, W] to features at H/2, H/4, H/8, H/16 and H/32."""
        features = [F.relu(self.bn1(self.conv1(x)))]
        x = F.max_pool2d(features[0], kernel_size=3, stride=2, padding=1)
        for stage in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = stage(x)
            features.append(x)
        return features


def _stage(in_channels: int, out_channels: int, blocks: int, stride: int) -> nn.Sequential:
    first = BasicBlock(in_channels, out_channels, stride)
    return nn.Sequential(first, *(BasicBlock(out_channels, out_channels, 1) for _ in range(blocks - 1)))


class ResNetEncoder(nn.Module):
    """Encoder shared by the depth and the pose network (method sections 3 and 4).

    `channels` lists the width of each feature map, finest first; `decoder_channels` those of a depth decoder that
    suits it, at H ... H/16.
    """

    channels: tuple[int, ...] = (64, 64, 128, 256, 512)
    decoder_channels: tuple[int, ...] = (16, 32, 64, 128, 256)

    def __init__(self, name: str, in_channels: int = 3) -> None:
        super().__init__()
        self.encoder = ResNetBody(RESNET_BLOCKS[name], in_channels)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Return the features of `images` [B, C, H, W] in [0, 1], at H/2 ... H/32."""
        features: list[Tensor] = self.encoder((images - _IMAGE_MEAN) / _IMAGE_STD)
        return features

    @torch.no_grad()
    def adapt_imagenet_state(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Fit a torchvision classifier's state to this encoder: no `fc`, conv1 widened to the input channels.

        A six-channel input sees two images; conv1 is repeated and divided so that two equal images give the features of
        one. Files from before torch 0.4.1 have no `num_batches_tracked`, which ImageNet weights do not use.
        """
        adapted = {key: value for key, value in state.items() if not key.startswith("fc.")}
        for key, value in self.encoder.state_dict().items():
            if key.endswith("num_batches_tracked"):
                adapted.setdefault(key, torch.zeros_like(value))
        if "conv1.weight" in adapted:
            repeats = self.encoder.conv1.in_channels // 3
            adapted["conv1.weight"] = adapted["conv1.weight"].repeat(1, repeats, 1, 1) / repeats
        return adapted
