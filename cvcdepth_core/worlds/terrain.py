# SPDX-License-Identifier: Apache-2.0
"""The height of the ground everywhere, and the mesh of what is not paved."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cvcdepth_core.worlds.description import Bank, Ground, Road
from cvcdepth_core.worlds.paths import Path, eased
from cvcdepth_core.worlds.shapes.meshes import Floats
from cvcdepth_core.worlds.surfaces.noise import Noise, noise

_FADE = 7.0  # metres from another road, over which a bank is levelled
_ROUND = 2.0  # metres over which a bank begins


@dataclass(frozen=True, eq=False)
class Corridor:
    """A road's place: its middle, and how far it is paved to either side."""

    path: Path
    road: Road
    left: float
    """Metres from the middle to the outer edge of the pavement."""
    right: float
    """Likewise, positive."""

    @classmethod
    def of_road(cls, road: Road) -> Corridor:
        """Build it from a road's description."""
        x, y, direction = road.start
        path = Path((x, y, math.radians(direction)), eased(road.bends))
        half = road.lanes * road.lane_width / 2
        return cls(path, road, half + road.edge[0] + road.pavement[0], half + road.edge[1] + road.pavement[1])

    @property
    def carriageway(self) -> tuple[float, float]:
        """Return l of the right and of the left edge of the carriageway."""
        half = self.road.lanes * self.road.lane_width / 2
        return -half - self.road.edge[1], half + self.road.edge[0]

    def depth(self, points: Floats) -> Floats:
        """How far points [N, 2] lie inside the paved part, metres; negative outside."""
        s, left = self.path.locate(points)
        inside = np.where(left > 0, self.left - left, self.right + left)
        # Roads end where the modelled ground does.
        return np.minimum(inside, np.minimum(s, self.path.length - s) + 1.0)


class Terrain:
    """The ground's height, with roads laid on it."""

    def __init__(self, ground: Ground, corridors: list[Corridor]) -> None:
        self.ground = ground
        self.corridors = corridors

    def height(self, points: Floats) -> Floats:
        """Return z [N] at x, y [N, 2]; roads lie on it."""
        x, y = points.T
        z = np.zeros(len(points))
        for wave in self.ground.waves:
            along = x * math.cos(math.radians(wave.direction)) + y * math.sin(math.radians(wave.direction))
            phase = math.radians(wave.phase)
            z += wave.height * (np.sin(2 * math.pi * along / wave.wavelength + phase) - math.sin(phase))
        for number, corridor in enumerate(self.corridors):
            if any(corridor.road.banks):
                z += self._banks(number, points)
        return z + self._roughness(points) if self.ground.rough else z

    def _roughness(self, points: Floats) -> Floats:
        """Small unevenness, which begins beside the roads."""
        away = np.full(len(points), np.inf)
        for corridor in self.corridors:
            away = np.minimum(away, -corridor.depth(points))
        x, y = points.T
        value = noise(Noise.CLOUDY, 2.5 * x, 2.5 * y, np.full(len(points), 3.0))
        return 0.3 * self.ground.rough * np.clip(away / 5.0, 0.0, 1.0) * value

    def at(self, x: float, y: float) -> float:
        """Return z at one place."""
        return float(self.height(np.array([[x, y]]))[0])

    def _banks(self, number: int, points: Floats) -> Floats:
        corridor = self.corridors[number]
        s, left = corridor.path.locate(points)
        rise = np.zeros(len(points))
        edges = (corridor.left, corridor.right)
        for side, bank, edge in zip((1.0, -1.0), corridor.road.banks, edges, strict=True):
            if bank is not None:
                rise += _bank_rise(bank, side * left - edge)
        ends = np.clip(np.minimum(s, corridor.path.length - s) / _FADE, 0.0, 1.0)
        for other in (c for c in self.corridors if c is not corridor):
            rise *= np.clip(-other.depth(points) / _FADE, 0.0, 1.0)
        return rise * ends


def _bank_rise(bank: Bank, outward: Floats) -> Floats:
    beyond = np.maximum(outward - bank.setback, 0.0)
    rise = bank.gradient * beyond * beyond / (beyond + _ROUND)
    return np.clip(rise, -bank.height, bank.height)
