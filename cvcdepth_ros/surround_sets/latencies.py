# SPDX-License-Identifier: Apache-2.0
"""Durations of the stages that a set passes: the last ones of each, and their percentiles. No ROS here."""

import threading
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvcdepth_ros.surround_sets.trace_file import TraceFile

_WINDOW = 1000


@dataclass(frozen=True)
class StageSummary:
    """Durations of one stage: milliseconds over the last sets, and seconds over all of them."""

    count: int
    p50_ms: float
    p95_ms: float
    max_ms: float
    total_s: float


class StageLatencies:
    """Rolling windows of durations, one per stage, and their sums; spans go into `trace` too. Thread-safe."""

    def __init__(self, trace: TraceFile | None = None) -> None:
        self._trace = trace
        self._windows: dict[str, deque[float]] = {}
        self._totals: defaultdict[str, float] = defaultdict(float)
        self._lock = threading.Lock()

    def record(self, stage: str, seconds: float) -> None:
        """Add one duration."""
        with self._lock:
            self._windows.setdefault(stage, deque(maxlen=_WINDOW)).append(seconds)
            self._totals[stage] += seconds

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Record how long the block takes."""
        start = time.monotonic()
        yield
        end = time.monotonic()
        self.record(stage, end - start)
        self.trace(stage, start, end)

    def trace(self, name: str, start: float, end: float, **arguments: Any) -> None:
        """Put a span between two times of `time.monotonic()` into the trace, if there is one, and there only."""
        if self._trace is not None:
            self._trace.span(name, start, end, **arguments)

    def summaries(self) -> dict[str, StageSummary]:
        """Return the percentiles of every stage, in the order in which the stages first came."""
        with self._lock:
            windows = {stage: (np.array(window) * 1e3, self._totals[stage]) for stage, window in self._windows.items()}
        return {stage: _summary(ms, total) for stage, (ms, total) in windows.items()}


def _summary(ms: NDArray[np.float64], total: float) -> StageSummary:
    p50, p95 = np.percentile(ms, [50, 95]).tolist()
    return StageSummary(ms.size, p50, p95, float(ms.max()), total)
