# SPDX-License-Identifier: Apache-2.0
"""Agreement of two views: of their depths, and of one picture with the other one rendered into it by depth.

Every comparison is of a view with another one, at another place or moment, by true geometry: a point of the view is
back-projected, moved to the other view, and its distance there compared with the depth that was estimated there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import max_pool2d

from cvcdepth_core.images.surround import to_tensor
from cvcdepth_core.rendering.photometric import masked_mean, photometric_error
from cvcdepth_core.rendering.projection import back_project, transform
from cvcdepth_core.rendering.view_synthesis import align_intensity, sample, sampling_grid, warp_views
from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.surround_depth import SurroundDepth

_OCCLUDER_MARGIN = 0.05
_EDGE = 0.1
_ALL_KNOWN = 0.999
_OUTSIDE = 2.0  # of a sampling grid, which spans -1 to 1


@dataclass(frozen=True, eq=False)
class PosedDepth:
    """A surround set's depth, and where each camera was when its picture was taken."""

    surround: SurroundDepth
    world_T_camera: NDArray[np.float64]
    """[N, 4, 4] metres, each at its camera's own moment, in any frame that several sets share."""

    @classmethod
    def from_rig(cls, surround: SurroundDepth, rig: Rig, world_T_base: Sequence[Pose] | None) -> PosedDepth:
        """Place the cameras of `rig` by the vehicle's pose [4, 4] at each one's moment; None: at the origin."""
        base_T_camera = np.stack([camera.base_T_camera for camera in rig.cameras])
        return cls(surround, base_T_camera if world_T_base is None else np.stack(world_T_base) @ base_T_camera)


class Agreement(NamedTuple):
    """Agreement of one view with another."""

    pixels: int
    """Pixels with comparable depth: the other view sees the point, nothing hides it there, and depth is smooth."""
    median: float
    """Median of the relative difference 2 |z - d| / (z + d) over these pixels; NaN for none."""
    percentile_90: float
    """Its 90th percentile."""
    photometric: float
    """Mean photometric error of the view rendered from the other's picture; NaN where that shows nothing of it."""


def agreement(view: PosedDepth, i: int, other: PosedDepth, j: int, max_depth: float = 80.0) -> Agreement:
    """Compare camera `i` of one set with camera `j` of the same or another set, over points nearer than `max_depth`."""
    views = _TwoViews.from_views(view, i, other, j)
    difference, hidden = _compare(views, max_depth)
    compared = difference[~torch.isnan(difference)].numpy()
    half, most = np.percentile(compared, [50, 90]).tolist() if compared.size else (math.nan, math.nan)
    return Agreement(compared.size, half, most, _photometric(views, hidden, max_depth))


def disagreement(view: PosedDepth, i: int, other: PosedDepth, j: int, max_depth: float = 80.0) -> NDArray[np.float32]:
    """Return the relative difference 2 |z - d| / (z + d) of every pixel [H, W], NaN where it cannot be compared.

    z is the distance along the other's axis of the point seen in the view, d the other's depth where it is seen there.
    Not compared are points outside of the other picture or not nearer than `max_depth`, at depth edges there (more than
    10 % deviation among the four pixels), and hidden by a nearer surface of the other's depth, unless the view
    contradicts that surface by seeing through it.
    """
    difference, _ = _compare(_TwoViews.from_views(view, i, other, j), max_depth)
    found: NDArray[np.float32] = difference[0, 0].numpy()
    return found


@dataclass(frozen=True)
class _TwoViews:
    """A view and the other one that it is compared with."""

    picture: Tensor  # [1, 3, H, W]
    other_picture: Tensor
    depth: Tensor  # [1, 1, H, W] metres, NaN unknown
    other_depth: Tensor
    intrinsics: Tensor  # [1, 3, 3]
    other_intrinsics: Tensor
    other_T_view: Tensor  # [1, 4, 4]

    @classmethod
    def from_views(cls, view: PosedDepth, i: int, other: PosedDepth, j: int) -> _TwoViews:
        other_T_view = inverse(other.world_T_camera[j]) @ view.world_T_camera[i]
        return cls(
            to_tensor([view.surround.pictures[i]]),
            to_tensor([other.surround.pictures[j]]),
            torch.from_numpy(view.surround.depth[[i], None]),
            torch.from_numpy(other.surround.depth[[j], None]),
            torch.from_numpy(view.surround.intrinsics[[i]]).float(),
            torch.from_numpy(other.surround.intrinsics[[j]]).float(),
            torch.from_numpy(other_T_view[None]).float(),
        )

    @property
    def points(self) -> Tensor:
        """[1, 3, H*W] metres in the view's frame, NaN where unknown."""
        return back_project(self.depth, torch.linalg.inv(self.intrinsics))


def _compare(views: _TwoViews, max_depth: float) -> tuple[Tensor, Tensor]:
    """Return the relative difference [1, 1, H, W], NaN where not comparable, and where the point is hidden."""
    in_other = transform(views.other_T_view, views.points)
    grid, z = sampling_grid(in_other, views.other_intrinsics, views.other_depth.shape[-2:])
    z = z.view(views.depth.shape)
    seen = (z > 0) & (z < max_depth) & (views.depth < max_depth)
    d = _depth_at(views.other_depth, grid)
    hidden = seen & (d < z * (1 - _OCCLUDER_MARGIN)) & ~_contradicted(views, in_other, d / z)
    difference = 2 * (z - d).abs() / (z + d)
    return torch.where(seen & ~hidden, difference, torch.nan), hidden


def _contradicted(views: _TwoViews, in_other: Tensor, shortening: Tensor) -> Tensor:
    """Return where the view sees through the surface that the other view has on its ray to the point.

    The ray's points [1, 3, H*W] times `shortening` [1, 1, H, W] lie on that surface.
    """
    view_T_other = torch.linalg.inv(views.other_T_view)
    surface = transform(view_T_other, in_other * shortening.flatten(-2))
    grid, z = sampling_grid(surface, views.intrinsics, views.depth.shape[-2:])
    z = z.view(views.depth.shape)
    nearness = torch.where(torch.isnan(views.depth), torch.inf, 1 / views.depth)
    # Silhouettes fall between pixels: no pixel around may have a surface as near as that one.
    nearest = sample(max_pool2d(nearness, 3, stride=1, padding=1), grid.nan_to_num(_OUTSIDE), mode="nearest")
    contradicted: Tensor = (z > 0) & (nearest > 0) & (nearest * z * (1 + _OCCLUDER_MARGIN) < 1)
    return contradicted


def _depth_at(depth: Tensor, grid: Tensor) -> Tensor:
    """Interpolate depth [1, 1, H, W] at `grid`; NaN outside, next to unknown pixels and at depth edges.

    Inverse depth is interpolated: of a plane it is linear in the picture, so that planes are exact.
    """
    known = ~torch.isnan(depth)
    nearness = torch.where(known, 1 / depth, 0.0)
    moments = torch.cat([nearness, nearness.square(), known.to(depth)], dim=1)
    mean_nearness, squared, share = sample(moments, grid.nan_to_num(_OUTSIDE)).unsqueeze(2).unbind(dim=1)
    deviation = (squared - mean_nearness.square()).clamp(min=0).sqrt()
    smooth = (share >= _ALL_KNOWN) & (deviation <= _EDGE * mean_nearness)
    return torch.where(smooth, 1 / mean_nearness, torch.nan)


def _photometric(views: _TwoViews, hidden: Tensor, max_depth: float) -> float:
    """Return the mean photometric error over what the other picture shows of the view, hidden points left out."""
    compared = (views.depth < max_depth) & ~hidden
    everywhere = torch.ones_like(views.other_depth)
    warp = warp_views(
        views.points.nan_to_num(0.0),
        views.other_picture,
        everywhere,
        views.other_T_view,
        views.other_intrinsics,
        in_front_only=True,
    )
    mask = warp.masks * compared
    if not mask.any():
        return math.nan
    aligned = align_intensity(warp.images, mask, views.picture, compared.to(mask), masked_deviation=True)
    return float(masked_mean(photometric_error(aligned, views.picture), mask))
