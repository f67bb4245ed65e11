# SPDX-License-Identifier: Apache-2.0
"""A cloud taken apart: the ground, and what stands on it as high as a vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.obstacles.ground import GroundPlane, fit_ground


@dataclass(frozen=True)
class ObstacleLimits:
    """What is an obstacle."""

    min_height: float = 0.3
    """Metres above the ground; lower points are ground."""
    max_height: float = 2.0
    """Metres above the ground; the vehicle fits below higher points."""
    max_range: float = 40.0
    """Metres around the base frame; farther points are neither ground nor obstacles."""


@dataclass(frozen=True, eq=False)
class SeparatedCloud:
    """A cloud [M, C] and what its points are."""

    points: NDArray[np.float32]
    """[M, C] x, y, z in metres in the base frame, and what else belongs to a point."""
    plane: GroundPlane
    is_ground: NDArray[np.bool_]
    """[M] at the ground's height, or below it."""
    is_obstacle: NDArray[np.bool_]
    """[M]."""

    @property
    def ground(self) -> NDArray[np.float32]:
        """The points of the ground."""
        return self.points[self.is_ground]

    @property
    def obstacles(self) -> NDArray[np.float32]:
        """The points of obstacles."""
        return self.points[self.is_obstacle]


def separate(points: NDArray[np.float32], ground_height: float, limits: ObstacleLimits) -> SeparatedCloud:
    """Take a cloud of the base frame apart; `ground_height` is the rig's, z in metres."""
    plane = fit_ground(points, ground_height)
    columns = np.ascontiguousarray(points[:, :3].T).T  # each axis by itself: numpy goes through it twice as quickly
    heights = plane.heights(columns)
    near = columns[:, 0] ** 2 + columns[:, 1] ** 2 <= np.float32(limits.max_range**2)
    low = heights < limits.min_height
    return SeparatedCloud(points, plane, near & low, near & ~low & (heights <= limits.max_height))
