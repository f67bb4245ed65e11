# SPDX-License-Identifier: Apache-2.0
"""Why images come and no set gets through: what stops them, which camera does, and the remedy. No ROS here."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.surround_sets.synchronizer import CameraStatistics, SynchronizerStatistics

_STALL_SECONDS, _STALL_INTERVALS = 2.0, 5
_WRONG_CLOCK_SECONDS, _WRONG_CLOCK_INTERVALS = 1.0, 5
_HOUR, _DAY, _YEAR = 3600.0, 86400.0, 365.25 * 86400.0
_RECORDED = 60.0
"""Age in seconds of a set beyond which no delay explains it: it was recorded, or clocks are set differently."""

_DELIVERED, _STALE, _SKIPPED = "delivered", "stale", "skipped: rig not complete"
_THROUGH = ("published", "skipped: no subscriber")


@dataclass(frozen=True)
class NodeClock:
    """What is known of the node's time."""

    is_simulated: bool
    """Whether it is taken from /clock."""
    has_publisher: bool
    """Whether anybody publishes /clock."""

    @property
    def problem(self) -> str:
        """Why the node has no time; empty when it has."""
        if not self.is_simulated or self.has_publisher:
            return ""
        return "use_sim_time is true, but nothing publishes /clock: play the recording with --clock"


class SetProgress:
    """Follows the counters of sets, and says where they come to a halt while those before go on."""

    def __init__(
        self,
        required: int,  # cameras without which there is no set
        tolerance: float,  # s between the images of a set
        max_age: float,  # s
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._required, self._tolerance, self._max_age = required, tolerance, max_age
        self._clock = clock
        self._counts: dict[str, int] = {}
        self._changed: dict[str, float] = {}
        self._began = clock()
        self._limit = _STALL_SECONDS
        self._synchroniser = SynchronizerStatistics(0, {})
        self._at_last_set: Mapping[str, CameraStatistics] = {}

    def update(self, synchroniser: SynchronizerStatistics, counts: Mapping[str, int]) -> None:
        """Take the counters as they stand; `counts` are the mailbox's and the pipeline's. To be called regularly."""
        periods = [camera.period_ns or 0 for camera in synchroniser.cameras.values()]
        self._limit = max(_STALL_SECONDS, _STALL_INTERVALS * max(periods, default=0) / NANOSECONDS)
        received = {_received(name): camera.received for name, camera in synchroniser.cameras.items()}
        through = sum(counts.get(name, 0) for name in _THROUGH)
        for name, count in {**counts, **received, "matched": synchroniser.sets, "through": through}.items():
            if self._counts.get(name, 0) != count:
                self._changed[name] = self._clock()
            self._counts[name] = count
        if synchroniser.sets != self._synchroniser.sets or not self._at_last_set:
            self._at_last_set = synchroniser.cameras
        self._synchroniser = synchroniser

    @property
    def is_matching(self) -> bool:
        """Whether sets come, or no images do."""
        return not self._sending() or not self._stands("matched")

    def problem(self, reasons: Mapping[str, str], node_clock: NodeClock, age: float | None) -> str:
        """Return why no set gets through and what helps; empty while they do, or no images come.

        `reasons` has what is wrong with the cameras that are not ok; `age` is the last stale set's, in seconds.
        """
        if not self.is_matching:
            return self._why_unmatched(reasons)
        if self._goes_on(_STALE) and self._stands(_DELIVERED):
            told = "" if age is None else f", by {_duration(age)}"
            remedy = _age_remedy(age, node_clock)
            return f"every set is older than max_age ({self._max_age:g} s) in the node's time{told}: {remedy}"
        if self._goes_on(_SKIPPED) and self._stands("through"):
            return f"sets are skipped: too few cameras are complete: {_listed(reasons)}"
        return ""

    def _goes_on(self, name: str) -> bool:
        return name in self._changed and self._idle(name) < self._limit

    def _stands(self, name: str) -> bool:
        return self._idle(name) >= self._limit

    def _idle(self, name: str) -> float:
        return self._clock() - self._changed.get(name, self._began)

    def _sending(self) -> list[str]:
        return [name for name in self._synchroniser.cameras if self._goes_on(_received(name))]

    def _why_unmatched(self, reasons: Mapping[str, str]) -> str:
        cameras = {name: self._synchroniser.cameras[name] for name in self._sending()}
        if len(cameras) < self._required:
            silent = self._synchroniser.cameras.keys() - cameras.keys()
            told = {name: reasons.get(name, "no image comes") for name in self._synchroniser.cameras if name in silent}
            advice = f"; min_cameras:={len(cameras)} goes on without" if len(cameras) > 1 else ""
            return f"no set: {self._required} cameras are needed: {_listed(told)}{advice}"
        return f"no set: {self._wrong_clocks(cameras) or self._apart(cameras) or 'the stamps fit no set'}"

    def _wrong_clocks(self, cameras: Mapping[str, CameraStatistics]) -> str:
        """Name the cameras whose stamps are far from most others'."""
        newest = {name: camera.newest_ns for name, camera in cameras.items() if camera.newest_ns is not None}
        if not newest:
            return ""
        usual = statistics.median_low(newest.values())
        interval = statistics.median_low([camera.period_ns or 0 for camera in cameras.values()]) / NANOSECONDS
        limit = max(_WRONG_CLOCK_SECONDS, self._tolerance, _WRONG_CLOCK_INTERVALS * interval)
        ahead = {name: (stamp - usual) / NANOSECONDS for name, stamp in newest.items()}
        wrong = [
            f"camera {name}'s stamps are {_duration(abs(s))} {'ahead of' if s > 0 else 'behind'} the others'"
            for name, s in ahead.items()
            if abs(s) > limit
        ]
        return f"{', '.join(wrong)}: set its clock, or stamp_offset in the rig file" if wrong else ""

    def _apart(self, cameras: Mapping[str, CameraStatistics]) -> str:
        """Name the cameras whose nearest images were too far from the anchor's, with the distance."""
        lacked = {name: c.lacked - self._lacked_before(name) for name, c in cameras.items() if c.gap_ns is not None}
        most = max(lacked.values(), default=0)
        found = {name: (cameras[name].gap_ns or 0) / NANOSECONDS for name, n in lacked.items() if 2 * n > most > 0}
        if not found:
            return ""
        told = ", ".join(f"camera {name}'s nearest by {_duration(abs(s))}" for name, s in found.items())
        return (
            f"images are farther from the anchor's than tolerance ({self._tolerance:g} s) allows: {told}; raise "
            "tolerance, or set stamp_offset in the rig file"
        )

    def _lacked_before(self, name: str) -> int:
        return self._at_last_set[name].lacked if name in self._at_last_set else 0


def _age_remedy(age: float | None, clock: NodeClock) -> str:
    if clock.is_simulated:
        return "/clock is another recording's, or runs ahead of the images"
    if age is not None and age < _RECORDED:
        return "the network or the way to it is too slow, or clocks differ; raise max_age"
    if clock.has_publisher:
        return "a recording is played; start the node with -p use_sim_time:=true"
    return (
        "do the clocks agree? A recording is to be played with --clock, and the node started with "
        "-p use_sim_time:=true; -p max_age:=0.0 takes any age"
    )


def _duration(seconds: float) -> str:
    """Return a time in a unit that makes it short."""
    for unit, size in (("years", _YEAR), ("days", _DAY), ("hours", _HOUR)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.3f} s" if seconds < 1 else f"{seconds:.1f} s"


def _received(camera: str) -> str:
    return f"received: {camera}"


def _listed(reasons: Mapping[str, str]) -> str:
    return "; ".join(f"camera {name}: {reason}" for name, reason in reasons.items())
