# SPDX-License-Identifier: Apache-2.0
"""VFDepth: depth and motion from one volume that all cameras' features are brought into (Kim et al., NeurIPS 2022).

Written from docs/networks.md's description. Its convolutions over the volume run before the features are brought there
(what a voxel takes is a weighted sum of pixels, and so commutes with them), for all cameras at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.networks.depth import ConvELU, ReflectConv, refuse_input_size
from cvcdepth_core.networks.encoders import build_encoder
from cvcdepth_core.networks.pose import MAX_TRANSLATION, PoseDecoder
from cvcdepth_core.networks.rig_images import DepthNetwork, RigImages
from cvcdepth_core.networks.volume import (
    STRIDE,
    FusionGeometry,
    VolumeSpec,
    WeightedRows,
    feature_size,
    fusion_geometry,
    mean_geometry,
    ray_geometry,
    ring_of,
    voxel_views,
)

VIEW_CHANNELS = 128
"""Width of a view of the volume."""

_SLOPE = 0.1
_REDUCED = 256
_DECODER_LEVELS = (2, 1, 0)
_FUSED_LEVELS = (2, 3, 4)


class VolumeGeometry(NamedTuple):
    """What the network needs of the rig: the same for every set."""

    fusion: FusionGeometry
    rays: WeightedRows


class FusedDepthNet(DepthNetwork):
    """VFDepth: features of all cameras in a volume, and each camera's view of that decoded."""

    independent: ClassVar[bool] = False
    engines: ClassVar[tuple[str, ...]] = ("torch_eager", "onnxruntime")
    mirror_offset: ClassVar[int] = STRIDE - 1

    def __init__(self, encoder: str, volume: VolumeSpec) -> None:
        super().__init__()
        self.volume = volume
        self.depth_encoder = build_encoder(encoder)
        self.aggregation = Aggregation(self.depth_encoder.channels, volume.image_channels)
        self.fusion = VoxelFusion(volume.image_channels, volume.voxel_channels)
        self.views = VolumeViews(volume.voxel_channels, volume.steps, VIEW_CHANNELS)
        skips = self.depth_encoder.channels if volume.skips else (0, 0)
        self.depth_decoder = ViewDecoder(VIEW_CHANNELS, self.depth_encoder.decoder_channels, skips)

    def forward(self, rig: RigImages) -> Tensor:
        """Return the disparity [B, N, 1, H, W]; ImageError when H or W is not a multiple of 32 or below 64."""
        return self.disparity(rig.images, self.geometry(rig))

    @torch.no_grad()
    def geometry(self, rig: RigImages, base_T_view: Tensor | None = None) -> VolumeGeometry:
        """Return what depends on the rig alone, for the views of its cameras, or [B, M, 4, 4], N of each camera."""
        size = feature_size(rig.images)
        fusion = fusion_geometry(self.volume, voxel_views(self.volume, rig), ring_of(rig.base_T_camera), size)
        seen_from = rig.base_T_camera if base_T_view is None else base_T_view
        copies = seen_from.shape[1] // rig.base_T_camera.shape[1]
        return VolumeGeometry(
            fusion, ray_geometry(self.volume, rig.intrinsics.repeat(1, copies, 1, 1), seen_from, size)
        )

    def disparity(self, images: Tensor, geometry: VolumeGeometry) -> Tensor:
        """Return the disparity [B, M, 1, H, W] of the views of `geometry`, by images [B, N, 3, H, W]."""
        refuse_input_size(*images.shape[-2:])
        samples = len(images)
        features = self.depth_encoder(images.flatten(0, 1))
        voxels = self.fusion(self.aggregation(features), geometry.fusion)
        maps = self.views(voxels, geometry.rays, features[_FUSED_LEVELS[0]].shape[-2:])
        copies = len(maps) // len(features[0])
        finer = [_repeated(features[level], samples, copies) for level in (0, 1)] if self.volume.skips else []
        disparity: Tensor = self.depth_decoder(maps, finer)
        return disparity.view(samples, -1, *disparity.shape[1:])

    def with_novel_views(self, rig: RigImages, base_T_novel: Tensor) -> tuple[Tensor, Tensor]:
        """Return the disparity [B, N, 1, H, W] of the rig's cameras, and of the same ones at poses [B, N, 4, 4]."""
        views = torch.cat([rig.base_T_camera, base_T_novel], dim=1)
        own, novel = self.disparity(rig.images, self.geometry(rig, views)).chunk(2, dim=1)
        return own, novel


class CorrectedFusedDepthNet(FusedDepthNet):
    """The same, of a volume that is `corrected`: how many cameras a voxel is made of depends on the rig."""

    engines: ClassVar[tuple[str, ...]] = ("torch_eager",)


def _repeated(features: Tensor, samples: int, copies: int) -> Tensor:
    """Return features [B N, ...] of each camera for each copy of the rig, [B copies N, ...]."""
    each = features.view(samples, 1, -1, *features.shape[1:])
    return each.expand(-1, copies, *each.shape[2:]).flatten(0, 2)


class Aggregation(nn.Module):
    """The encoder's three coarsest feature maps, brought to 1/8 of the picture and mixed."""

    def __init__(self, encoder_channels: Sequence[int], channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(sum(encoder_channels[level] for level in _FUSED_LEVELS), channels, 1)

    def forward(self, features: Sequence[Tensor]) -> Tensor:
        """Turn feature maps, finest (H/2) first, into [B, channels, H/8, W/8]."""
        finest, *others = (features[level] for level in _FUSED_LEVELS)
        size = finest.shape[-2:]
        brought = [F.interpolate(other, size, mode="bilinear", align_corners=True) for other in others]
        return F.leaky_relu(self.conv(torch.cat([finest, *brought], dim=1)), _SLOPE)


class VoxelFusion(nn.Module):
    """What a voxel makes of its cameras: of one that sees it alone, or of two.

    Beside the features, a camera gives the voxel's depth in it, as the last channel.
    """

    def __init__(self, image_channels: int, voxel_channels: int) -> None:
        super().__init__()
        self.alone = nn.Conv1d(image_channels + 1, voxel_channels, 1)
        self.overlap = nn.Conv1d(2 * (image_channels + 1), voxel_channels, 1)

    def forward(self, features: Tensor, geometry: FusionGeometry) -> Tensor:
        """Return voxels [B V, Q] of feature maps [B N, C, h, w]."""
        overlap = self.overlap.weight.squeeze(-1).chunk(2, dim=1)
        kinds = torch.cat([self.alone.weight.squeeze(-1), *overlap])  # [KINDS Q, C + 1]
        mixed = F.conv2d(features, kinds[:, :-1, None, None])
        table = mixed.permute(0, 2, 3, 1).reshape(-1, self.alone.out_channels).to(geometry.depth)
        of_depth = geometry.depth @ kinds[:, -1].view(-1, self.alone.out_channels)
        seen_once = (geometry.views == 1)[:, None]
        bias = torch.where(seen_once, self.alone.get_parameter("bias"), self.overlap.get_parameter("bias"))
        voxels = F.leaky_relu(geometry.sums.sum_of(table) + of_depth + bias, _SLOPE)
        return voxels * geometry.filled[:, None]


class VolumeViews(nn.Module):
    """What a camera sees of the volume: samples along the rays of its pixels, reduced to one feature map."""

    def __init__(self, voxel_channels: int, steps: int, view_channels: int) -> None:
        super().__init__()
        self.steps = steps
        self.reduce = nn.Conv2d(voxel_channels * steps, _REDUCED, 3)
        self.second = ReflectConv(_REDUCED, view_channels)

    def forward(self, voxels: Tensor, rays: WeightedRows, size: tuple[int, int] | torch.Size) -> Tensor:
        """Return the views [B M, view_channels, h, w] of voxels [B V, Q]."""
        maps = _images_of(rays.sum_of(voxels), (size[0] + 2, size[1] + 2), self.steps)
        # A sample's channels lie together in memory; the checkpoint has the samples of a channel together.
        weight = self.reduce.weight.reshape(_REDUCED, -1, self.steps, 3, 3).transpose(1, 2).flatten(1, 2)
        x = F.leaky_relu(F.conv2d(maps, weight, self.reduce.bias), _SLOPE)
        return F.leaky_relu(self.second(x), _SLOPE)


def _images_of(rows: Tensor, size: tuple[int, int], steps: int) -> Tensor:
    """Return rows [M h w steps, Q] as images [M, steps Q, h, w], without moving them."""
    return rows.view(-1, *size, steps * rows.shape[-1]).permute(0, 3, 1, 2)


class ViewDecoder(nn.Module):
    """Three upsampling steps from 1/8 of the picture, the first two joined with finer feature maps if there are any."""

    def __init__(self, in_channels: int, channels: Sequence[int], skip_channels: Sequence[int]) -> None:
        """Take the widths at H ... H/4, and of the encoder's feature maps at H/2 and H/4, or 0."""
        super().__init__()
        layers: list[nn.Module] = []
        for level in _DECODER_LEVELS:
            width, skip = channels[level], skip_channels[level - 1] if level else 0
            layers += [ConvELU(in_channels, width), ConvELU(width + skip, width)]
            in_channels = width
        layers.append(ReflectConv(in_channels, 1))
        self.decoder = nn.ModuleList(layers)

    def forward(self, x: Tensor, finer: Sequence[Tensor]) -> Tensor:
        """Turn [M, C, H/8, W/8] and the feature maps at H/2 and H/4, or none, into disparity [M, 1, H, W] in (0, 1)."""
        for step, level in enumerate(_DECODER_LEVELS):
            x = F.interpolate(self.decoder[2 * step](x), scale_factor=2.0, mode="nearest")
            if finer and level:
                x = torch.cat([x, finer[level - 1]], dim=1)
            x = self.decoder[2 * step + 1](x)
        return torch.sigmoid(self.decoder[-1](x))


class VolumePoseNet(nn.Module):
    """The motion of a rig by one volume of all its cameras, seen from above: read as the anchor camera's."""

    def __init__(self, encoder: str, volume: VolumeSpec) -> None:
        super().__init__()
        self.volume = volume
        self.pose_encoder = build_encoder(encoder, in_channels=6)
        self.aggregation = Aggregation(self.pose_encoder.channels, volume.image_channels)
        self.birds_eye = BirdsEyeView(volume.image_channels + 1, volume.voxels, VIEW_CHANNELS)
        self.pose_decoder = PoseDecoder(VIEW_CHANNELS, stride=2)

    def forward(self, rig: RigImages, later: Tensor) -> tuple[Tensor, Tensor]:
        """Return axis-angle [B, 3] (rad) and translation [B, 3] (m) of the motion that the rig sees.

        It leads from its images to `later` [B, N, 3, H, W], in temporal order.
        """
        pairs = torch.cat([rig.images, later], dim=2).flatten(0, 1)
        features = self.aggregation(self.pose_encoder(pairs))
        vector: Tensor = self.pose_decoder(self.birds_eye(mean_voxels(self.volume, features, rig)))
        return vector[:, :3], vector[:, 3:].clamp(-MAX_TRANSLATION, MAX_TRANSLATION)


def mean_voxels(volume: VolumeSpec, features: Tensor, rig: RigImages) -> Tensor:
    """Return voxels [B V, C + 1] of feature maps [B N, C, h, w]: the mean of the cameras that see them."""
    with torch.no_grad():
        sums, depth = mean_geometry(voxel_views(volume, rig), feature_size(rig.images))
    table = features.permute(0, 2, 3, 1).flatten(0, 2).to(depth)
    return torch.cat([sums.sum_of(table), depth[:, None] / volume.depth_unit], dim=1)


class BirdsEyeView(nn.Module):
    """A volume seen from above: its heights are channels, reduced to a quarter of its size."""

    def __init__(self, voxel_channels: int, voxels: tuple[int, int, int], view_channels: int) -> None:
        super().__init__()
        self._voxels = voxels
        first = ReflectConv(voxel_channels * voxels[2], _REDUCED, stride=2)
        self.reduce = nn.ModuleList([first, ReflectConv(_REDUCED, view_channels, stride=2)])

    def forward(self, voxels: Tensor) -> Tensor:
        """Return [B, view_channels, ny / 4, nx / 4] of voxels [B V, C]."""
        along_x, along_y, along_z = self._voxels
        x = voxels.view(-1, along_z, along_y, along_x, voxels.shape[-1]).permute(0, 4, 1, 2, 3).flatten(1, 2)
        for convolution in self.reduce:
            x = F.leaky_relu(convolution(x), _SLOPE)
        return x


DEPTH_NAMES = {
    "encoder.encoder.": "depth_encoder.encoder.",
    "conv1x1.0.": "aggregation.conv.",
    "fusion_net.conv_overlap.0.": "fusion.overlap.",
    "fusion_net.conv_non_overlap.0.": "fusion.alone.",
    "fusion_net.reduce_dim.0.": "views.reduce.",
    "fusion_net.reduce_dim.3.": "views.second.conv.",
    **{f"decoder.decoder.{i}.0.": f"depth_decoder.decoder.{i}.conv.conv." for i in range(6)},
    "decoder.decoder.6.0.": "depth_decoder.decoder.6.conv.",
}
"""How the names of parameters begin in the released depth network, and in ours."""

POSE_NAMES = {
    "encoder.encoder.": "pose_encoder.encoder.",
    "conv1x1.0.": "aggregation.conv.",
    "fusion_net.reduce_dim.0.": "birds_eye.reduce.0.conv.",
    "fusion_net.reduce_dim.3.": "birds_eye.reduce.1.conv.",
}
"""The same of the pose network."""


def renamed(state: Mapping[str, Tensor], names: Mapping[str, str]) -> dict[str, Tensor]:
    """Return a state whose names begin otherwise; one that begins with none of `names` stays as it is."""
    return {_renamed(key, names): value for key, value in state.items()}


def _renamed(key: str, names: Mapping[str, str]) -> str:
    for old, new in names.items():
        if key.startswith(old):
            return new + key.removeprefix(old)
    return key
