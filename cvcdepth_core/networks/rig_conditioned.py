# SPDX-License-Identifier: Apache-2.0
"""A depth network that is told its rig: where each pixel looks, how high its camera is, how far flat ground would be.

One picture does not tell its scale; the ground under a camera of known height does. What the calibration says about a
pixel enters the encoder's stem and every step of the decoder, and where the network finds flat ground, it passes the
ground's depth on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.networks.depth import ConvELU, ReflectConv, refuse_input_size
from cvcdepth_core.networks.efficientnet_lite import EfficientNetLite0Encoder, SameConv
from cvcdepth_core.networks.rig_images import ConditionedNetwork, DepthOutputs, RigImages

CHANNELS = 10
"""Of the conditioning, without the last one, the flat ground's inverse depth, which only the gate sees."""

_USUAL_HEIGHT = 1.6  # metres of a camera above the ground
_LEAST_HEIGHT = 0.2
_NEAREST_GROUND, _FARTHEST_GROUND = 1 / 3, 150.0  # metres
_DECODER_CHANNELS = (24, 40, 64, 96, 128)  # at H/2 ... H/32
_OUTPUTS = 4
_FIRST_DEPTH = 2.5  # log metres at the focal length that the depth range is meant for
_LOG_STEP = 0.5  # of log depth for one unit of the head
_SKY_BIAS = -3.0


class RigConditionedNet(ConditionedNetwork):
    """EfficientNet-Lite0 and a decoder at half the picture's size, both told the rig; every camera on its own.

    Depth is learnt as its logarithm for the focal length that the depth range is meant for, so that a longer lens
    reaches further. Batch normalisations keep the statistics they began with, also in training: batches of pictures
    from everywhere would shift them.
    """

    independent: ClassVar[bool] = True
    engines: ClassVar[tuple[str, ...]] = ("ncnn", "openvino", "torch", "onnxruntime", "torch_eager")
    ENCODER: ClassVar[str] = "efficientnet_lite0"

    def __init__(self, min_depth: float, max_depth: float, focal_scale: float) -> None:
        """Take the fields of `DepthModelSpec` of these names."""
        super().__init__()
        self._nearest, self._farthest, self._focal_scale = 1 / min_depth, 1 / max_depth, focal_scale
        self.depth_encoder = EfficientNetLite0Encoder(3)
        self.rig_stem = SameConv(CHANNELS, self.depth_encoder.encoder.stem.out_channels, 3, stride=2)
        nn.init.zeros_(self.rig_stem.weight)  # the encoder begins as it was
        self.depth_decoder = ConditionedDecoder(self.depth_encoder.channels, _DECODER_CHANNELS)

    def train(self, mode: bool = True) -> RigConditionedNet:
        """See the class for what stays as it is."""
        super().train(mode)
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
        return self

    def forward(self, rig: RigImages) -> Tensor:
        """Return the disparity [B, N, 1, H, W] in [0, 1]; see `details` for what is refused."""
        return self.details(rig).disparity

    def details(self, rig: RigImages) -> DepthOutputs:
        """Return all outputs; ImageError when H or W is not a multiple of 32 or below 64."""
        outputs = self.outputs(rig.images.flatten(0, 1), self.conditioning(rig).flatten(0, 1))
        return outputs.map(lambda part: part.view(*rig.images.shape[:2], *part.shape[1:]))

    @torch.no_grad()
    def conditioning(self, rig: RigImages) -> Tensor:
        """See `ConditionedNetwork`: `CHANNELS` for the convolutions, then the flat ground for the gate."""
        height, width = rig.images.shape[-2:]
        x, y = _ray_slopes(rig.intrinsics, height, width)
        return _conditioning(x, y, rig.intrinsics[..., 0, 0], rig.base_T_camera, self._focal_scale)

    def outputs(self, images: Tensor, conditioning: Tensor) -> DepthOutputs:
        """See `ConditionedNetwork`; ImageError when H or W is not a multiple of 32 or below 64."""
        refuse_input_size(*images.shape[-2:])
        told, ground = conditioning.split([CHANNELS, 1], dim=1)  # type: ignore[no-untyped-call]
        return self.from_head(self.depth_decoder(self._features(images, told), told), ground)

    def from_head(self, head: Tensor, ground: Tensor) -> DepthOutputs:
        """Return the outputs [B, 1, H, W] of the decoder's result and the last channel of the conditioning."""
        head = F.pixel_shuffle(head, 2)
        free, gate, sky, log_uncertainty = head.to(ground.dtype).split(1, dim=1)  # type: ignore[no-untyped-call]
        on_ground = torch.sigmoid(gate) * (ground > 0).to(ground.dtype)
        log_ground = -torch.log(ground.clamp(min=1e-6))
        log_depth = torch.lerp(free * _LOG_STEP + _FIRST_DEPTH, log_ground, on_ground)
        inverse_depth = torch.exp(-log_depth) * torch.sigmoid(-sky)
        disparity = (inverse_depth - self._farthest) / (self._nearest - self._farthest)
        return DepthOutputs(disparity.clamp(0.0, 1.0), sky, log_uncertainty)

    def _features(self, images: Tensor, told: Tensor) -> list[Tensor]:
        """Return the encoder's five feature maps; what it is told is added to its first convolution."""
        encoder = self.depth_encoder
        stem = encoder.encoder.stem(encoder.normalised(images)) + self.rig_stem(told)
        features: list[Tensor] = encoder.encoder.after_stem(stem)
        return features


class ConditionedDecoder(nn.Module):
    """Four upsampling steps, each joined with the encoder's feature map of the same resolution and the conditioning.

    The head gives each pixel of H/2 x W/2 its four parts, so that outlines are as fine as the picture.
    """

    def __init__(self, encoder_channels: Sequence[int], channels: Sequence[int]) -> None:
        """Take the widths at H/2 ... H/32."""
        super().__init__()
        self.top = ConvELU(encoder_channels[-1] + CHANNELS, channels[-1])
        self.steps = nn.ModuleList(
            ConvELU(channels[level + 1] + encoder_channels[level] + CHANNELS, channels[level])
            for level in reversed(range(4))
        )
        self.head = ReflectConv(channels[0], 4 * _OUTPUTS)
        _start_alike(self.head.conv)

    def forward(self, features: Sequence[Tensor], told: Tensor) -> Tensor:
        """Turn feature maps, finest (H/2) first, and conditioning [B, C, H, W] into [B, 4 `_OUTPUTS`, H/2, W/2]."""
        pyramid = [F.avg_pool2d(told, 2 ** (level + 1)) for level in range(5)]
        x = self.top(torch.cat([features[4], pyramid[4]], dim=1))
        for step, level in zip(self.steps, reversed(range(4)), strict=True):
            x = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = step(torch.cat([x, features[level], pyramid[level]], dim=1))
        outputs: Tensor = self.head(x)
        return outputs


@torch.no_grad()
def _start_alike(head: nn.Conv2d) -> None:
    """Give the four parts of a pixel the same weights to begin with: no chequerboard to unlearn; little sky."""
    head.weight.copy_(head.weight[::4].repeat_interleave(4, dim=0))
    nn.init.zeros_(head.get_parameter("bias"))
    head.get_parameter("bias")[8:12] = _SKY_BIAS


def _ray_slopes(intrinsics: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return x / z and y / z of the ray through each pixel, [B, N, H, W] each, of cameras without skew."""
    u = torch.arange(width, device=intrinsics.device, dtype=intrinsics.dtype)
    v = torch.arange(height, device=intrinsics.device, dtype=intrinsics.dtype)
    fx, fy, cx, cy = (intrinsics[..., i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    shape = (*intrinsics.shape[:2], height, width)
    return ((u - cx) / fx).expand(shape), ((v[:, None] - cy) / fy).expand(shape)


def _conditioning(x: Tensor, y: Tensor, fx: Tensor, base_T_camera: Tensor, focal_scale: float) -> Tensor:
    """Return [B, N, CHANNELS + 1, H, W] of rays through (x, y, 1) [B, N, H, W]."""
    rotation, heights = base_T_camera[..., :3, :3], base_T_camera[..., 2, 3, None, None]
    forward, left, up = (_along(rotation[..., axis, :], x, y) for axis in range(3))
    level = torch.sqrt(forward**2 + left**2)
    ground = -up / heights.clamp(min=_LEAST_HEIGHT)  # inverse depth, 1/m, negative above the horizon
    near = ground.clamp(0.0, 1 / _NEAREST_GROUND)
    below = (ground > 1 / _FARTHEST_GROUND).to(x.dtype)
    sine = up / torch.sqrt(level**2 + up**2)
    focal = fx[..., None, None]
    channels = [
        (3 * near).clamp(max=2.0),
        0.3 * torch.log(near.clamp(min=0.005)) + 0.6,
        2 * sine,
        forward / level.clamp(min=0.05),
        left / level.clamp(min=0.05),
        x,
        y,
        torch.log(focal / focal_scale).expand_as(x),
        (heights - _USUAL_HEIGHT).expand_as(x),
        below,
        near * below * focal / focal_scale,
    ]
    return torch.stack(channels, dim=2)


def _along(axis: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the rays' component [B, N, H, W] along an axis [B, N, 3] of the base frame."""
    a, b, c = (axis[..., i, None, None] for i in range(3))
    return a * x + b * y + c
