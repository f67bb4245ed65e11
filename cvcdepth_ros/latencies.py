# SPDX-License-Identifier: Apache-2.0
"""Where a set's time goes: the last durations of each named stage, and their percentiles. No ROS here."""

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

_WINDOW = 1000


@dataclass(frozen=True)
class StageSummary:
    """Milliseconds over the last sets of one stage."""

    count: int
    p50_ms: float
    p95_ms: float
    max_ms: float


class StageLatencies:
    """Rolling windows of durations, one per stage. Thread-safe."""

    def __init__(self) -> None:
        self._windows: dict[str, deque[float]] = {}
        self._lock = threading.Lock()

    def record(self, stage: str, seconds: float) -> None:
        """Add one duration."""
        with self._lock:
            self._windows.setdefault(stage, deque(maxlen=_WINDOW)).append(seconds)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Record how long the block takes."""
        start = time.monotonic()
        yield
        self.record(stage, time.monotonic() - start)

    def summaries(self) -> dict[str, StageSummary]:
        """Return the percentiles of every stage, in the order in which the stages first came."""
        with self._lock:
            windows = {stage: np.array(window) * 1e3 for stage, window in self._windows.items()}
        return {
            stage: StageSummary(ms.size, float(np.percentile(ms, 50)), float(np.percentile(ms, 95)), float(ms.max()))
            for stage, ms in windows.items()
        }
