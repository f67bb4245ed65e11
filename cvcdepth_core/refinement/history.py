# SPDX-License-Identifier: Apache-2.0
"""Earlier pictures of the same cameras: which are kept, and which of them tell most of depth now."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.refinement.moments import GridSet, View
from cvcdepth_core.rig.poses import Pose

_LEAST_STEP = 0.1
_FARTHEST = 6.0
_LONGEST_NS = 3 * 10**9
_SPREAD_NS = 2 * 10**8  # by which a set without its last camera may seem earlier than the one before
_FASTEST = 100.0  # metres per second; what moves faster has jumped


class _Kept(NamedTuple):
    time_ns: int
    grid: GridSet
    present: NDArray[np.bool_]


class History:
    """The last sets' pictures, newest first: a set for every 0.1 m of the way, none older than 3 s or 6 m.

    So its memory does not grow, and while the vehicle stands it forgets where it came from after 3 s.
    """

    def __init__(self) -> None:
        self._sets: deque[_Kept] = deque()

    def __len__(self) -> int:
        return len(self._sets)

    def advance(self, grid: GridSet, present: NDArray[np.bool_], time_ns: int) -> None:
        """Forget what is of no use to a set: what lies too far back, or everything where it cannot follow the last.

        It cannot when the rig or the grid is another one, time has gone back, or the vehicle is somewhere else.
        """
        now = _Kept(time_ns, grid, present)
        if self._sets and not _follows(now, self._sets[0]):
            self._sets.clear()
        while self._sets and _is_over(self._sets[-1], now):
            self._sets.pop()

    def add(self, grid: GridSet, present: NDArray[np.bool_], time_ns: int) -> None:
        """Keep a set that `advance` has let in, unless the vehicle has hardly moved."""
        now = _Kept(time_ns, grid, present)
        if not self._sets or _distances(self._sets[0], now).max(initial=0.0) >= _LEAST_STEP:
            self._sets.appendleft(now)

    def sources(self, camera: int, world_T_camera: Pose, distances: Sequence[float]) -> list[View]:
        """Return for each distance (m) the camera's newest picture from at least that far away, each picture once."""
        found: list[_Kept] = []
        for distance in distances:
            for kept in self._sets:
                away = np.linalg.norm(kept.grid.world_T_camera[camera, :3, 3] - world_T_camera[:3, 3])
                if kept.present[camera] and away >= distance:
                    found += [] if any(kept is other for other in found) else [kept]
                    break
        return [kept.grid.view(camera) for kept in found]

    def clear(self) -> None:
        """Forget everything."""
        self._sets.clear()


def _follows(now: _Kept, last: _Kept) -> bool:
    same = now.grid.grey.shape == last.grid.grey.shape
    same = same and np.array_equal(now.grid.intrinsics, last.grid.intrinsics)
    if not same or not np.array_equal(now.grid.base_T_camera, last.grid.base_T_camera):
        return False
    elapsed = now.time_ns - last.time_ns
    moved = _distances(last, now).max(initial=0.0) if now.grid.placed else 0.0
    return bool(elapsed > -_SPREAD_NS and moved <= _FASTEST * max(elapsed / 1e9, 0.1))


def _is_over(kept: _Kept, now: _Kept) -> bool:
    too_old = now.time_ns - kept.time_ns > _LONGEST_NS
    return too_old or (now.grid.placed and bool(_distances(kept, now).min(initial=np.inf) > _FARTHEST))


def _distances(one: _Kept, other: _Kept) -> NDArray[np.float64]:
    """Return how far the cameras that gave pictures both times have moved, in metres."""
    both = one.present & other.present
    moved = one.grid.world_T_camera[both, :3, 3] - other.grid.world_T_camera[both, :3, 3]
    return np.asarray(np.linalg.norm(moved, axis=1))
