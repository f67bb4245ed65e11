# SPDX-License-Identifier: Apache-2.0
"""A volume of voxels around the vehicle, as VFDepth has it: where cameras see it, and what a camera sees of it.

Free functions of calibration alone: what they give is the same for every set of a rig. Reading features at places
between pixels or voxels is a sum of weighted rows of a table (`WeightedRows`), so that one form serves both ways, any
number of cameras, and engines without three-dimensional sampling.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.errors import RigError
from cvcdepth_core.networks.rig_images import RigImages

STRIDE = 8
"""Pixels of the picture for one of the feature maps that the volume is filled from and read to."""

KINDS = 3
"""What a voxel takes from a camera: seen by it alone, or beside another as the first or as the second one."""

_PROJECTION_EPSILON = 1e-8
_COUNT_EPSILON = 1e-7
_BEHIND_THE_VEHICLE = 1e-3  # radians: a camera that looks straight back is on the left
_MOST_VIEWS = 2  # that count in the published rule


class VolumeSpec(BaseModel):
    """The volume of a network that fuses its cameras in one, and its widths; the defaults are the published ones."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    voxels: tuple[int, int, int] = (100, 100, 20)
    """Voxels along x (ahead), y (to the left) and z (up)."""
    voxel_size: tuple[float, float, float] = (1.0, 1.0, 1.5)
    """Metres from voxel to voxel."""
    first_voxel: tuple[float, float, float] = (-50.0, -50.0, -15.0)
    """Centre of the first voxel in the base frame, metres."""
    nearest: float = Field(default=2.0, gt=0, allow_inf_nan=False)
    """Depth of the first sample along each pixel's ray, metres."""
    farthest: float = Field(default=50.0, gt=0, allow_inf_nan=False)
    """Depth of the last one, metres."""
    steps: int = Field(default=50, ge=2)
    """Samples along a ray, evenly spaced in depth."""
    image_channels: int = Field(default=256, ge=1)
    """Width of the pictures' feature maps."""
    voxel_channels: int = Field(default=64, ge=1)
    """Width of a voxel."""
    depth_unit: float = Field(default=100.0, gt=0, allow_inf_nan=False)
    """Metres that a voxel's depth in a camera, one of its features, is divided by."""
    skips: bool = False
    """Whether the decoder also sees the encoder's finer feature maps."""
    corrected: bool = False
    """Depart from the published network: a voxel that three or more cameras see is not left empty, and of two cameras
    that are alike by the rig's ring, one is the second."""

    @model_validator(mode="after")
    def _has_an_extent(self) -> VolumeSpec:
        if min(self.voxels) < 2 or min(self.voxel_size) <= 0:
            raise ValueError(f"voxels {self.voxels} of {self.voxel_size} m: expected two or more each, above 0 m")
        if self.nearest >= self.farthest:
            raise ValueError(f"nearest {self.nearest} must be below farthest {self.farthest}")
        return self

    @property
    def count(self) -> int:
        """Voxels in all."""
        along_x, along_y, along_z = self.voxels
        return along_x * along_y * along_z

    @property
    def last_voxel(self) -> tuple[float, ...]:
        """Centre of the last voxel in the base frame, metres."""
        each = zip(self.first_voxel, self.voxel_size, self.voxels, strict=True)
        return tuple(first + size * (count - 1) for first, size, count in each)


def refuse_cameras_outside(volume: VolumeSpec, base_T_camera: NDArray[np.float64], names: Sequence[str]) -> None:
    """Raise RigError, with camera, place and extent, where one of the cameras [N, 4, 4] is not within the volume."""
    extent = list(zip("xyz", volume.first_voxel, volume.last_voxel, strict=True))
    for name, place in zip(names, base_T_camera[:, :3, 3].tolist(), strict=True):
        if all(first <= along <= last for along, (_, first, last) in zip(place, extent, strict=True)):
            continue
        at = ", ".join(f"{along:.2f}" for along in place)
        spans = ", ".join(f"{axis} {first:g} to {last:g}" for axis, first, last in extent)
        raise RigError(
            f"camera {name}: is at ({at}) m above the ground, outside of the network's volume ({spans} m); correct the "
            "transform, or train a network with another depth.volume"
        )


class WeightedRows(NamedTuple):
    """For each of M places, K rows of a table and their weights."""

    rows: Tensor
    """[M, K] int32."""
    weights: Tensor
    """[M, K]; a weight of 0 leaves its row out."""

    def sum_of(self, table: Tensor) -> Tensor:
        """Return [M, C], the weighted sums of rows of `table` [R, C]."""
        if torch.onnx.is_in_onnx_export():  # it has no such bags, but gathers
            total = torch.zeros_like(self.weights[:, :1])
            for row, weight in zip(self.rows.unbind(1), self.weights.unbind(1), strict=True):
                total = total + weight[:, None] * table[row.long()]
            return total
        found: Tensor = F.embedding_bag(self.rows, table, mode="sum", per_sample_weights=self.weights)
        return found


def interpolated(positions: Tensor, counts: Sequence[int]) -> WeightedRows:
    """Return the 2^d neighbours of `positions` [M, d] in a grid of `counts` (d of them), linearly weighted.

    Positions are in grid steps, those of the axis that runs fastest first; what is outside of the grid has no weight.
    """
    rows = positions.new_zeros(len(positions), 1, dtype=torch.int32)
    weights = torch.ones_like(positions[:, :1])
    stride = 1
    for position, count in zip(positions.unbind(1), counts, strict=True):
        lower = position.clamp(-2, count + 1).floor()
        at = torch.stack([lower, lower + 1], dim=1)
        weight = (1 - (position[:, None] - at).abs()) * ((at >= 0) & (at < count))
        row = at.clamp(0, count - 1).to(torch.int32) * stride
        rows = (rows[:, :, None] + row[:, None]).flatten(1)
        weights = (weights[:, :, None] * weight[:, None]).flatten(1)
        stride *= count
    return WeightedRows(rows, weights)


class VoxelViews(NamedTuple):
    """Where every voxel is in every camera's feature map."""

    pixels: Tensor
    """[B, N, V, 2] u and v in pixels of the feature map."""
    depth: Tensor
    """[B, N, V] metres along the camera's axis."""
    seen: Tensor
    """[B, N, V] bool."""


def feature_size(images: Tensor) -> tuple[int, int]:
    """Return height and width of the feature maps of `images` [..., H, W]."""
    height, width = images.shape[-2:]
    return height // STRIDE, width // STRIDE


def feature_intrinsics(intrinsics: Tensor) -> Tensor:
    """Return K [..., 3, 3] in pixels of the feature maps: divided, without the half pixel by which they are shifted.

    A checkpoint has learnt so.
    """
    return intrinsics / intrinsics.new_tensor([STRIDE, STRIDE, 1])[:, None]


def voxel_centres(volume: VolumeSpec, like: Tensor) -> Tensor:
    """Return the centres [3, V] in the base frame, x fastest, in the precision and on the device of `like`."""
    axes = [
        first + size * torch.arange(count, dtype=like.dtype, device=like.device)
        for first, size, count in zip(volume.first_voxel, volume.voxel_size, volume.voxels, strict=True)
    ]
    z, y, x = torch.meshgrid(*reversed(axes), indexing="ij")
    return torch.stack([x, y, z]).flatten(1)


def project_voxels(volume: VolumeSpec, rig: RigImages) -> tuple[Tensor, Tensor]:
    """Return pixels [B, N, V, 2] of the feature maps and depth [B, N, V] of every voxel, behind the camera too."""
    rotation, translation = rig.base_T_camera[..., :3, :3], rig.base_T_camera[..., :3, 3:]
    in_camera = rotation.transpose(-1, -2) @ (voxel_centres(volume, translation) - translation)
    u, v, z = (feature_intrinsics(rig.intrinsics) @ in_camera).unbind(-2)
    return torch.stack([u, v], dim=-1) / (z + _PROJECTION_EPSILON)[..., None], in_camera[..., 2, :]


def voxel_views(volume: VolumeSpec, rig: RigImages) -> VoxelViews:
    """Return where the rig's present cameras see the voxels, but for what their masks hide."""
    size = feature_size(rig.images)
    pixels, depth = project_voxels(volume, rig)
    grid = 2 * (pixels / pixels.new_tensor([size[1] - 1, size[0] - 1]) - 0.5)
    seen = (depth > 0) & (grid.abs() <= 1).all(dim=-1) & rig.present[..., None]
    shown = F.interpolate(rig.masks.flatten(0, 1).to(grid), size, mode="bilinear", align_corners=True)
    places = torch.where(seen[..., None], grid, -1.0).flatten(0, 1)[:, None]
    nearest = F.grid_sample(shown, places, "nearest", padding_mode="zeros", align_corners=True)
    seen = seen & (nearest.view(seen.shape) > 0.5)
    return VoxelViews(torch.where(seen[..., None], pixels, 0.0), depth, seen)


class Ring(NamedTuple):
    """The order of the cameras around the vehicle."""

    slots: Tensor
    """[B, N] 0 or 1: neighbours differ along the ring, from the camera that looks ahead on."""
    turns: Tensor
    """[B, N] radians to the left of the camera that looks ahead."""


def ring_of(base_T_camera: Tensor) -> Ring:
    """Return the ring of cameras [B, N, 4, 4], by where they look; it does not depend on their order.

    In a ring of an odd number of cameras, the two that meet behind are alike.
    """
    turn = torch.atan2(base_T_camera[..., 1, 2], base_T_camera[..., 0, 2])
    ahead = turn.abs().argmin(dim=1, keepdim=True)
    left = _wrapped(turn - turn.gather(1, ahead))
    is_other = torch.arange(left.shape[1], device=left.device) != ahead
    same_side = (left[:, :, None] > 0) == (left[:, None] > 0)
    nearer = (left[:, None].abs() < left[:, :, None].abs()) & same_side & is_other[:, None]
    return Ring((nearer.sum(dim=2) + 1) * is_other % 2, left)


def _wrapped(turn: Tensor) -> Tensor:
    whole = 2 * torch.pi
    return turn - whole * ((turn - _BEHIND_THE_VEHICLE) / whole - 0.5).ceil()


class FusionGeometry(NamedTuple):
    """How the voxels of B samples take their features from the cameras: B V voxels."""

    sums: WeightedRows
    """Rows of a table [B N h w KINDS, ...]."""
    depth: Tensor
    """[B V, KINDS] the voxel's depth in its cameras, added up by kind, in units of the volume's `depth_unit`."""
    views: Tensor
    """[B V] cameras that see the voxel."""
    filled: Tensor
    """[B V] bool, whether it has features."""


def fusion_geometry(volume: VolumeSpec, views: VoxelViews, ring: Ring, size: tuple[int, int]) -> FusionGeometry:
    """Return how voxels are filled: by one camera, or by two of different slots; see `VolumeSpec.corrected`.

    `size` is height and width of the feature maps.
    """
    count = views.seen.sum(dim=1, keepdim=True)
    slots, most = ring.slots[..., None].expand_as(views.seen), min(_MOST_VIEWS, views.seen.shape[1])
    weights = views.seen * (count <= _MOST_VIEWS).to(views.depth)
    if volume.corrected:
        slots, most = _told_apart(views.seen, slots, ring.turns), _most_views(count)
        weights = _shares(views.seen, slots).to(views.depth)
    kind = torch.where(count == 1, 0, 1 + slots)
    depth = weights * views.depth / volume.depth_unit
    return FusionGeometry(
        _rows_of_views(views, weights, size, most, kind),
        torch.stack([(depth * (kind == one)).sum(dim=1) for one in range(KINDS)], dim=-1).flatten(0, 1),
        count.flatten(),
        (weights.sum(dim=1) > 0).flatten(),
    )


def _told_apart(seen: Tensor, slots: Tensor, turns: Tensor) -> Tensor:
    """Return slots [B, N, V] where cameras of one slot that are alone in a voxel are in both, the first by the ring."""
    first = torch.where(seen, turns[..., None], torch.inf).argmin(dim=1, keepdim=True)
    is_later = torch.arange(seen.shape[1], device=seen.device)[:, None] != first
    alike = torch.stack([(seen & (slots == one)).any(dim=1, keepdim=True) for one in (0, 1)]).sum(dim=0) < 2
    return torch.where(alike, is_later.to(slots), slots)


def _shares(seen: Tensor, slots: Tensor) -> Tensor:
    """Return weights [B, N, V] that make each slot the mean of its cameras."""
    in_slot = [(seen & (slots == one)).sum(dim=1, keepdim=True).clamp(min=1) for one in (0, 1)]
    return seen / torch.where(slots == 1, in_slot[1], in_slot[0])


def mean_geometry(views: VoxelViews, size: tuple[int, int]) -> tuple[WeightedRows, Tensor]:
    """Return how voxels take the mean of their cameras: rows of a table [B N h w, ...], and their depth [B V] metres.

    The volumetric pose has it so.
    """
    count = views.seen.sum(dim=1, keepdim=True)
    weights = views.seen / (count.to(views.depth) + _COUNT_EPSILON)
    rows = _rows_of_views(views, weights, size, _most_views(count))
    return rows, (weights * views.depth).sum(dim=1).flatten()


def _most_views(count: Tensor) -> int:
    return max(1, int(count.max()))


def _rows_of_views(
    views: VoxelViews, weights: Tensor, size: tuple[int, int], most: int, kind: Tensor | None = None
) -> WeightedRows:
    """Return for each voxel the rows of up to `most` cameras that see it; with a `kind` [B, N, V], KINDS a pixel."""
    height, width = size
    _, camera = views.seen.to(weights).topk(most, dim=1)  # [B, most, V]
    samples, cameras = views.seen.shape[:2]
    pixels = views.pixels.gather(1, camera[..., None].expand(-1, -1, -1, 2))
    near = interpolated(pixels.flatten(0, 2), (width, height))
    image = torch.arange(samples, device=camera.device)[:, None, None] * cameras + camera
    rows = near.rows.view(*camera.shape, -1) + (image * (height * width)).to(torch.int32)[..., None]
    if kind is not None:
        rows = rows * KINDS + kind.gather(1, camera).to(torch.int32)[..., None]
    weighted = near.weights.view(*camera.shape, -1) * weights.gather(1, camera)[..., None]
    return WeightedRows(*(part.transpose(1, 2).flatten(2).flatten(0, 1) for part in (rows, weighted)))


def ray_geometry(volume: VolumeSpec, intrinsics: Tensor, base_T_camera: Tensor, size: tuple[int, int]) -> WeightedRows:
    """Return how views [B, M] read the volume: rows of a table [B V, ...] for B M (h + 2) (w + 2) steps samples.

    The border of one pixel is the picture mirrored, as the convolution that follows wants it. `intrinsics` [B, M, 3, 3]
    are those of the pictures, `size` that of the feature maps.
    """
    rays = _rays(feature_intrinsics(intrinsics), size)
    depths = torch.linspace(volume.nearest, volume.farthest, volume.steps, dtype=rays.dtype, device=rays.device)
    rotation, translation = base_T_camera[..., :3, :3], base_T_camera[..., :3, 3]
    points = (rotation @ rays).transpose(-1, -2)[..., None, :] * depths[:, None] + translation[:, :, None, None]
    first, step = (points.new_tensor(part) for part in (volume.first_voxel, volume.voxel_size))
    near = interpolated(((points - first) / step).flatten(0, -2), volume.voxels)
    sample = torch.arange(len(points), device=points.device, dtype=torch.int32) * volume.count
    return near._replace(rows=(near.rows.view(len(points), -1) + sample[:, None]).view_as(near.rows))


def _rays(intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the rays [B, M, 3, (h + 2) (w + 2)] through the pixels and their mirrored border, z = 1."""
    v, u = torch.meshgrid(*(_with_border(count, intrinsics) for count in size), indexing="ij")
    fx, skew, cx, fy, cy = (intrinsics[..., i, j, None] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    y = (v.flatten() - cy) / fy
    x = (u.flatten() - cx - skew * y) / fx
    return torch.stack([x, y, torch.ones_like(x)], dim=-2)


def _with_border(count: int, like: Tensor) -> Tensor:
    inside = torch.arange(count, dtype=like.dtype, device=like.device)
    return torch.cat([inside[1:2], inside, inside[-2:-1]])
