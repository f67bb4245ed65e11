# SPDX-License-Identifier: Apache-2.0
"""Ground truth from LiDAR: sparse depth in a camera's rectified picture, and predictions sampled there.

The field's protocol resizes the prediction bilinearly to the truth's size (method section 9). Truth is sparse, so the
prediction is sampled at the truth's pixels instead: the same numbers for a hundredth of the work.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError, ImageError
from cvcdepth_core.rig.pinhole import PinholeView, rays_through

_NEAREST_OVERLAP = 1.0
_LARGEST_REACH = 64
"""Cells around a point that are searched for what hides it: work grows with the square. Wide lenses stay below it."""


@dataclass(frozen=True, eq=False)
class SparseDepth:
    """Depth that is known at some pixels of a picture of `height` x `width`."""

    rows: NDArray[np.int64]
    """[M]; no pixel occurs twice."""
    columns: NDArray[np.int64]
    """[M]."""
    depth: NDArray[np.float64]
    """[M] metres along the optical axis."""
    height: int
    width: int

    def __len__(self) -> int:
        return len(self.depth)

    @classmethod
    def from_image(cls, depth: NDArray[np.floating]) -> SparseDepth:
        """Take the pixels of a depth image [H, W] (metres) that are finite and positive, in reading order."""
        rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
        return cls(rows, columns, depth[rows, columns].astype(np.float64), *depth.shape)

    def image(self) -> NDArray[np.float32]:
        """Return it as a depth image [H, W] in metres, NaN where unknown."""
        image = np.full((self.height, self.width), np.nan, dtype=np.float32)
        image[self.rows, self.columns] = self.depth
        return image

    def __getitem__(self, kept: NDArray[np.bool_]) -> SparseDepth:
        return SparseDepth(self.rows[kept], self.columns[kept], self.depth[kept], self.height, self.width)


@dataclass(frozen=True)
class OcclusionFilter:
    """Which LiDAR points a camera cannot see, since a nearer surface hides them from where the camera is.

    A point is hidden when a point within `radius` of it in the picture is nearer than any smooth surface through both
    would be: the inverse depth of a plane that passes `clearance` metres from the camera changes by at most
    1 / (f clearance) per pixel, so a road or a wall seen at a grazing angle does not hide itself.
    """

    radius: float = 0.5
    """Degrees: about the distance of the LiDAR's scan lines, so that the points of an occluder close its surface."""
    clearance: float = 1.0
    """Metres from the camera that no continuous surface is expected to pass within; below the camera's height."""
    margin: float = 0.05
    """Share of the depth by which an occluder is at least nearer."""

    def __post_init__(self) -> None:
        for name in ("radius", "clearance", "margin"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"occlusion filter: {name} is {getattr(self, name)}, must be positive")

    def visible(self, truth: SparseDepth, focal_length: float) -> NDArray[np.bool_]:
        """Return which points [M] of `truth` nothing hides; `focal_length` in its pixels."""
        hidden = np.zeros(len(truth), dtype=bool)
        if not len(truth):
            return ~hidden
        radius = math.radians(self.radius) * focal_length
        cell = math.ceil(radius / _LARGEST_REACH)  # pixels: one, or what a long lens spreads over many
        reach = math.ceil(radius / cell)
        own = 1 / truth.depth
        nearness, at = _nearest_in_cells(truth, cell, reach)
        for row, column in _offsets_within(reach):
            limit = own * (1 + self.margin) + cell * math.hypot(row, column) / (focal_length * self.clearance)
            hidden |= nearness.ravel()[at + row * nearness.shape[1] + column] > limit
        return ~hidden


def sparse_depth(
    points: NDArray[np.floating], view: PinholeView, occlusion: OcclusionFilter | None = None
) -> SparseDepth:
    """Project `points` [M, 3] (metres, base frame at the picture's moment) to depth, the nearest of each pixel.

    Points behind the camera, outside the picture and NaN ones are left out; `occlusion` also drops hidden ones.
    """
    pixels, z = view.project(points)
    u, v = np.floor(pixels + 0.5).T
    inside = (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    flat = v[inside].astype(np.int64) * view.width + u[inside].astype(np.int64)
    nearest_first = np.argsort(z[inside], kind="stable")
    pixel, first = np.unique(flat[nearest_first], return_index=True)
    rows, columns = np.divmod(pixel, view.width)
    truth = SparseDepth(rows, columns, z[inside][nearest_first][first], view.height, view.width)
    return truth if occlusion is None else truth[occlusion.visible(truth, float(view.intrinsics[0, 0]))]


def overlap_pixels(truth: SparseDepth, view: PinholeView, neighbours: Sequence[PinholeView]) -> NDArray[np.bool_]:
    """Return which pixels [M] of `truth` a neighbour sees too: inside its picture, z > 1 m (method section 9)."""
    pixels = np.stack([truth.columns, truth.rows], axis=1)
    in_camera = rays_through(pixels, view.intrinsics) * truth.depth[:, None]
    points = in_camera @ view.base_T_camera[:3, :3].T + view.base_T_camera[:3, 3]
    seen = np.zeros(len(truth), dtype=bool)
    for neighbour in neighbours:
        (u, v), z = (found.T for found in neighbour.project(points))
        inside = (u >= 0) & (u <= neighbour.width - 1) & (v >= 0) & (v <= neighbour.height - 1)
        seen |= inside & (z > _NEAREST_OVERLAP)
    return seen


def sample_prediction(prediction: NDArray[np.floating], truth: SparseDepth) -> NDArray[np.float64]:
    """Return `prediction` [h, w], resized bilinearly to the truth's size, at the truth's pixels [M].

    NaN where any pixel that it is interpolated from is NaN. Raises ImageError when it is no picture.
    """
    if prediction.ndim != 2 or 0 in prediction.shape:
        raise ImageError(f"prediction: shape is {list(prediction.shape)}, expected [h, w]")
    height, width = prediction.shape
    top, bottom, down = _interpolation(truth.rows, truth.height, height)
    left, right, across = _interpolation(truth.columns, truth.width, width)
    upper = _blend(prediction[top, left], prediction[top, right], across)
    lower = _blend(prediction[bottom, left], prediction[bottom, right], across)
    return _blend(upper, lower, down)


def downsample_ground_truth(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Move the points of a sparse depth image [H, W] (metres, 0 unknown) to the pixels of [height, width].

    The published numbers are computed at network resolution: pixel (u, v) goes to (floor(u width / W), floor(v height /
    H)), and of several points the last in reading order stays.
    """
    rows, columns = np.nonzero(depth)
    smaller = np.zeros((height, width), dtype=depth.dtype)
    smaller[rows * height // depth.shape[0], columns * width // depth.shape[1]] = depth[rows, columns]
    return smaller


def _nearest_in_cells(truth: SparseDepth, cell: int, border: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the largest inverse depth in each cell of `cell` x `cell` pixels, with a border of cells all around.

    Also where in it, raveled, each point [M] lies.
    """
    rows, columns = truth.rows // cell + border, truth.columns // cell + border
    nearness = np.zeros(((truth.height - 1) // cell + 1 + 2 * border, (truth.width - 1) // cell + 1 + 2 * border))
    far_to_near = np.argsort(-truth.depth)  # of several points of a cell the last remains
    nearness[rows[far_to_near], columns[far_to_near]] = 1 / truth.depth[far_to_near]
    return nearness, rows * nearness.shape[1] + columns


def _offsets_within(radius: int) -> Iterator[tuple[int, int]]:
    """Give the (row, column) offsets of a disc, without its centre."""
    for row in range(-radius, radius + 1):
        half = math.isqrt(radius * radius - row * row)
        yield from ((row, column) for column in range(-half, half + 1) if (row, column) != (0, 0))


def _interpolation(
    positions: NDArray[np.int64], large: int, small: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Between which pixels of `small`, and how far, lie pixels of an axis of `large`; borders are continued."""
    at = np.clip((positions + 0.5) * small / large - 0.5, 0, small - 1)
    first = np.floor(at).astype(np.int64)
    return first, np.minimum(first + 1, small - 1), at - first


def _blend(
    first: NDArray[np.floating], second: NDArray[np.floating], fraction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate; a value that has no weight does not count, not even NaN."""
    blended: NDArray[np.float64] = np.where(fraction > 0, (1 - fraction) * first + fraction * second, first)
    return blended
