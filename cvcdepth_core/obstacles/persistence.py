# SPDX-License-Identifier: Apache-2.0
"""Points that earlier sets have shown too: what flickers from one picture to the next is left out of clouds."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.pointcloud import Cloud, cube_numbers

_EDGE = 0.5  # metres of the cubes in which sets are compared
_LONGEST_NS = 10**9  # between two sets that are compared
_SHIFTS = (0.0, 0.25)  # of two grids of cubes: what lies near the side of one is in the middle of the other


class Persistence:
    """Remembers the last sets' cubes, in the world in which the vehicle moves."""

    def __init__(self) -> None:
        """Begin without any."""
        self._earlier: deque[list[NDArray[np.uint64]]] = deque()
        self._last_ns: int | None = None

    def filtered(self, points: Cloud, world_T_base: NDArray[np.float64] | None, time_ns: int, sets: int) -> Cloud:
        """Return the points [M, 3 or more] of the base frame near which each of the last `sets` sets had one too.

        All of them while fewer sets are known, and where the vehicle's place [4, 4] is not.
        """
        is_late = self._last_ns is not None and not 0 < time_ns - self._last_ns <= _LONGEST_NS
        if world_T_base is None or is_late:
            self._earlier.clear()
        self._last_ns = time_ns
        if world_T_base is None:
            return points
        cubes = self._cubes(points, world_T_base)
        seen = np.ones(len(points), dtype=np.bool_)
        if len(self._earlier) >= sets:
            for earlier in list(self._earlier)[-sets:]:
                seen &= np.logical_or(*(np.isin(own, other) for own, other in zip(cubes, earlier, strict=True)))
        self._earlier.append([np.unique(numbers) for numbers in cubes])
        while len(self._earlier) > sets:
            self._earlier.popleft()
        return points[seen]

    @staticmethod
    def _cubes(points: Cloud, world_T_base: NDArray[np.float64]) -> list[NDArray[np.uint64]]:
        rotation, place = world_T_base[:3, :3].astype(np.float32), world_T_base[:3, 3]
        in_world = points[:, :3] @ rotation.T
        # Far from the world's origin single precision would blur the cubes.
        whole, rest = np.divmod(place, _EDGE * 2)
        return [
            cube_numbers(in_world + (rest + shift).astype(np.float32), _EDGE, (2 * whole).astype(np.int64))
            for shift in _SHIFTS
        ]
