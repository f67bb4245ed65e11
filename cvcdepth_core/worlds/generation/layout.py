# SPDX-License-Identifier: Apache-2.0
"""Which places of a world are taken while it is thought up."""

from __future__ import annotations

import math

import numpy as np

from cvcdepth_core.worlds.description import Drive, Point, Road
from cvcdepth_core.worlds.shapes.meshes import Floats
from cvcdepth_core.worlds.terrain import Corridor

_BEHIND, _AHEAD = 80.0, 100.0


class Layout:
    """Rectangles that are taken, beside roads that are there."""

    def __init__(self, roads: tuple[Road, ...], drive: Drive, reach: float) -> None:
        self.corridors = [Corridor.of_road(road) for road in roads]
        self.start = drive.at[0]
        self.reach = reach
        self._taken = np.zeros((0, 6))  # x, y, cosine, sine, half length, half width

    def span(self, road: int = 0) -> tuple[float, float]:
        """Return the part of a road, s from and to, that the drive can see well."""
        length = self.corridors[road].path.length
        if road:
            return 15.0, length - 15.0
        return max(2.0, self.start - _BEHIND), min(length - 2.0, self.start + self.reach + _AHEAD)

    def edge(self, side: float, road: int = 0) -> float:
        """Metres from the middle to the outer edge of the pavement, on the left (1) or right (-1)."""
        corridor = self.corridors[road]
        return corridor.left if side > 0 else corridor.right

    def kerb(self, side: float, road: int = 0) -> float:
        """Metres from the middle to the edge of the carriageway."""
        right, left = self.corridors[road].carriageway
        return left if side > 0 else -right

    def xy(self, at: Point, road: int = 0) -> tuple[float, float]:
        """World's place of s and l."""
        x, y = self.corridors[road].path.points(*at).tolist()
        return x, y

    def take(
        self,
        at: Point,
        size: tuple[float, float],
        yaw: float = 0.0,
        road: int = 0,
        keep_off: float | None = 0.0,
        pavements: bool = False,
    ) -> bool:
        """Take a rectangle at s, l if it is free; `yaw` (degrees) from the road's direction.

        It must keep `keep_off` metres from every carriageway (None: it may lie anywhere), and off pavements too if
        `pavements`.
        """
        x, y = self.xy(at, road)
        angle = float(self.corridors[road].path.heading(at[0])) + math.radians(yaw)
        rectangle = np.array([x, y, math.cos(angle), math.sin(angle), size[0] / 2, size[1] / 2])
        if keep_off is not None and self._on_roads(rectangle, keep_off, pavements):
            return False
        if len(self._taken) and _overlaps(rectangle, self._taken).any():
            return False
        self._taken = np.r_[self._taken, rectangle[None]]
        return True

    def _on_roads(self, rectangle: Floats, margin: float, pavements: bool) -> bool:
        x, y, c, s, half_length, half_width = rectangle.tolist()
        steps = np.linspace(-1.0, 1.0, max(3, math.ceil(2 * half_length / 4) + 1))
        u, v = np.meshgrid(steps * half_length, np.array([-1.0, 0.0, 1.0]) * half_width)
        points = np.stack([x + c * u - s * v, y + s * u + c * v], axis=-1).reshape(-1, 2)
        for corridor in self.corridors:
            at, left = corridor.path.locate(points)
            low, high = (-corridor.right, corridor.left) if pavements else corridor.carriageway
            inside = (
                (left > low - margin) & (left < high + margin) & (at > -margin) & (at < corridor.path.length + margin)
            )
            if inside.any():
                return True
        return False


def _overlaps(one: Floats, others: Floats) -> Floats:
    """Whether a rectangle [6] overlaps others [N, 6]: they do not when an axis separates them."""
    dx, dy = others[:, 0] - one[0], others[:, 1] - one[1]
    c, s = others[:, 2], others[:, 3]
    # Cosine and sine between the two directions.
    cd, sd = np.abs(c * one[2] + s * one[3]), np.abs(c * one[3] - s * one[2])
    own_u, own_v = np.abs(dx * one[2] + dy * one[3]), np.abs(-dx * one[3] + dy * one[2])
    their_u, their_v = np.abs(dx * c + dy * s), np.abs(-dx * s + dy * c)
    apart = own_u > one[4] + others[:, 4] * cd + others[:, 5] * sd
    apart |= own_v > one[5] + others[:, 4] * sd + others[:, 5] * cd
    apart |= their_u > others[:, 4] + one[4] * cd + one[5] * sd
    apart |= their_v > others[:, 5] + one[4] * sd + one[5] * cd
    found: Floats = ~apart
    return found
