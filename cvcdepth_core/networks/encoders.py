# SPDX-License-Identifier: Apache-2.0
"""The encoders that the depth and the pose network can be built on, by name."""

from __future__ import annotations

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.model_choices import ENCODERS
from cvcdepth_core.networks.efficientnet_lite import EfficientNetLite0Encoder
from cvcdepth_core.networks.resnet import RESNET_BLOCKS, ResNetEncoder

Encoder = ResNetEncoder | EfficientNetLite0Encoder
"""Takes images in [0, 1] to feature maps at H/2 ... H/32, finest first, with the widths `channels`."""


def build_encoder(name: str, in_channels: int = 3) -> Encoder:
    """Return an encoder with random weights; ConfigError names the known ones when `name` is not among them."""
    if name in RESNET_BLOCKS:
        return ResNetEncoder(name, in_channels)
    if name == "efficientnet_lite0":
        return EfficientNetLite0Encoder(in_channels)
    raise ConfigError(f"encoder is {name!r}, expected one of {', '.join(ENCODERS)}")
