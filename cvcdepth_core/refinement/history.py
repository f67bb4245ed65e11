# SPDX-License-Identifier: Apache-2.0
"""Earlier pictures of the same cameras: which are kept, and which of them tell most of depth now."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cvcdepth_core.refinement.moments import GridSet
from cvcdepth_core.refinement.plane_sweep import View

_LEAST_STEP = 0.1
_FARTHEST = 6.0
_LONGEST_NS = 3 * 10**9
_FASTEST = 100.0  # metres per second; what moves faster has jumped


class _Kept(NamedTuple):
    time_ns: int
    grey: Tensor
    intrinsics: NDArray[np.float64]
    world_T_camera: NDArray[np.float64]
    present: NDArray[np.bool_]


class History:
    """The last sets' pictures, newest first: a set for every 0.1 m of the way, none older than 3 s or 6 m.

    So its memory does not grow, and while the vehicle stands it forgets where it came from after 3 s.
    """

    def __init__(self) -> None:
        self._sets: deque[_Kept] = deque()

    def __len__(self) -> int:
        return len(self._sets)

    def add(self, grid: GridSet, present: NDArray[np.bool_], time_ns: int) -> None:
        """Keep a set unless the vehicle has hardly moved; forget what lies too far back."""
        position = grid.world_T_camera[:, :3, 3]
        while self._sets and _is_over(self._sets[-1], position, time_ns):
            self._sets.pop()
        if not self._sets or _distances(self._sets[0], position).max() >= _LEAST_STEP:
            kept = _Kept(time_ns, grid.grey, grid.intrinsics, grid.world_T_camera, present)
            self._sets.appendleft(kept)

    def fits(self, grid: GridSet, time_ns: int) -> bool:
        """Return whether a set can follow what is kept: the same cameras and grid, later, and not somewhere else."""
        if not self._sets:
            return True
        last = self._sets[0]
        same = last.grey.shape == grid.grey.shape and np.array_equal(last.intrinsics, grid.intrinsics)
        seconds = (time_ns - last.time_ns) / 1e9
        moved = _distances(last, grid.world_T_camera[:, :3, 3]).max() if same else np.inf
        return bool(same and seconds > 0 and moved <= _FASTEST * max(seconds, 0.1))

    def sources(self, camera: int, world_T_camera: NDArray[np.float64], distances: Sequence[float]) -> list[View]:
        """Return for each distance (m) the camera's newest picture from at least that far away, each picture once."""
        here = world_T_camera[camera, :3, 3]
        found: list[_Kept] = []
        for distance in distances:
            for kept in self._sets:
                away = np.linalg.norm(kept.world_T_camera[camera, :3, 3] - here)
                if kept.present[camera] and away >= distance:
                    found += [] if any(kept is other for other in found) else [kept]
                    break
        return [View(kept.grey[camera], kept.intrinsics[camera], kept.world_T_camera[camera]) for kept in found]

    def clear(self) -> None:
        """Forget everything."""
        self._sets.clear()


def _distances(kept: _Kept, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far each camera [N] was then from its `position` [N, 3] now, in metres."""
    away: NDArray[np.float64] = np.linalg.norm(kept.world_T_camera[:, :3, 3] - position, axis=1)
    return away


def _is_over(kept: _Kept, position: NDArray[np.float64], time_ns: int) -> bool:
    return time_ns - kept.time_ns > _LONGEST_NS or bool(_distances(kept, position).min() > _FARTHEST)
