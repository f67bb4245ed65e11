# SPDX-License-Identifier: Apache-2.0
"""How old by ROS time what carries a stamp is, where that can be known. No ROS here."""

import threading
import time
from collections.abc import Callable

from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.surround_sets.latencies import StageLatencies

_MOST_SECONDS = 60.0
"""An older one was recorded, or the two clocks have nothing to do with each other."""
_AFTER_JUMP_SECONDS = 1.0


class StampAges:
    """Records ages as latencies, and says of which stages none is known: a recording has other times than the node.

    Thread-safe.
    """

    def __init__(
        self,
        latencies: StageLatencies,
        ros_time: Callable[[], int],  # ns, 0 while it is not known
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._latencies = latencies
        self._ros_time = ros_time
        self._clock = clock
        self._newest: dict[tuple[str, str], int] = {}
        self._known_from = 0.0
        self._known: dict[str, bool] = {}
        self._lock = threading.Lock()

    def record(self, stage: str, source: str, time_ns: int) -> None:
        """Record how old something of this time is; the times of one `source` ascend, but where a recording loops.

        Where they go back, the node's time follows a moment later or before: until then ages mean nothing.
        """
        now = self._ros_time()
        age = (now - time_ns) / NANOSECONDS
        with self._lock:
            if time_ns < self._newest.get((stage, source), time_ns):
                self._known_from = self._clock() + _AFTER_JUMP_SECONDS
            self._newest[stage, source] = time_ns
            is_known = now > 0 and 0 <= age <= _MOST_SECONDS and self._clock() >= self._known_from
            self._known[stage] = self._known.get(stage, False) or is_known
        if is_known:
            self._latencies.record(stage, age)

    @property
    def unknown(self) -> list[str]:
        """The stages of which no age is known."""
        with self._lock:
            return [stage for stage, is_known in self._known.items() if not is_known]
