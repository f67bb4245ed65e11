# SPDX-License-Identifier: Apache-2.0
"""Finds exchanged cameras: neighbours' pictures are rendered from each other, without any depth.

A picture is swept through a neighbour's view on planes of several depths, and every pixel takes the plane that explains
it best (plane sweep, Collins 1996). Where the rig is right some plane fits almost everywhere; where two cameras are
exchanged, hardly any does, and the rig with these two exchanged explains the same pictures much better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from cvcdepth_core.rendering.photometric import photometric_error
from cvcdepth_core.rendering.projection import rigid_inverse, transform, unit_depth_points
from cvcdepth_core.rendering.view_synthesis import align_intensity, sample, sampling_grid

_DEPTHS = (1.5, 2.5, 4.0, 7.0, 14.0, 40.0, 1000.0)  # metres
_WINDOW = 5  # pixels over which one plane must fit
_FEWEST_PIXELS = 20


@dataclass(frozen=True, eq=False)
class PlacedPictures:
    """S surround sets of N cameras, rectified, and where the rig says that the cameras are."""

    pictures: NDArray[np.uint8]
    """[S, N, H, W, 3]."""
    intrinsics: NDArray[np.float64]
    """[N, 3, 3] in pixels of H x W."""
    valid: NDArray[np.bool_]
    """[N, H, W], False outside of the raw picture and on the vehicle itself."""
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4] metres."""
    lenses: Sequence[Sequence[int]] | None = None
    """Which cameras are views of one lens, and hence exchanged together; None: each has its own."""


class Exchange(NamedTuple):
    """Two cameras, with the photometric errors of their views before and after exchanging them.

    Of several views of one lens they are the first ones.
    """

    first: int
    second: int
    error: NDArray[np.float64]
    """[S] mean photometric error with both where the rig says."""
    exchanged_error: NDArray[np.float64]
    """[S] the same with either in the other's place."""

    @property
    def ratio(self) -> NDArray[np.float64]:
        """[S], below 1 where the exchanged places explain the pictures better."""
        return self.exchanged_error / self.error


def best_exchange(placed: PlacedPictures) -> Exchange | None:
    """Return the two cameras whose exchange explains all pictures best, None where no two cameras overlap.

    In a rig that is right it explains them worse than the rig does. A camera takes its intrinsics with it: what is
    exchanged is the pose.
    """
    sweep = _Sweep(placed)
    lenses = [tuple(lens) for lens in placed.lenses or [(camera,) for camera in range(sweep.cameras)]]
    pairs = [pair for pair in combinations(lenses, 2) if len(pair[0]) == len(pair[1])]
    found = [(sweep.error(_exchanged(sweep, *pair)), *pair) for pair in pairs]
    known = [(float(error.mean()), first, second) for error, first, second in found if error is not None]
    if not known:
        return None
    _, first, second = min(known)
    as_described = sweep.error(tuple(range(sweep.cameras)), of=(*first, *second))
    exchanged = sweep.error(_exchanged(sweep, first, second), of=(*first, *second))
    if as_described is None or exchanged is None:
        return None
    return Exchange(first[0], second[0], as_described, exchanged)


def _exchanged(sweep: _Sweep, first: Sequence[int], second: Sequence[int]) -> tuple[int, ...]:
    """Return which camera is in each place after the exchange."""
    places = dict(zip((*first, *second), (*second, *first), strict=True))
    return tuple(places.get(camera, camera) for camera in range(sweep.cameras))


class _Sweep:
    """Errors of any camera in any place against any other camera in any other place, each computed once."""

    def __init__(self, placed: PlacedPictures) -> None:
        self.cameras = len(placed.base_T_camera)
        # Grey shows as much as colour, at a third of the cost.
        self._pictures = torch.from_numpy(placed.pictures).float().mean(dim=-1)[:, :, None] / 255
        self._valid = torch.from_numpy(placed.valid)[:, None].float()
        self._intrinsics = torch.from_numpy(placed.intrinsics).float()
        self._poses = torch.from_numpy(placed.base_T_camera).float()
        self._error = cache(self._pair_error)

    def error(self, camera_at: tuple[int, ...], of: Sequence[int] | None = None) -> NDArray[np.float64] | None:
        """Return the mean error [S] over all views between two places, or those that a place `of` takes part in.

        `camera_at` says which camera is in each place. None where there is no such view.
        """
        pairs = [(a, b) for a, b in permutations(range(self.cameras), 2) if of is None or {a, b} & {*of}]
        found = [error for a, b in pairs if (error := self._error(a, camera_at[a], b, camera_at[b]))]
        return np.mean(found, axis=0) if found else None

    def _pair_error(self, place: int, camera: int, other_place: int, other: int) -> tuple[float, ...] | None:
        """Return the error of each set where `camera` in one place sees what `other` sees in its; None: nothing."""
        other_T_view = rigid_inverse(self._poses[other_place]) @ self._poses[place]
        height, width = self._pictures.shape[-2:]
        rays = unit_depth_points(torch.linalg.inv(self._intrinsics[camera]), height, width)
        points = rays * torch.tensor(_DEPTHS)[:, None, None]
        grid, z = sampling_grid(transform(other_T_view, points), self._intrinsics[other], (height, width))
        ahead = (grid.abs() <= 1).all(dim=-1) & (z.view(grid.shape[:-1]) > 0)  # [D, H, W]
        window = _bounding_window(ahead.any(dim=0))
        if window is None:
            return None
        seen = ahead[:, None] * sample(self._valid[other].expand(len(grid), 1, -1, -1), grid, mode="nearest")
        seen = (seen * self._valid[camera])[..., window.rows, window.columns]
        return self._swept_error(camera, other, grid[:, window.rows, window.columns], seen, window)

    def _swept_error(
        self, camera: int, other: int, grid: Tensor, seen: Tensor, window: _Window
    ) -> tuple[float, ...] | None:
        """Take the best of all depths (`grid` [D, h, w, 2], `seen` [D, 1, h, w]) for every pixel of the window."""
        if int(seen.amax(dim=0).sum()) < _FEWEST_PIXELS:
            return None
        sets, depths = len(self._pictures), len(grid)
        target = self._pictures[:, camera, None][..., window.rows, window.columns]
        sources = self._pictures[:, other, None].expand(-1, depths, -1, -1, -1)
        warped = sample(sources, grid.expand(sets, *grid.shape))
        mask = seen.expand(sets, *seen.shape)
        aligned = align_intensity(warped, mask, target, torch.ones_like(target[:, :, :1]), masked_deviation=True)
        error = photometric_error(aligned, target) * mask
        smooth = _pooled(error) / _pooled(mask).clamp(min=1e-6)
        best = torch.where(mask > 0, smooth, torch.inf).amin(dim=1)
        return tuple(float(found[found.isfinite()].mean()) for found in best)


class _Window(NamedTuple):
    rows: slice
    columns: slice


def _bounding_window(seen: Tensor) -> _Window | None:
    """Return the rows and columns of `seen` [H, W] that hold all of it; None where they are fewer than a window."""
    rows, columns = (seen.any(dim=dim).nonzero().flatten() for dim in (1, 0))
    if len(rows) < _WINDOW or len(columns) < _WINDOW:
        return None
    return _Window(slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))


def _pooled(images: Tensor) -> Tensor:
    pooled: Tensor = avg_pool2d(images.flatten(0, 1), _WINDOW, 1, _WINDOW // 2)
    return pooled.view(images.shape)
