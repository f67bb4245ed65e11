# SPDX-License-Identifier: Apache-2.0
"""Cameras whose calibration is not the same over a whole recording: which, when, and what changed."""

from collections import Counter
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from cvcdepth_core.errors import RecordingError, RigError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.bags.remote import RemotePath
from cvcdepth_ros.messages.calibration_changes import describe_change
from cvcdepth_ros.messages.camera_info import is_uncalibrated, read_camera_info

_SAMPLES = _MOST_TOLD = 9
_QUICKLY_READ_BYTES = 2**31  # a few seconds from a disk
_AFTER_STAMP = 12  # bytes of CDR: what it is, and the header's stamp
_SHORTEST_NS = 10_000_000


class _Sample(NamedTuple):
    log_time: int
    calibration: Calibration


def moment_of(time: int, recording: Recording) -> str:
    """Say when something was, `time` (ns) being a stamp or log time: in seconds from the recording's beginning."""
    if recording.start - NANOSECONDS <= time <= recording.end + NANOSECONDS:
        return f"{(time - recording.start) / NANOSECONDS:.3f} s after the beginning"
    return f"at {time / NANOSECONDS:.3f} s of its clock"


def is_quickly_read(recording: Recording) -> bool:
    """Whether a recording is small and near enough to be read whole for what changes on the way."""
    is_near = not any(isinstance(file.path, RemotePath) for file in recording.files)
    return is_near and sum(file.size for file in recording.files) <= _QUICKLY_READ_BYTES


class CalibrationHistory:
    """What a recording's CameraInfos say one after the other, and when they change."""

    def __init__(self, recording: Recording, layout: RigLayout, firsts: Mapping[str, RecordedMessage]) -> None:
        """Begin with `firsts`, the topics' first messages, where they have a calibration."""
        self._recording = recording
        self._cameras: dict[str, list[str]] = {}
        for camera in layout.cameras:
            self._cameras.setdefault(camera.camera_info_topic, []).append(camera.name)
        self._contents: dict[str, bytes] = {}
        self._calibrations: dict[str, Calibration] = {}
        self._counts: Counter[str] = Counter()
        self._changes: list[str] = []
        for topic in self.topics & firsts.keys():
            self.add(firsts[topic])

    @property
    def topics(self) -> set[str]:
        """Those of the cameras' CameraInfos that were recorded."""
        return self._cameras.keys() & self._recording.topics.keys()

    @property
    def changes(self) -> list[str]:
        """Which cameras' CameraInfos change, when, and how: a line for each change, up to nine of a camera."""
        more = {camera: count - _MOST_TOLD for camera, count in self._counts.items() if count > _MOST_TOLD}
        return [
            *self._changes,
            *(f"camera {name}: its calibration changes {count} times more" for name, count in more.items()),
        ]

    def add(self, message: RecordedMessage) -> None:
        """Compare a CameraInfo with the one before; one that cannot be read, or has no calibration, says nothing."""
        content = bytes(message.cdr[_AFTER_STAMP:])
        if content == self._contents.get(message.topic):
            return
        self._contents[message.topic] = content
        calibration = _calibration(self._recording, message)
        if calibration is None:
            return
        former = self._calibrations.get(message.topic)
        change = None if former is None else describe_change(former, calibration)
        if former is None or change:  # beside what is only rounding the former stays, so that it does not drift away
            self._calibrations[message.topic] = calibration
        if change:
            self.note(message.topic, change, message.log_time)

    def note(self, topic: str, change: str, log_time: int) -> None:
        """Note that the calibration on a topic changed."""
        for camera in self._cameras[topic]:
            self._counts[camera] += 1
            if self._counts[camera] <= _MOST_TOLD:
                moment = moment_of(log_time, self._recording)
                self._changes.append(f"camera {camera}: its calibration changes: {change}, {moment}")


def find_calibration_changes(
    recording: Recording, layout: RigLayout, firsts: Mapping[str, RecordedMessage]
) -> list[str]:
    """Return which cameras' CameraInfos change during the recording, when, and how; a line for each change.

    All are looked at where the recording is read quickly, else those of a few moments, spread over it, and where two
    differ those in between. `firsts` are the topics' first messages.
    """
    history = CalibrationHistory(recording, layout, firsts)
    if is_quickly_read(recording):
        for message in recording.messages(history.topics):
            history.add(message)
    else:
        _compare_moments(recording, history, firsts)
    return history.changes


def _compare_moments(recording: Recording, history: CalibrationHistory, firsts: Mapping[str, RecordedMessage]) -> None:
    known = ((topic, firsts[topic]) for topic in history.topics if topic in firsts)
    first = {topic: _Sample(m.log_time, found) for topic, m in known if (found := _calibration(recording, m))}
    rounds = [first, *(_samples(recording, history.topics, *span) for span in _spans(recording)[1:])]
    for topic in history.topics:
        samples = [found[topic] for found in rounds if topic in found]
        for before, after in pairwise(samples):
            if change := describe_change(before.calibration, after.calibration):
                history.note(topic, change, _changed_at(recording, topic, before, after))


def _spans(recording: Recording) -> list[tuple[int, int]]:
    times = np.linspace(recording.start, recording.end + 1, _SAMPLES + 1).astype(np.int64).tolist()
    return list(pairwise(times))


def _samples(recording: Recording, topics: set[str], start: int, stop: int) -> dict[str, _Sample]:
    """Return the first valid calibration of each topic in a part of the recording."""
    found: dict[str, _Sample] = {}
    for message in recording.messages(topics, start, stop):
        if message.topic not in found and (calibration := _calibration(recording, message)) is not None:
            found[message.topic] = _Sample(message.log_time, calibration)
        if len(found) == len(topics):
            break
    return found


def _calibration(recording: Recording, message: Any) -> Calibration | None:
    try:
        content = recording.deserialize(message)
        return None if is_uncalibrated(content) else read_camera_info(content, message.topic).calibration
    except (RecordingError, RigError):
        return None


def _changed_at(recording: Recording, topic: str, before: _Sample, after: _Sample) -> int:
    """Return the log time of the first CameraInfo after `before` that differs from it, found by halving the time."""
    while after.log_time - before.log_time > _SHORTEST_NS:
        middle = (before.log_time + after.log_time) // 2
        parts = ((middle, after.log_time), (before.log_time + 1, middle))
        sample = next((found[topic] for part in parts if (found := _samples(recording, {topic}, *part))), None)
        if sample is None:
            break
        if describe_change(before.calibration, sample.calibration):
            after = sample
        else:
            before = sample
    return after.log_time
