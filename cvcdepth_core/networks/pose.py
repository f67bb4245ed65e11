# SPDX-License-Identifier: Apache-2.0
"""The pose network: two images in temporal order to one small rigid motion (method section 4)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.networks.encoders import build_encoder

MAX_TRANSLATION = 4.0
"""Metres along each axis beyond which no motion is predicted."""

_OUTPUT_SCALE = 0.01


class PoseNet(nn.Module):
    """Encoder over image pairs, views fused by the mean of their features, one decoder.

    One view is the front camera's pose network; all views of the rig are the joint pose of SurroundDepth and VFDepth.
    """

    def __init__(self, encoder: str = "resnet18") -> None:
        super().__init__()
        self.pose_encoder = build_encoder(encoder, in_channels=6)
        self.pose_decoder = PoseDecoder(self.pose_encoder.channels[-1])

    def forward(self, earlier: Tensor, later: Tensor) -> tuple[Tensor, Tensor]:
        """Return axis-angle [B, 3] (rad) and translation [B, 3] (m) of the motion seen by V views.

        `earlier` and `later` are the two frames [B, V, 3, H, W] in [0, 1], always in temporal order.
        """
        pairs = torch.cat([earlier, later], dim=2)
        features: Tensor = self.pose_encoder(pairs.flatten(0, 1))[-1]
        fused = features.view(*pairs.shape[:2], *features.shape[1:]).mean(dim=1)
        vector: Tensor = self.pose_decoder(fused)
        return vector[:, :3], vector[:, 3:].clamp(-MAX_TRANSLATION, MAX_TRANSLATION)


class PoseDecoder(nn.Module):
    """Four convolutions and a mean over the image."""

    def __init__(self, in_channels: int, stride: int = 1) -> None:
        """`stride` is that of both 3x3 convolutions."""
        super().__init__()
        self.net = nn.ModuleList(
            [
                nn.Conv2d(in_channels, 256, 1),
                nn.Conv2d(256, 256, 3, stride, padding=1),
                nn.Conv2d(256, 256, 3, stride, padding=1),
                nn.Conv2d(256, 6, 1),
            ]
        )

    def forward(self, features: Tensor) -> Tensor:
        """Map [B, C, H, W] to the six numbers of a motion [B, 6]."""
        for convolution in self.net[:-1]:
            features = F.relu(convolution(features))
        vector: Tensor = self.net[-1](features).mean(dim=(2, 3))
        return _OUTPUT_SCALE * vector
