# SPDX-License-Identifier: Apache-2.0
"""A quantity followed over time: what it is now, and what is normal for it."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.stamps import NANOSECONDS

_LEAST = 4
"""Measurements that are averaged, where there are so many."""


class Trend:
    """Mean of the last seconds, and baseline: a slow mean that is not updated while the quantity is abnormal.

    A single set's streets can favour another value than the average of many: where measurements are rare, because sets
    are, the mean goes back further than its seconds.
    """

    def __init__(self, window: float, baseline: float, learning: float) -> None:
        """Average over `window` seconds, and for the baseline over `baseline`; it is known after `learning` of them."""
        self._window = window
        self._baseline_seconds = baseline
        self._learning = learning
        self._recent: deque[tuple[int, NDArray[np.float64]]] = deque()
        self._learnt = 0.0  # seconds
        self._updates_without = 0
        self.measurements = 0
        """How often it was measured."""
        self.now: NDArray[np.float64] | None = None
        """Mean of the last seconds; None without a measurement in them."""
        self.baseline: NDArray[np.float64] | None = None
        """What is normal; None before the first measurement."""

    @property
    def is_learnt(self) -> bool:
        """Whether it was measured for long enough, and often enough, to know the baseline."""
        return self._learnt >= self._learning and self.measurements >= 2 * _LEAST

    def add(self, stamp: int, value: NDArray[np.float64], is_normal: bool) -> None:
        """Take in one measurement; `is_normal` says whether the baseline may learn from it."""
        self.measurements += 1
        self._updates_without = 0
        seconds = (stamp - self._recent[-1][0]) / NANOSECONDS if self._recent else 0.0
        self._recent.append((stamp, value))
        while len(self._recent) > _LEAST and stamp - self._recent[0][0] > self._window * NANOSECONDS:
            self._recent.popleft()
        self.now = np.mean([recent for _, recent in self._recent], axis=0)
        if is_normal or not self.is_learnt:
            self._learn(value, min(seconds, self._window))

    def age(self, stamp: int, updates: int) -> None:
        """Forget the recent seconds when they are over and so many updates brought no measurement: that is not now."""
        self._updates_without += 1
        is_over = self._recent and stamp - self._recent[-1][0] > self._window * NANOSECONDS
        if is_over and self._updates_without > updates:
            self.forget_recent()

    def forget_recent(self) -> None:
        """Begin the recent seconds anew."""
        self._recent.clear()
        self.now = None

    def _learn(self, value: NDArray[np.float64], seconds: float) -> None:
        """Renew the baseline: a plain mean at first, which becomes a slow one."""
        self._learnt += seconds
        if self.baseline is None:
            self.baseline = value
            return
        share = min(1.0, seconds / min(self._baseline_seconds, max(self._learnt, 1e-9)))
        self.baseline = (1 - share) * self.baseline + share * value
