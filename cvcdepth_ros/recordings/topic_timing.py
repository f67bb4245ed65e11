# SPDX-License-Identifier: Apache-2.0
"""When the messages of a topic were stamped and recorded: rate, gaps, jitter, and the distance of the two clocks."""

from __future__ import annotations

import struct
from array import array
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.store import Typestore

from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags import RecordedMessage
from cvcdepth_ros.recordings.fixed_frames import TRANSFORM_TYPE

_GAP = 2.0  # times the median interval
_HEADER, _TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
# A CDR message begins with four bytes, the second of which is the byte order; then comes the first field.
_LITTLE_ENDIAN, _BIG_ENDIAN = struct.Struct("<iI"), struct.Struct(">iI")
_FIRST_FIELD = 4


class StampReader:
    """Reads the header stamps of one message type out of the serialised bytes, without looking at the rest."""

    def __init__(self, type_: str, store: Typestore) -> None:
        _, fields = store.fielddefs.get(type_, ([], []))
        # foxglove's messages begin with the stamp itself, as a header does.
        begins_with_stamp = bool(fields) and (fields[0][0], fields[0][1][1]) == ("timestamp", _TIME)
        is_stamped = begins_with_stamp or (bool(fields) and fields[0][1][1] == _HEADER)
        # A TFMessage begins with its number of transforms; the first one's header follows.
        self._offset = _FIRST_FIELD if is_stamped else 2 * _FIRST_FIELD if type_ == TRANSFORM_TYPE else None

    def __call__(self, cdr: bytes | memoryview) -> int | None:
        """Return the stamp, ns; None for a type that has none, and for a message too short to hold one."""
        if self._offset is None or len(cdr) < self._offset + _LITTLE_ENDIAN.size:
            return None
        layout = _LITTLE_ENDIAN if cdr[1] & 1 else _BIG_ENDIAN
        seconds, nanoseconds = layout.unpack_from(cdr, self._offset)
        return int(seconds) * NANOSECONDS + int(nanoseconds)


class ClockOffset(NamedTuple):
    """Recorded minus stamped, seconds: positive where messages are recorded after their stamp."""

    median: float
    lowest: float
    highest: float


@dataclass(frozen=True)
class Timing:
    """The times of one topic's messages, by their stamps, or by when they were recorded where they have none."""

    messages: int
    bytes: int
    stamped: bool
    rate: float | None
    """Hz over the whole time; None for fewer than two messages."""
    interval: float | None
    """Seconds, median."""
    jitter: float | None
    """Seconds from the median interval that 95 % of the intervals keep."""
    largest_gap: float | None
    """Seconds."""
    gaps: int
    """Intervals above twice the median."""
    steps_back: int
    """Stamps older than the one before."""
    repeated: int
    """Stamps equal to the one before."""
    clock_offset: ClockOffset | None
    """None where messages have no stamp."""


class TopicTiming:
    """Collects the times of one topic, 16 bytes a message."""

    def __init__(self, type_: str, store: Typestore) -> None:
        self._read_stamp = StampReader(type_, store)
        self._stamps = array("q")
        self._log_times = array("q")
        self._bytes = 0

    def add(self, message: RecordedMessage) -> int | None:
        """Take in a message, in the order of recording; return its stamp (ns), if it has one."""
        stamp = self._read_stamp(message.cdr)
        if stamp is not None:
            self._stamps.append(stamp)
        self._log_times.append(message.log_time)
        self._bytes += len(message.cdr)
        return stamp

    @property
    def stamps(self) -> NDArray[np.int64]:
        """[M] ns, in the order of recording."""
        return np.array(self._stamps, dtype=np.int64)

    def timing(self) -> Timing:
        """Compute the numbers."""
        stamps, log_times = self.stamps, np.array(self._log_times, dtype=np.int64)
        # Drivers without a clock leave all stamps at zero.
        stamped = 0 < len(stamps) == len(log_times) and bool(stamps.any())
        steps = np.diff(stamps) if stamped else np.empty(0)
        times: NDArray[np.int64] = np.sort(stamps if stamped else log_times)
        intervals = _seconds(times[1:] - times[:-1])
        median = float(np.median(intervals)) if intervals.size else None
        span = float(intervals.sum())
        return Timing(
            messages=len(log_times),
            bytes=self._bytes,
            stamped=stamped,
            rate=intervals.size / span if span else None,
            interval=median,
            jitter=None if median is None else float(np.percentile(abs(intervals - median), 95)),
            largest_gap=float(intervals.max()) if intervals.size else None,
            gaps=0 if median is None else int((intervals > _GAP * median).sum()),
            steps_back=int((steps < 0).sum()),
            repeated=int((steps == 0).sum()),
            clock_offset=_clock_offset(stamps, log_times) if stamped else None,
        )


def _clock_offset(stamps: NDArray[np.int64], log_times: NDArray[np.int64]) -> ClockOffset:
    seconds = _seconds(log_times - stamps)
    return ClockOffset(float(np.median(seconds)), float(seconds.min()), float(seconds.max()))


def _seconds(nanoseconds: NDArray[np.int64]) -> NDArray[np.float64]:
    seconds: NDArray[np.float64] = nanoseconds / NANOSECONDS
    return seconds
