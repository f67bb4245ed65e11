# SPDX-License-Identifier: Apache-2.0
"""The state of each camera: waiting, healthy, or why its images cannot be used. No ROS here.

A camera's images are watched as they arrive; `CameraWatch.troubles` is polled by a timer, so that silence is noticed
too.
"""

import math
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

_INTERVALS = 9
_SLOW_CAMERA_INTERVALS = 3
_REPEATS_OF_A_FROZEN_CAMERA = 3
_UNMATCHED_SECONDS, _UNMATCHED_INTERVALS = 3.0, 10
_COMPARED_FIRST = 4096  # bytes


class CameraState(Enum):
    """States of a camera, the most specific trouble first."""

    REJECTED = "rejected"
    """Its images, its CameraInfo or its QoS cannot be used."""
    FROZEN = "frozen"
    """It sends the same stamp or the same picture again and again."""
    STALE = "stale"
    """It has sent images and does not any more."""
    WAITING_FOR_CAMERA_INFO = "waiting for camera_info"
    WAITING_FOR_TRANSFORM = "waiting for transform"
    WAITING_FOR_IMAGES = "waiting for images"
    UNMATCHED = "unmatched"
    """Its images fit no set: their stamps are too far from the other cameras'."""
    OK = "ok"


@dataclass(frozen=True)
class CameraCondition:
    """A camera's state with all reasons that are known for it."""

    state: CameraState
    reasons: tuple[str, ...] = ()
    """The reason for the state itself first."""

    @property
    def text(self) -> str:
        """One line: the state, then the reasons."""
        reasons = "; ".join(self.reasons)
        return reasons if reasons.startswith(self.state.value) else ": ".join(filter(None, (self.state.value, reasons)))


Trouble = tuple[CameraState, str]
"""A state and the reason for it."""


class CameraWatch:
    """Watches one camera's images as they come in. Thread-safe."""

    def __init__(
        self,
        stale_after: float,  # s without an image
        frozen_after: float,  # s with the same picture; 0: never
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Watch a camera; one that is slower than `stale_after` is stale after three of its own intervals instead."""
        self._stale_after = stale_after
        self._frozen_after = frozen_after
        self._clock = clock
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)
        self._last: tuple[int, Any] | None = None
        self._received: float | None = None
        self._changed = 0.0
        self._repeats = 0
        self._refusal, self._refused_at = "", -math.inf
        self._matched, self._matched_at, self._joined_at = 0, 0.0, -math.inf
        self._listening_since = -math.inf
        self._lock = threading.Lock()
        self.refused = 0
        """Images that could not be used."""
        self.repeated = 0
        """Images that were left out because the camera is frozen."""

    def accept(self, stamp: int, content: Any) -> bool:
        """Note an image (its stamp in ns, and its bytes); False when the camera is frozen and it must not be used."""
        now = self._clock()
        is_new = self._last is None or (stamp != self._last[0] and not _same_bytes(content, self._last[1]))
        with self._lock:
            if self._received is not None:
                self._intervals.append(now - self._received)
            else:
                self._matched_at = now
            self._received = now
            self._last = (stamp, content)
            self._repeats = 0 if is_new else self._repeats + 1
            if is_new:
                self._changed = now
            frozen = self._is_frozen()
            self.repeated += frozen
            return not frozen

    def used(self, refusal: str) -> None:
        """Note the outcome of an image: why it could not be used, or an empty string when it could."""
        with self._lock:
            self._refusal = refusal
            if refusal:
                self.refused += 1
                self._refused_at = self._clock()

    def resume_listening(self) -> None:
        """Count silence from now on: images could not be received until now."""
        with self._lock:
            self._listening_since = self._matched_at = self._clock()

    @property
    def seconds_since_image(self) -> float | None:
        """Seconds since the last image came; None before the first."""
        with self._lock:
            return None if self._received is None else self._clock() - self._received

    @property
    def interval(self) -> float:
        """Median seconds between its last images; 0 while unknown."""
        with self._lock:
            return self._interval()

    def troubles(self) -> list[Trouble]:
        """Return what is wrong with its images, their absence included."""
        with self._lock:
            found: list[Trouble] = []
            if self._refusal and not self._is_refusal_outlived():
                found.append((CameraState.REJECTED, self._refusal))
            if self._received is None:
                return [*found, (CameraState.WAITING_FOR_IMAGES, "no image yet")]
            patience = self._patience(self._stale_after)
            if self._clock() - max(self._received, self._listening_since) > patience:
                found.append((CameraState.STALE, f"no image for more than {patience:.2g} s"))
            elif self._is_frozen():
                found.append((CameraState.FROZEN, "the same picture or stamp again and again"))
            return found

    def unmatched(self, matched: int, is_explained: bool = False) -> list[Trouble]:
        """Return UNMATCHED where images come but none has joined a set lately; `matched` counts those that have so far.

        To be asked regularly; `is_explained` when there is another reason for it, which ends at that moment.
        """
        with self._lock:
            if matched != self._matched:
                self._joined_at = self._clock()
            if self._received is None or matched != self._matched or is_explained:
                self._matched, self._matched_at = matched, self._clock()
            if (self._received or 0.0) - self._matched_at > self._matching_patience():
                return [(CameraState.UNMATCHED, "its images come, but their stamps fit no set")]
            return []

    def _is_refusal_outlived(self) -> bool:
        """Say whether images have come for long that fit no set: those are neither used nor refused."""
        judged = max(self._refused_at, self._joined_at)
        return self._received is not None and self._received - judged > self._matching_patience()

    def _is_frozen(self) -> bool:
        if not self._frozen_after or self._received is None or self._repeats < _REPEATS_OF_A_FROZEN_CAMERA:
            return False
        return self._received - self._changed >= self._frozen_after

    def _patience(self, seconds: float) -> float:
        return max(seconds, _SLOW_CAMERA_INTERVALS * self._interval())

    def _matching_patience(self) -> float:
        return max(_UNMATCHED_SECONDS, _UNMATCHED_INTERVALS * self._interval())

    def _interval(self) -> float:
        return statistics.median(self._intervals) if self._intervals else 0.0


def condition(camera: str, troubles: Sequence[Trouble]) -> CameraCondition:
    """Return the condition that a camera's troubles add up to, the most specific first."""
    order = list(CameraState)
    ranked = sorted(troubles, key=lambda trouble: order.index(trouble[0]))
    if not ranked:
        return CameraCondition(CameraState.OK)
    reasons = dict.fromkeys(reason.removeprefix(f"camera {camera}: ") for _, reason in ranked)
    return CameraCondition(ranked[0][0], tuple(reasons))


def _same_bytes(one: Any, other: Any) -> bool:
    """Compare two buffers; those of different pictures mostly differ early."""
    if len(one) != len(other) or memoryview(one)[:_COMPARED_FIRST] != memoryview(other)[:_COMPARED_FIRST]:
        return False
    return np.array_equal(np.frombuffer(one, np.uint8), np.frombuffer(other, np.uint8))
