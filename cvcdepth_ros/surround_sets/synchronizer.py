# SPDX-License-Identifier: Apache-2.0
"""N camera streams in, surround sets out: one image of every camera around each image of the anchor camera.

The cameras of a real rig do not fire together; those of the PandaSet sample spread one set over 81 of the 100 ms of a
period. All comparisons use corrected stamps: the image's stamp minus its camera's offset. No ROS here.

**Which images.** Anchor images are decided one at a time, oldest first. Of every other camera comes the queued image
nearest to the anchor image, with two refinements:

* An image later than the anchor counts its distance 1.25 times. A camera that fires half a period away from the anchor
  (PandaSet's back camera does) has two images equally near, and jitter would choose between them anew for every set;
  this prefers the earlier, with which the set also leaves sooner.
* An image that is nearer to the *next* anchor image is left to that one. Otherwise a start in mid cycle, or one lost
  image, would pair a camera with its next cycle for ever.

If every camera has such an image and no two stamps differ by more than the tolerance, the set is emitted, and images
older than those used are dropped. If not, the anchor image is dropped and the others stay for the next one.

**With missing cameras.** `min_cameras` lets sets leave that lack cameras. A camera is then no longer waited for once
its newest image lies more than three periods behind the anchor's newest; it takes part again with its next image. The
anchor itself is missing when so many others as a set needs are that far ahead of it, and of no use when most cameras
that send new images lie that far behind it: then its clock is wrong. The first camera of which neither is true stands
in until the anchor returns. Of images that are farther apart than the tolerance, those farthest from the anchor
stay behind.

**When.** As soon as waiting cannot bring a nearer image: every camera has sent one at or after the anchor's stamp, or
its period (median of the last intervals) says that its next will not be nearer than the best one queued. Likewise an
image that seems nearer to the next anchor image, as the anchor's period predicts it, waits for that one. Until a period
is known (two images) the decision waits for the next image instead, so only the first set after a start comes late.

**Faults.** Images may come late or out of order as long as nothing at or after their stamp has left their camera's
queue. A camera's clock has stepped back (a recording that loops, NTP) when an image is older than its newest by more
than `clock_jump` or five periods, or when three images in a row ascend behind the newest. Its images then wait until
the other cameras' clocks have stepped back too, at most for two periods of those; the sets from before the step are
decided, and the queues of the cameras that stepped, and only those, start anew: a recording that loops loses nothing.
After a step forward the old anchor images find every camera beyond them and are decided at once. Every queue is
bounded: a dead camera only means that the others drop their oldest image. Every image is counted as matched, queued or
dropped for a reason.

Choose an anchor that is not faster than the other cameras. Sets come in strictly increasing anchor time, and every
camera's images too, except across a clock step or `flush`.
"""

import math
import threading
from bisect import insort
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.stamps import exposure_times, to_nanoseconds
from cvcdepth_ros.settings import MatchingSettings

if TYPE_CHECKING:
    from cvcdepth_core.rig.rig_file import RigLayout

T = TypeVar("T")

_DEFAULTS = MatchingSettings()
_INTERVALS_FOR_PERIOD = 9
_BEHIND_IN_A_ROW = 3
_JUMP_PERIODS = 5
_STEP_PERIODS = 2
_PATIENCE_PERIODS = 3


@dataclass(frozen=True)
class SurroundSet(Generic[T]):
    """One image of every camera (of those that are there), in the synchroniser's camera order."""

    sequence: int  # counts the sets of one synchroniser from 0
    anchor: str  # the camera around whose image the set was made
    stamp_ns: int  # the anchor image's own stamp: the stamp of everything computed from the set
    stamps_ns: dict[str, int]  # each image's own stamp, its camera's offset not subtracted
    times_ns: dict[str, int]  # its offset subtracted: when the image was taken, by the clock of poses and LiDAR
    images: dict[str, T]
    spread_ns: int  # latest minus earliest corrected stamp

    @property
    def time_ns(self) -> int:
        """When the anchor's image was taken."""
        return self.times_ns[self.anchor]


@dataclass(frozen=True)
class CameraStatistics:
    """Counts of one camera's images: received = matched + queued + the sum of dropped."""

    received: int
    matched: int
    queued: int
    # reason -> images: unmatched (passed over), duplicate_stamp, out_of_order (too late to be used), queue_full,
    # clock_jump (queued when the clock stepped back)
    dropped: dict[str, int]
    clock_steps: int  # how often the stamps stepped back
    period_ns: int | None  # None until two images have come
    missed: int = 0  # sets that left without this camera
    newest_ns: int | None = None  # latest corrected stamp since the last clock step
    lacked: int = 0  # anchor images that were passed over for want of an image of this camera
    gap_ns: int | None = None  # by how much its nearest image was later than the last of these; None: it had none


@dataclass(frozen=True)
class SynchronizerStatistics:
    """A snapshot of all counters since construction."""

    sets: int
    cameras: dict[str, CameraStatistics]


class SurroundSynchronizer(Generic[T]):
    """Matches images of several cameras into surround sets; see the module's text for the rule. Thread-safe.

    No caller's code runs under the lock: `add` returns the sets, and the caller hands them on.
    """

    def __init__(
        self,
        cameras: Sequence[str],
        anchor: str,
        tolerance: float,  # s, largest difference between any two corrected stamps of a set
        offsets: Mapping[str, float] | None = None,  # s, camera -> subtracted from its stamps; 0 where not given
        queue_size: int = _DEFAULTS.queue_size,  # images per camera
        clock_jump: float = 1.0,  # s, a stamp this much behind its camera's newest is a clock step
        min_cameras: int = 0,  # images without which no set leaves; 0: one of every camera
    ) -> None:
        """Raise ConfigError, naming the field, for a value out of range or an unknown camera."""
        _check_cameras(cameras, anchor, offsets or {})
        if isinstance(queue_size, bool) or not isinstance(queue_size, int) or queue_size < 2:
            raise ConfigError(f"queue_size: expected a whole number of at least 2 images, found {queue_size!r}")
        if isinstance(min_cameras, bool) or not isinstance(min_cameras, int) or not 0 <= min_cameras <= len(cameras):
            raise ConfigError(
                f"min_cameras: expected a whole number from 0 to {len(cameras)}, the cameras there are, "
                f"found {min_cameras!r}"
            )
        self.required = min_cameras or len(cameras)
        """Images without which no set leaves."""
        self._tolerance = _checked_nanoseconds("tolerance", tolerance, minimum=0.0)
        clock_jump_ns = _checked_nanoseconds("clock_jump", clock_jump, minimum=tolerance)
        self._streams: dict[str, _Stream[T]] = {}
        for camera in cameras:
            offset = _checked_nanoseconds(f"offsets[{camera!r}]", (offsets or {}).get(camera, 0.0))
            self._streams[camera] = _Stream(offset, queue_size, clock_jump_ns)
        self._anchor = anchor
        self._acting_anchor = anchor
        self._last_stamp: int | None = None  # the acting anchor's corrected one of the last set
        self._sets = 0
        self._arrivals = 0
        self._lock = threading.Lock()

    @classmethod
    def from_layout(
        cls, layout: "RigLayout", tolerance: float, queue_size: int = _DEFAULTS.queue_size, min_cameras: int = 0
    ) -> "SurroundSynchronizer[T]":
        """Match the cameras of a rig with its anchor and its stamp offsets; the rest as in the constructor."""
        offsets = {camera.name: camera.stamp_offset for camera in layout.cameras}
        return cls(layout.names, layout.anchor_camera, tolerance, offsets, queue_size, min_cameras=min_cameras)

    def add(self, camera: str, stamp_ns: int, image: T) -> list[SurroundSet[T]]:
        """Queue one image and return the sets that it completes, oldest first: mostly none or one.

        Raises ConfigError if the camera is not one of the constructor's.
        """
        stream = self._streams.get(camera)
        if stream is None:
            raise ConfigError(f"camera: {camera!r} is not one of {', '.join(self._streams)}")
        with self._lock:
            self._arrivals += 1
            stream.accept(exposure_times(stamp_ns, stream.offset), image, self._arrivals)
            return self._restart() if self._is_step_over() else self._decide(final=False)

    def flush(self) -> list[SurroundSet[T]]:
        """At the end of a recording: decide with what is queued, return the last sets, and start anew."""
        with self._lock:
            sets = self._restart() + self._decide(final=True)
            for stream in self._streams.values():
                stream.clear("unmatched")
            return sets

    def statistics(self) -> SynchronizerStatistics:
        """Snapshot of the counters."""
        with self._lock:
            return SynchronizerStatistics(self._sets, {name: s.statistics() for name, s in self._streams.items()})

    def _is_step_over(self) -> bool:
        """Whether clocks have stepped back, and those that have not yet are not to be waited for."""
        streams = self._streams.values()
        stepped = [stream for stream in streams if stream.after_step]
        others = [stream for stream in streams if not stream.after_step and stream.newest is not None]
        awaited = [stream for stream in others if not any(_is_missing(stream, other) for other in streams)]
        patience = _STEP_PERIODS * max((stream.period or 0 for stream in awaited), default=0)
        return bool(stepped) and (not awaited or any(s.has_waited_after_step(patience) for s in stepped))

    def _restart(self) -> list[SurroundSet[T]]:
        """Go on in the time that the clocks have stepped back to, the sets of the former one decided."""
        stepped = [stream for stream in self._streams.values() if stream.after_step]
        sets: list[SurroundSet[T]] = []
        if self._streams[self._acting_anchor].after_step:
            sets = self._decide(final=True)
            self._last_stamp = None
        for stream in stepped:
            stream.restart()
        return sets + self._decide(final=False)

    def _decide(self, *, final: bool) -> list[SurroundSet[T]]:
        sets: list[SurroundSet[T]] = []
        self._appoint_anchor()
        anchor_stream = self._streams[self._acting_anchor]
        while anchor_stream.stamps:
            anchor, *later = anchor_stream.stamps[:2]
            chosen = {}
            for name, stream in self._streams.items():
                stamp = stream.nearest(anchor, self._tolerance, later[0] if later else None)
                if not final and self._is_worth_waiting(stream, anchor, stamp):
                    return sets  # the oldest anchor image waits, and the later ones with it
                if stamp is not None:
                    chosen[name] = stamp
            chosen = self._within_tolerance(anchor, chosen)
            if len(chosen) >= self.required:
                sets.append(self._emit(chosen))
            else:
                self._pass_over(anchor, chosen)
        return sets

    def _appoint_anchor(self) -> None:
        """Replace an anchor that is missing by another camera, until it returns."""
        if self.required == len(self._streams):
            return
        candidates = (self._anchor, *self._streams)
        ahead = {name for name in self._streams if self._is_ahead(name)}
        acting = next(
            (name for name in candidates if name not in ahead and not self._is_left_behind(name, ahead)),
            self._acting_anchor,
        )
        if acting != self._acting_anchor:
            self._acting_anchor = acting
            if self._last_stamp is not None:
                self._streams[acting].drop_before(self._last_stamp + 1)  # sets come in increasing time

    def _is_ahead(self, camera: str) -> bool:
        """Whether most of those that send lie so far behind this one with their stamps that its clock must be wrong."""
        stream = self._streams[camera]
        sending = [other for other in self._streams.values() if other.has_sent_since(stream)]
        return 2 * sum(_is_missing(other, stream) for other in sending) > len(sending)

    def _is_left_behind(self, camera: str, ahead: Collection[str]) -> bool:
        """Whether enough others for a set have gone on without this camera, not counting those with a wrong clock."""
        stream = self._streams[camera]
        others = (other for name, other in self._streams.items() if name not in ahead)
        return sum(_is_missing(stream, other) for other in others) >= self.required

    def _is_worth_waiting(self, stream: "_Stream[T]", anchor: int, stamp: int | None) -> bool:
        """Whether a nearer image of this camera, or one that says where the queued one belongs, may still come."""
        if stream.may_improve(anchor, stamp):
            return self.required == len(self._streams) or not _is_missing(stream, self._streams[self._acting_anchor])
        return self._may_belong_to_next(anchor, stamp)

    def _may_belong_to_next(self, anchor: int, stamp: int | None) -> bool:
        """Whether the image may turn out nearer to an anchor image that has not come yet."""
        anchor_stream = self._streams[self._acting_anchor]
        if stamp is None or stamp <= anchor or len(anchor_stream.stamps) > 1 or anchor_stream.after_step:
            return False
        return anchor_stream.period is None or _nearer_to_next(stamp, anchor, anchor + anchor_stream.period)

    def _within_tolerance(self, anchor: int, chosen: dict[str, int]) -> dict[str, int]:
        """Leave out the images farthest from the anchor until no two are farther apart than the tolerance."""
        kept = dict(chosen)
        while max(kept.values()) - min(kept.values()) > self._tolerance:
            del kept[max(kept, key=lambda name: abs(kept[name] - anchor))]
        return kept

    def _emit(self, chosen: dict[str, int]) -> SurroundSet[T]:
        anchor = chosen[self._acting_anchor]
        for name in self._streams.keys() - chosen.keys():
            self._streams[name].miss(anchor - self._tolerance)
        surround_set = SurroundSet(
            sequence=self._sets,
            anchor=self._acting_anchor,
            stamp_ns=anchor + self._streams[self._acting_anchor].offset,
            stamps_ns={name: stamp + self._streams[name].offset for name, stamp in chosen.items()},
            times_ns=dict(chosen),
            images={name: self._streams[name].take(stamp) for name, stamp in chosen.items()},
            spread_ns=max(chosen.values()) - min(chosen.values()),
        )
        self._sets += 1
        self._last_stamp = anchor
        return surround_set

    def _pass_over(self, anchor: int, chosen: Collection[str]) -> None:
        for name in self._streams.keys() - chosen:
            self._streams[name].lack(anchor)
        self._streams[self._acting_anchor].drop_oldest("unmatched")
        for stream in self._streams.values():
            stream.drop_before(anchor - self._tolerance)


class _Stream(Generic[T]):
    """One camera's queue in the order of corrected stamps [ns], and what its stamps show of its clock."""

    def __init__(self, offset: int, queue_size: int, clock_jump: int) -> None:
        self.offset = offset
        self.stamps: list[int] = []  # of the queued images, ascending
        self.newest: int | None = None  # latest stamp since the last clock step, whether still queued or not
        self.first: int | None = None  # the first one since then
        self.period: int | None = None
        self.after_step: list[tuple[int, T, int]] = []
        """Stamp, image and number of what has arrived since the clock stepped back, until the others' have too."""
        self._images: dict[int, T] = {}
        self._floor: int | None = None  # latest stamp that left the queue: nothing up to it can be used any more
        self._behind: list[int] = []  # the stamps that arrived last, while they ascend and are older than the newest
        self._intervals: deque[int] = deque(maxlen=_INTERVALS_FOR_PERIOD)
        self._arrivals: deque[int] = deque(maxlen=_PATIENCE_PERIODS)  # numbers, counted over all cameras
        self._queue_size = queue_size
        self._clock_jump = clock_jump
        self._received = self._matched = self._missed = self._lacked = self._clock_steps = 0
        self._gap: int | None = None
        self._dropped: Counter[str] = Counter()

    def accept(self, stamp: int, image: T, arrival: int) -> None:
        """Queue the image, or count why not; `arrival` counts the images of all cameras."""
        self._received += 1
        is_step = not self.after_step and self._steps_back(stamp)
        self._clock_steps += is_step
        if is_step or self.after_step:
            self.after_step.append((stamp, image, arrival))
        else:
            self._queue(stamp, image, arrival)

    def has_waited_after_step(self, patience: int) -> bool:
        """Whether images have come for `patience` ns since the step, or there is no room for more."""
        span = self.after_step[-1][0] - self.after_step[0][0]
        return span >= patience or len(self.stamps) + len(self.after_step) >= self._queue_size

    def restart(self) -> None:
        """Drop what is left from before the step, and queue what has arrived since."""
        self.clear("clock_jump")
        arrived, self.after_step = self.after_step, []
        for stamp, image, arrival in arrived:
            self._queue(stamp, image, arrival)

    def _queue(self, stamp: int, image: T, arrival: int) -> None:
        if stamp in self._images or stamp == self.newest:
            self._dropped["duplicate_stamp"] += 1
        elif self._floor is not None and stamp <= self._floor:
            self._dropped["out_of_order"] += 1
        else:
            self._arrivals.append(arrival)
            self._observe(stamp)
            insort(self.stamps, stamp)
            self._images[stamp] = image
            if len(self.stamps) > self._queue_size:
                self.drop_oldest("queue_full")

    def nearest(self, anchor: int, tolerance: int, next_anchor: int | None) -> int | None:
        """Stamp of the queued image nearest to the anchor, within the tolerance and not nearer to the next anchor."""
        best = None
        for stamp in self.stamps:
            if stamp > anchor + tolerance or (next_anchor is not None and _nearer_to_next(stamp, anchor, next_anchor)):
                break
            if stamp >= anchor - tolerance and (best is None or _distance(stamp, anchor) < _distance(best, anchor)):
                best = stamp
        return best

    def may_improve(self, anchor: int, stamp: int | None) -> bool:
        """Whether an image still to come may be nearer to the anchor than the queued one of this stamp, if any."""
        if self.newest is None:
            return True
        if self.after_step:  # where this clock alone has stepped, one of those may yet belong to the anchor
            return stamp is None
        if self.newest >= anchor:
            return False
        if stamp is None or self.period is None:
            return True
        return _distance(self.newest + self.period, anchor) < _distance(stamp, anchor)

    def has_sent_since(self, other: "_Stream[T]") -> bool:
        """Whether a new image has come since the other camera's last few: what sends none has no wrong clock."""
        return bool(self._arrivals and other._arrivals) and self._arrivals[-1] > other._arrivals[0]

    def take(self, stamp: int) -> T:
        """Remove a queued image for a set; the older ones are passed over."""
        self.drop_before(stamp)
        self._matched += 1
        return self._pop_oldest()

    def miss(self, before: int) -> None:
        """Note that a set leaves without this camera; its images before that stamp are of no use any more."""
        self._missed += 1
        self.drop_before(before)

    def lack(self, anchor: int) -> None:
        """Note that an anchor image is passed over because none of this camera's belongs to it."""
        self._lacked += 1
        gaps = [stamp - anchor for stamp in (*self.stamps, *([] if self._floor is None else [self._floor]))]
        self._gap = min(gaps, key=abs, default=None)

    def drop_before(self, stamp: int) -> None:
        while self.stamps and self.stamps[0] < stamp:
            self.drop_oldest("unmatched")

    def drop_oldest(self, reason: str) -> None:
        self._pop_oldest()
        self._dropped[reason] += 1

    def clear(self, reason: str) -> None:
        """Empty the queue and take the next image whatever its stamp; the period is still good."""
        self._dropped[reason] += len(self.stamps)
        self.stamps.clear()
        self._images.clear()
        self._behind.clear()
        self.newest = self.first = self._floor = None

    def statistics(self) -> CameraStatistics:
        dropped = {reason: count for reason, count in self._dropped.items() if count}
        queued = len(self.stamps) + len(self.after_step)
        return CameraStatistics(
            received=self._received,
            matched=self._matched,
            queued=queued,
            dropped=dropped,
            clock_steps=self._clock_steps,
            period_ns=self.period,
            missed=self._missed,
            newest_ns=self.newest,
            lacked=self._lacked,
            gap_ns=self._gap,
        )

    def _pop_oldest(self) -> T:
        self._floor = self.stamps.pop(0)
        return self._images.pop(self._floor)

    def _steps_back(self, stamp: int) -> bool:
        if self.newest is None or stamp >= self.newest:
            self._behind.clear()
            return False
        if self._behind and stamp <= self._behind[-1]:
            self._behind.clear()
        self._behind.append(stamp)
        jump = self._clock_jump if self.period is None else min(self._clock_jump, _JUMP_PERIODS * self.period)
        return self.newest - stamp > jump or len(self._behind) >= _BEHIND_IN_A_ROW

    def _observe(self, stamp: int) -> None:
        if self.newest is not None and stamp > self.newest:
            self._intervals.append(stamp - self.newest)
            self.period = sorted(self._intervals)[len(self._intervals) // 2]
        if self.newest is None or stamp > self.newest:
            self.newest = stamp
        if self.first is None:
            self.first = stamp


def _is_missing(stream: _Stream[T], other: _Stream[T]) -> bool:
    """Whether the other camera has gone on so far that this one's next image is not to be waited for."""
    period = stream.period or other.period
    last_sign_of_life = other.first if stream.newest is None else stream.newest
    if other.newest is None or last_sign_of_life is None or period is None:
        return False
    return other.newest - last_sign_of_life > _PATIENCE_PERIODS * period


def _distance(stamp: int, anchor: int) -> int:
    """Distance in quarters of a nanosecond, so that the 1.25 of a later image stays a whole number."""
    return 5 * (stamp - anchor) if stamp > anchor else 4 * (anchor - stamp)


def _nearer_to_next(stamp: int, anchor: int, next_anchor: int) -> bool:
    return stamp - anchor >= next_anchor - stamp


def _check_cameras(cameras: Sequence[str], anchor: str, offsets: Mapping[str, float]) -> None:
    if isinstance(cameras, str) or not cameras or len(set(cameras)) != len(cameras):
        raise ConfigError(f"cameras: expected at least one name, all of them different, found {cameras!r}")
    if anchor not in cameras:
        raise ConfigError(f"anchor: {anchor!r} is not one of {', '.join(cameras)}")
    unknown = sorted(set(offsets) - set(cameras))
    if unknown:
        raise ConfigError(f"offsets: {', '.join(unknown)} not among the cameras {', '.join(cameras)}")


def _checked_nanoseconds(field: str, seconds: float, minimum: float = -math.inf) -> int:
    number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
    if not number or not math.isfinite(seconds) or seconds < minimum:
        bound = "" if math.isinf(minimum) else f" of at least {minimum}"
        raise ConfigError(f"{field}: expected a number of seconds{bound}, found {seconds!r}")
    return to_nanoseconds(seconds)
