# SPDX-License-Identifier: Apache-2.0
"""The nearest obstacle in every direction, as a planar laser scanner at the base frame would tell it (REP 117)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.obstacles.separation import SeparatedCloud

_MOST_GROUND = 20000  # points, about, of which the directions in which ground is seen are taken


@dataclass(frozen=True)
class ScanLimits:
    """The scanner that is imitated."""

    resolution: float = 0.5
    """Degrees between two beams; the circle has the nearest whole number of them."""
    min_range: float = 0.0
    """Metres from the base frame; nearer obstacles are left out."""

    @property
    def beams(self) -> int:
        """How many beams there are."""
        return max(round(360.0 / self.resolution), 1)


@dataclass(frozen=True, eq=False)
class Scan:
    """Distances all around, counter-clockwise from behind; beam i takes what lies within half a step of its angle."""

    ranges: NDArray[np.float32]
    """[K] metres; inf where ground is seen and no obstacle, NaN where nothing is seen."""
    range_min: float
    range_max: float

    @property
    def increment(self) -> float:
        """Radians between two beams."""
        return 2 * math.pi / len(self.ranges)

    @property
    def angle_min(self) -> float:
        """Of the first beam, radians."""
        return -math.pi + self.increment / 2


def scan_of(cloud: SeparatedCloud, limits: ScanLimits, max_range: float) -> Scan:
    """Return the nearest obstacle in every direction, up to `max_range` metres."""
    beams = limits.beams
    ranges = np.full(beams, np.nan, dtype=np.float32)
    ground = np.flatnonzero(cloud.is_ground)
    ranges[_beams_of(cloud.points[ground[:: max(len(ground) // _MOST_GROUND, 1)]], beams)] = np.inf
    obstacles = cloud.obstacles
    distances = np.hypot(obstacles[:, 0], obstacles[:, 1])
    inside = (distances >= limits.min_range) & (distances <= max_range)
    obstacles, distances = obstacles[inside], distances[inside]
    nearest = np.full(beams, np.inf, dtype=np.float32)
    beam = _beams_of(obstacles, beams)
    np.minimum.at(nearest, beam, distances)
    ranges[beam] = nearest[beam]
    return Scan(ranges, limits.min_range, max_range)


def _beams_of(points: NDArray[np.float32], beams: int) -> NDArray[np.int64]:
    """Return the beam [M] of each point."""
    x, y = points[:, :2].T.astype(np.float64)
    share = np.arctan2(y, x) / (2 * np.pi) + 0.5
    return np.asarray(np.clip((share * beams).astype(np.int64), 0, beams - 1))
