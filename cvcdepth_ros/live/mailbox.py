# SPDX-License-Identifier: Apache-2.0
"""A mailbox of depth one between the thread that receives images and the one that runs inference: newest set wins.

A slow consumer must work on the newest set, not on a growing backlog. A set that is replaced before it was read, or
that is too old when it is read (freshness gate), is dropped and counted. Where a recording loops, sets of the new round
may come before the clock has gone back: for a second they are old by that clock and taken all the same.
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.stamps import NANOSECONDS, to_nanoseconds
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

T = TypeVar("T")

_JUMP_NS = NANOSECONDS


@dataclass(frozen=True)
class MailboxStatistics:
    """Counts of the sets: received = delivered + replaced + stale + after_close + one that may be waiting."""

    received: int = 0
    delivered: int = 0
    replaced: int = 0  # a newer set took its place
    stale: int = 0  # older than max_age when it was to be delivered
    after_close: int = 0  # put after `close`, or still unread then


class Mailbox(Generic[T]):
    """Holds at most one SurroundSet. Thread-safe; the clock is called outside the lock."""

    def __init__(
        self,
        max_age: float | None = None,  # s between the anchor's exposure and now; None: any age
        clock: Callable[[], int] = time.time_ns,  # ns, of the clock that stamped the images (ROS time in the node)
    ) -> None:
        """Raise ConfigError if max_age is not a positive number of seconds."""
        if max_age is not None and not (math.isfinite(max_age) and max_age > 0):
            raise ConfigError(f"max_age: expected a positive number of seconds, found {max_age!r}")
        self._max_age = None if max_age is None else to_nanoseconds(max_age)
        self._clock = clock
        self._waiting: SurroundSet[T] | None = None
        self._last_sequence = -1
        self._closed = False
        self._statistics = MailboxStatistics()
        self._stale_age: float | None = None
        self._last_time = 0
        self._was_fresh = False
        self._now_at_jump: int | None = None
        self._changed = threading.Condition()

    @property
    def stale_age(self) -> float | None:
        """Age in seconds of the last set that was dropped because of it; None when none was."""
        return self._stale_age

    @property
    def closed(self) -> bool:
        """Whether `close` was called: distinguishes a None of `get` from a timeout."""
        return self._closed

    def put(self, surround_set: SurroundSet[T]) -> bool:
        """Store the set in place of a waiting one; False if it was not stored: closed, or a newer set came before it.

        The sequence number decides which is newer: two threads may hand over in the wrong order, and stamps may repeat.
        """
        with self._changed:
            self._count("received")
            if self._closed:
                self._count("after_close")
                return False
            if surround_set.sequence < self._last_sequence:
                self._count("replaced")
                return False
            if self._waiting is not None:
                self._count("replaced")
            self._waiting, self._last_sequence = surround_set, surround_set.sequence
            self._changed.notify()
            return True

    def get(self, timeout: float | None = None) -> SurroundSet[T] | None:
        """Wait for a set that is fresh; None after `timeout` seconds (None: no limit), or as soon as closed."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while (surround_set := self._take(deadline)) is not None:
            now = self._clock()
            age = now - surround_set.time_ns
            fresh = self._max_age is None or self._is_fresh(surround_set.time_ns, now, self._max_age)
            with self._changed:
                self._count("delivered" if fresh else "stale")
                if not fresh:
                    self._stale_age = age / NANOSECONDS
            if fresh:
                return surround_set
        return None

    def close(self) -> None:
        """Wake every waiting `get` with None and refuse what is put from now on."""
        with self._changed:
            if self._waiting is not None:
                self._count("after_close")
            self._waiting = None
            self._closed = True
            self._changed.notify_all()

    def statistics(self) -> MailboxStatistics:
        """Snapshot of the counters."""
        with self._changed:
            return self._statistics

    def _is_fresh(self, time_ns: int, now: int, max_age: int) -> bool:
        """Whether a set is young enough, or its time has gone back and the clock of fresh sets is still to follow."""
        if self._was_fresh and self._last_time - time_ns > max_age:
            self._now_at_jump = now
        is_jump = self._now_at_jump is not None and 0 <= now - self._now_at_jump < _JUMP_NS
        self._last_time, self._was_fresh = time_ns, now - time_ns <= max_age
        return self._was_fresh or is_jump

    def _take(self, deadline: float | None) -> SurroundSet[T] | None:
        with self._changed:
            remaining = None if deadline is None else max(0.0, deadline - time.monotonic())
            self._changed.wait_for(lambda: self._waiting is not None or self._closed, remaining)
            surround_set, self._waiting = self._waiting, None
            return surround_set

    def _count(self, counter: str) -> None:
        self._statistics = replace(self._statistics, **{counter: getattr(self._statistics, counter) + 1})
