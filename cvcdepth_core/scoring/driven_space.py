# SPDX-License-Identifier: Apache-2.0
"""Free space by the later way: where the vehicle itself has driven, nothing can have stood that did not move."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_HALF_WIDTH, _HALF_LENGTH = 0.8, 1.0  # metres around the base frame that any car takes, at least
_LEAST_WAY = 2.0  # metres: nearer, the vehicle's own body and what is beside it decide
_LONGEST_NS = 10 * 10**9


class _Earlier(NamedTuple):
    world_T_base: NDArray[np.float64]
    taken: NDArray[np.float64]  # [K, 2] squares in its base frame
    time_ns: int


class DrivenSpace:
    """Compares the squares that sets called taken with the places that the vehicle came to later."""

    def __init__(self, ranges: Sequence[float]) -> None:
        """Count within each of `ranges`, metres, of which the last is the largest."""
        self._ranges = np.array(ranges)
        self._counts = np.zeros((len(ranges), 2), np.int64)
        self._earlier: deque[_Earlier] = deque()

    def add(self, world_T_base: NDArray[np.float64], taken: NDArray[np.float64], time_ns: int) -> None:
        """Add the next set: where the vehicle is [4, 4], and the middles [K, 2] of squares called taken from there."""
        if self._earlier and time_ns <= self._earlier[-1].time_ns:
            self._earlier.clear()
        while self._earlier and time_ns - self._earlier[0].time_ns > _LONGEST_NS:
            self._earlier.popleft()
        for earlier in self._earlier:
            self._compare(earlier, world_T_base)
        self._earlier.append(_Earlier(world_T_base, taken, time_ns))

    def counts(self) -> NDArray[np.int64]:
        """Return [R, 2] the later places within each range, and those of them where something was said to stand."""
        return np.array(self._counts)

    def _compare(self, earlier: _Earlier, world_T_base: NDArray[np.float64]) -> None:
        now_T_then = np.linalg.inv(world_T_base) @ earlier.world_T_base
        way = float(np.hypot(*now_T_then[:2, 3]))
        if not _LEAST_WAY <= way <= self._ranges[-1]:
            return
        squares = earlier.taken @ now_T_then[:2, :2].T + now_T_then[:2, 3]
        under = (np.abs(squares[:, 0]) <= _HALF_LENGTH) & (np.abs(squares[:, 1]) <= _HALF_WIDTH)
        within = way <= self._ranges
        self._counts[within, 0] += 1
        self._counts[within, 1] += int(under.any())
