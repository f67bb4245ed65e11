# SPDX-License-Identifier: Apache-2.0
"""What two neighbouring cameras see of the same things: how it correlates, and how their depths differ.

A few hundred points of one picture's fine structure are rendered into the other through the depth, and correlated for
every small turn of the other camera on a grid of pitch and yaw. The peak of the correlations is the turn that makes the
pictures agree best: no turn for right calibration and depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from cvcdepth_core.rendering.agreement import PosedDepth, disagreement
from cvcdepth_core.rig.pinhole import rays_through, scale_intrinsics
from cvcdepth_core.surround_depth import SurroundDepth

_WORKING_WIDTH = 320
_POINTS = 200
_CANDIDATES = 4000  # enough for _POINTS in an overlap of a tenth of the picture
_LEAST_POINTS = 60
_TURNS_DEG = np.arange(-8, 9) * 0.25
_MARGIN = 3
_LEAST_CORRELATION = 0.3
_CONTRAST = 0.5
_NOISE = 1.5  # grey levels that count as no structure
_FLATNESS = 0.2
_COARSE_WIDTH = 64
_SHIFTS = range(-6, 7)  # steps of the grid by which two correlations are compared


@dataclass(frozen=True, eq=False)
class OverlapView:
    """One camera's picture and depth, made ready for the comparison with a neighbour's."""

    structure: NDArray[np.float32]
    """[h, w] fine structure, locally normalised, at the working size."""
    depth: NDArray[np.float32]
    """[h, w] metres."""
    intrinsics: NDArray[np.float64]
    """[3, 3] at the working size."""
    sharpness: float
    """Logarithm of the ratio of fine to coarser structure."""

    @classmethod
    def from_surround(cls, surround: SurroundDepth, camera: int) -> OverlapView:
        """Take one camera out of a surround set, pictures at most 320 pixels wide."""
        grey = cv2.cvtColor(surround.pictures[camera], cv2.COLOR_RGB2GRAY)
        height, width = grey.shape
        size = (min(width, _WORKING_WIDTH), round(height * min(1.0, _WORKING_WIDTH / width)))
        scale = (size[0] / width, size[1] / height)
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        depth = cv2.resize(surround.depth[camera], size, interpolation=cv2.INTER_NEAREST)
        return cls(_structure(small), depth, scale_intrinsics(surround.intrinsics[camera], scale), _sharpness(grey))


def _structure(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    detail = cv2.blur(grey, (3, 3)) - cv2.blur(grey, (13, 13))
    deviation = np.sqrt(cv2.blur(detail * detail, (13, 13))) + _NOISE
    normalised: NDArray[np.float32] = detail / deviation
    return normalised


def _sharpness(grey: NDArray[np.uint8]) -> float:
    """Return the logarithm of what a small blur takes away, over what a wider one takes away then."""
    once, twice = cv2.blur(grey, (3, 3)), cv2.blur(grey, (7, 7))
    fine, coarse = cv2.mean(cv2.absdiff(grey, once))[0], cv2.mean(cv2.absdiff(once, twice))[0]
    return math.log((fine + _FLATNESS) / (coarse + _FLATNESS))


def correlations(
    view: OverlapView, other: OverlapView, other_T_view: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return how the views correlate for every small turn of the other one [pitch, yaw]; None for too few points."""
    points, structure = _overlapping_points(view, other, other_T_view)
    if len(points) < _LEAST_POINTS:
        return None
    pixels = points @ (_TURNS @ other.intrinsics.T.astype(np.float32))  # [turns, M, 3], homogeneous
    u, v = (np.ascontiguousarray(pixels[..., axis]) / pixels[..., 2] for axis in (0, 1))
    seen = cv2.remap(other.structure, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    norm = np.sqrt((seen * seen).sum(axis=1) * (structure @ structure)) + 1e-6
    correlation: NDArray[np.float64] = (seen @ structure / norm).astype(np.float64)
    return correlation.reshape(len(_TURNS_DEG), len(_TURNS_DEG))


def _overlapping_points(
    view: OverlapView, other: OverlapView, other_T_view: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return points [M, 3] of the view that the other one sees, in metres in its frame, and their structure [M]."""
    contrasts = np.flatnonzero(np.abs(view.structure) > _CONTRAST)
    v, u = np.divmod(contrasts[:: max(1, len(contrasts) // _CANDIDATES)], view.structure.shape[1])
    z = view.depth[v, u]
    rays = rays_through(np.stack([u, v], axis=1), view.intrinsics)
    points = (rays * z[:, None]) @ other_T_view[:3, :3].T + other_T_view[:3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        pixels = (points @ other.intrinsics.T)[:, :2] / points[:, 2:]
    height, width = other.structure.shape
    inside = (pixels >= _MARGIN).all(axis=1) & (pixels[:, 0] < width - _MARGIN) & (pixels[:, 1] < height - _MARGIN)
    chosen = np.flatnonzero(inside & (points[:, 2] > 0))
    chosen = chosen[:: max(1, len(chosen) // _POINTS)]
    return points[chosen].astype(np.float32), view.structure[v[chosen], u[chosen]]


def depth_disagreement(surround: SurroundDepth, poses: NDArray[np.float64], pair: tuple[int, int]) -> float:
    """Return the median relative difference of a pair's depths in the overlap, on a coarse grid; NaN without overlap.

    `poses` [N, 4, 4] are those of all cameras in a common frame.
    """
    stride = max(1, surround.depth.shape[2] // _COARSE_WIDTH)
    chosen = list(pair)
    coarse = SurroundDepth(
        np.ascontiguousarray(surround.depth[chosen, ::stride, ::stride]),
        np.ascontiguousarray(surround.pictures[chosen, ::stride, ::stride]),
        surround.intrinsics[chosen] / [[stride], [stride], [1.0]],
        surround.present[chosen],
    )
    posed = PosedDepth(coarse, poses[chosen])
    both = np.concatenate([disagreement(posed, 0, posed, 1).ravel(), disagreement(posed, 1, posed, 0).ravel()])
    known = both[~np.isnan(both)]
    return float(np.median(known)) if known.size >= _LEAST_POINTS else math.nan


def best_turn(correlation: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the turn (pitch, yaw; degrees) at the peak, between the grid's steps; NaN where nothing correlates."""
    if correlation is None or correlation.max() < _LEAST_CORRELATION:
        return np.full(2, np.nan)
    row, column = np.unravel_index(int(correlation.argmax()), correlation.shape)
    offsets = (_peak_offset(correlation[:, column], int(row)), _peak_offset(correlation[row], int(column)))
    turn: NDArray[np.float64] = _TURNS_DEG[[row, column]] + (_TURNS_DEG[1] - _TURNS_DEG[0]) * np.array(offsets)
    return turn


def _peak_offset(values: NDArray[np.float64], peak: int) -> float:
    """Return the place of the top of the parabola through the peak and its neighbours, in steps from the peak."""
    if not 0 < peak < len(values) - 1:
        return 0.0
    before, at, after = values[peak - 1 : peak + 2]
    bend = before - 2 * at + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0


def change_of_turn(now: NDArray[np.float64] | None, baseline: NDArray[np.float64] | None) -> float:
    """Return the degrees by which `now` must be shifted to be most like `baseline`; NaN where nothing correlates.

    The whole course around the peak counts: where streets make it a ridge, its top wanders though nothing has moved.
    """
    if now is None or baseline is None or min(now.max(), baseline.max()) < _LEAST_CORRELATION:
        return math.nan
    likeness = _likeness(now, baseline)
    row, column = np.unravel_index(int(likeness.argmax()), likeness.shape)
    offsets = (_peak_offset(likeness[:, column], int(row)), _peak_offset(likeness[row], int(column)))
    steps = np.hypot(_SHIFTS[row] + offsets[0], _SHIFTS[column] + offsets[1])
    return float(steps * (_TURNS_DEG[1] - _TURNS_DEG[0]))


def _likeness(now: NDArray[np.float64], baseline: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for every shift of `now` (rows, columns) how like `baseline` it is: the mean squared difference, negated.

    Only what both show at that shift counts, without its mean.
    """
    a, b = _shifted(now), baseline.ravel()
    count = _SHOWN.sum(axis=1)
    squares = np.square(a).sum(axis=1) + _SHOWN @ np.square(b) - 2 * a @ b
    differences = squares - np.square(a.sum(axis=1) - _SHOWN @ b) / count
    likeness: NDArray[np.float64] = -(differences / count).reshape(len(_SHIFTS), len(_SHIFTS))
    return likeness


def _shifted(grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the grid [S, S] under every shift, a row each [shifts, S * S]; 0 where it shows nothing."""
    padded = np.pad(grid, _SHIFTS[-1])
    return sliding_window_view(padded, grid.shape).reshape(-1, grid.size)


def _turn(pitch: float, yaw: float) -> NDArray[np.float32]:
    """Return the rotation [3, 3] about a camera's x and y axes by small angles in degrees, for row vectors."""
    rotation, _ = cv2.Rodrigues(np.radians([pitch, yaw, 0.0]))
    turn: NDArray[np.float32] = np.array(rotation.T, dtype=np.float32)
    return turn


_SHOWN = _shifted(np.ones((len(_TURNS_DEG), len(_TURNS_DEG))))
_TURNS = np.stack([_turn(pitch, yaw) for pitch, yaw in product(_TURNS_DEG, _TURNS_DEG)])
