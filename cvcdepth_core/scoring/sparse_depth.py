# SPDX-License-Identifier: Apache-2.0
"""Depth that is known at some pixels, and which of its points a camera cannot see."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError

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
    parts: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    """By name, which of the pixels [M] belong to a part that is scored apart."""
    sky: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    """[K, 2] rows and columns of the pixels that are known to show the sky."""

    def __len__(self) -> int:
        return len(self.depth)

    @classmethod
    def from_image(cls, depth: NDArray[np.floating]) -> SparseDepth:
        """Take the pixels of a depth image [H, W] (metres) that are finite and positive, in reading order."""
        rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
        return cls(rows, columns, depth[rows, columns].astype(np.float64), *depth.shape)

    def image(self) -> NDArray[np.float32]:
        """Return the depth image [H, W] in metres, NaN where unknown."""
        image = np.full((self.height, self.width), np.nan, dtype=np.float32)
        image[self.rows, self.columns] = self.depth
        return image

    def __getitem__(self, kept: NDArray[np.bool_]) -> SparseDepth:
        parts = {name: mask[kept] for name, mask in self.parts.items()}
        picked = self.rows[kept], self.columns[kept], self.depth[kept]
        return SparseDepth(*picked, self.height, self.width, parts, self.sky)


@dataclass(frozen=True)
class OcclusionFilter:
    """Filter of LiDAR points that a camera cannot see, since a nearer surface hides them from its place.

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
        """Return which points [M] of `truth` are not hidden; `focal_length` in its pixels."""
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
    """Yield the (row, column) offsets of a disc, without its centre."""
    for row in range(-radius, radius + 1):
        half = math.isqrt(radius * radius - row * row)
        yield from ((row, column) for column in range(-half, half + 1) if (row, column) != (0, 0))
