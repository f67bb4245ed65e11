# SPDX-License-Identifier: Apache-2.0
"""Cameras whose calibration is not the same over a whole recording: which, when, and what changed."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from cvcdepth_core.errors import RecordingError, RigError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.messages.calibration_changes import describe_change
from cvcdepth_ros.messages.camera_info import is_uncalibrated, read_camera_info

_SAMPLES = 9
_SHORTEST_NS = 10_000_000


class _Sample(NamedTuple):
    log_time: int
    calibration: Calibration


def moment_of(time: int, recording: Recording) -> str:
    """Say when something was, `time` (ns) being a stamp or log time: in seconds from the recording's beginning."""
    if recording.start - NANOSECONDS <= time <= recording.end + NANOSECONDS:
        return f"{(time - recording.start) / NANOSECONDS:.3f} s after the beginning"
    return f"at {time / NANOSECONDS:.3f} s of its clock"


def find_calibration_changes(
    recording: Recording, layout: RigLayout, firsts: Mapping[str, RecordedMessage]
) -> list[str]:
    """Return which cameras' CameraInfos change during the recording, when, and how; a line for each change.

    Looked at are a few moments, spread over the recording, and where two differ those in between. `firsts` are the
    topics' first messages.
    """
    topics = {camera.name: camera.camera_info_topic for camera in layout.cameras}
    infos = {topic for topic in topics.values() if topic in recording.topics}
    known = ((topic, firsts[topic]) for topic in infos if topic in firsts)
    first = {topic: _Sample(m.log_time, found) for topic, m in known if (found := _calibration(recording, m))}
    rounds = [first, *(_samples(recording, infos, *span) for span in _spans(recording)[1:])]
    changes = []
    for camera, topic in topics.items():
        samples = [found[topic] for found in rounds if topic in found]
        for before, after in pairwise(samples):
            if change := describe_change(before.calibration, after.calibration):
                moment = moment_of(_changed_at(recording, topic, before, after), recording)
                changes.append(f"camera {camera}: its calibration changes: {change}, {moment}")
    return changes


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
