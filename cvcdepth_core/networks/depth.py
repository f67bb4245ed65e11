# SPDX-License-Identifier: Apache-2.0
"""The depth network: images to disparity, and disparity to metric depth (method section 3; Godard et al., 2019)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.errors import ImageError
from cvcdepth_core.networks.encoders import build_encoder
from cvcdepth_core.networks.rig_images import DepthNetwork, RigImages

INPUT_STRIDE = 32
"""Height and width of the network input must be multiples of this."""

MIN_INPUT_SIZE = 64
"""Least height and width: the mirrored border needs two pixels of the coarsest feature map."""


class DepthNet(DepthNetwork):
    """The published network: encoder and decoder with skip connections, every camera's image on its own."""

    independent: ClassVar[bool] = True
    engines: ClassVar[tuple[str, ...]] = (
        "ncnn",
        "openvino",
        "torch",
        "torch_compiled",
        "onnxruntime",
        "tensorrt",
        "torch_eager",
    )

    def __init__(self, encoder: str = "resnet18") -> None:
        super().__init__()
        self.depth_encoder = build_encoder(encoder)
        self.depth_decoder = DepthDecoder(self.depth_encoder.channels, self.depth_encoder.decoder_channels)

    def forward(self, rig: RigImages) -> Tensor:
        """Return the disparity [B, N, 1, H, W] in (0, 1); see `disparity` for what is refused."""
        disparity = self.disparity(rig.images.flatten(0, 1))
        return disparity.view(*rig.images.shape[:2], *disparity.shape[1:])

    def disparity(self, images: Tensor) -> Tensor:
        """Return the disparity [B, 1, H, W] in (0, 1) of single `images` [B, 3, H, W] in [0, 1].

        Raises ImageError when H or W is not a multiple of 32 or below 64.
        """
        refuse_input_size(*images.shape[-2:])
        disparity: Tensor = self.depth_decoder(self.depth_encoder(images))
        return disparity


def refuse_input_size(height: int, width: int) -> None:
    """Raise ImageError when one of them is not a multiple of 32 or below 64."""
    if height % INPUT_STRIDE or width % INPUT_STRIDE or min(height, width) < MIN_INPUT_SIZE:
        raise ImageError(
            f"depth network: input is {width}x{height} (width x height), both must be multiples of {INPUT_STRIDE} "
            f"and at least {MIN_INPUT_SIZE}"
        )


class DepthDecoder(nn.Module):
    """Five upsampling steps, each joined with the encoder's feature map of the same resolution."""

    def __init__(self, encoder_channels: Sequence[int], decoder_channels: Sequence[int]) -> None:
        """Take the widths at H/2 ... H/32 of the encoder and at H ... H/16 of this decoder."""
        super().__init__()
        in_channels = encoder_channels[-1]
        layers: list[nn.Module] = []
        for level in reversed(range(5)):
            out_channels = decoder_channels[level]
            skip_channels = encoder_channels[level - 1] if level > 0 else 0
            layers += [ConvELU(in_channels, out_channels), ConvELU(out_channels + skip_channels, out_channels)]
            in_channels = out_channels
        layers.append(ReflectConv(in_channels, 1))
        self.decoder = nn.ModuleList(layers)

    def forward(self, features: Sequence[Tensor]) -> Tensor:
        """Turn five feature maps, finest (H/2) first, into disparity [B, 1, H, W] in (0, 1)."""
        x = features[-1]
        for level in reversed(range(5)):
            before_upsampling, after_skip = self.decoder[8 - 2 * level], self.decoder[9 - 2 * level]
            x = F.interpolate(before_upsampling(x), scale_factor=2.0, mode="nearest")
            if level > 0:
                x = torch.cat([x, features[level - 1]], dim=1)
            x = after_skip(x)
        return torch.sigmoid(self.decoder[-1](x))


class ReflectConv(nn.Module):
    """3x3 convolution over a border that repeats the image mirrored."""

    def __init__(self, in_channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(in_channels, out_channels, 3, stride, padding=1, padding_mode="reflect")

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, in, H, W] to [B, out, H / stride, W / stride]."""
        out: Tensor = self.conv(x)
        return out


class ConvELU(nn.Module):
    """A `ReflectConv` and an ELU."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv = ReflectConv(in_channels, out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, in, H, W] to [B, out, H, W]."""
        return F.elu(self.conv(x), inplace=True)


def disparity_to_depth(
    disparity: Tensor, fx: Tensor, min_depth: float, max_depth: float, focal_scale: float = 300.0
) -> Tensor:
    """Map `disparity` [..., 1, H, W] in (0, 1) to depth [..., 1, H, W] in metres along z (method section 3).

    `fx` [...] is each camera's focal length in pixels **at network resolution**. `min_depth` and `max_depth` are the
    metres at disparity 1 and 0 for a camera whose fx is `focal_scale` pixels; a longer lens reaches further, nothing
    is clipped.
    """
    inverse_depth = 1.0 / max_depth + (1.0 / min_depth - 1.0 / max_depth) * disparity
    return fx[..., None, None, None] / (focal_scale * inverse_depth)
