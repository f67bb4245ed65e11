# SPDX-License-Identifier: Apache-2.0
"""A summary of a recording: its files, topics with their times, and cameras. No ROS here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from cvcdepth_core.errors import RecordingError, RigError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.rig_file import CameraEntry
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.bags.topics import RecordingFile
from cvcdepth_ros.messages.camera_info import read_camera_info
from cvcdepth_ros.messages.recorded_cameras import find_recorded_cameras, first_camera_info
from cvcdepth_ros.recordings.topic_timing import Timing, TopicTiming

IndexState = Literal["intact", "rebuilt", "damaged"]
Progress = Callable[[int], None]
"""Called with the log time (ns) of every message that has been read."""


@dataclass(frozen=True)
class FileSummary:
    """One file of a recording."""

    path: str
    bytes: int
    messages: int
    index: IndexState
    """rebuilt: it had none, and was read through once; damaged: and not all of it could be read."""
    damage: tuple[str, ...]


@dataclass(frozen=True)
class TopicSummary:
    """One topic in the time that was asked for."""

    name: str
    type: str
    timing: Timing


@dataclass(frozen=True)
class CameraSummary:
    """One camera, as its first CameraInfo and image describe it."""

    name: str
    image_topic: str
    encoding: str | None
    frame_id: str | None
    calibration: Calibration | None
    problem: str | None
    """Why its calibration cannot be used."""
    notes: tuple[str, ...] = ()
    """What its CameraInfo does not say as it should, and how it is understood."""


@dataclass(frozen=True)
class RecordingSummary:
    """One recording."""

    path: str
    start: int
    """Log time of the first message, ns."""
    seconds: float
    """From the first message to the last."""
    files: tuple[FileSummary, ...]
    topics: tuple[TopicSummary, ...]
    """By name."""
    cameras: tuple[CameraSummary, ...]
    damage: str | None
    """What could not be read, of all files."""
    notes: tuple[str, ...] = ()
    """What is odd, and how it is understood, and how cameras were chosen."""

    @property
    def index(self) -> IndexState:
        """The worst state of any file; damaged also when something that is not of a file is missing."""
        states = {file.index for file in self.files}
        if self.damage:
            return "damaged"
        return "rebuilt" if "rebuilt" in states else "intact"


def summarize(
    recording: Recording, start: int | None = None, stop: int | None = None, progress: Progress | None = None
) -> RecordingSummary:
    """Read the messages with start <= log_time < stop (ns), so that damage shows, and describe the recording."""
    timings, first = _read(recording, start, stop, progress)
    found = find_recorded_cameras(recording, first)
    cameras = tuple(_camera(recording, entry, first) for entry in found.cameras)
    return RecordingSummary(
        path=str(recording.path),
        start=recording.start,
        seconds=(recording.end - recording.start) / NANOSECONDS,
        files=tuple(_file(file) for file in recording.files),
        topics=tuple(
            TopicSummary(name, recording.topics[name].type, timing.timing()) for name, timing in sorted(timings.items())
        ),
        cameras=cameras,
        damage=recording.damage,
        notes=(*recording.notes, *found.choices, *found.left_out, *([found.offers] if found.offers else [])),
    )


def _read(
    recording: Recording, start: int | None, stop: int | None, progress: Progress | None
) -> tuple[dict[str, TopicTiming], dict[str, RecordedMessage]]:
    """Return the times of every topic, and its first message."""
    timings = {name: TopicTiming(topic.type, recording.typestore) for name, topic in recording.topics.items()}
    first: dict[str, RecordedMessage] = {}
    for message in recording.messages(start=start, stop=stop):
        timings[message.topic].add(message)
        first.setdefault(message.topic, message)
        if progress:
            progress(message.log_time)
    return timings, first


def _file(file: RecordingFile) -> FileSummary:
    index: IndexState = "damaged" if file.damage else "intact" if file.indexed else "rebuilt"
    messages = sum(topic.count for topic in file.topics.values())
    return FileSummary(str(file.path), file.size, messages, index, tuple(file.damage))


def _camera(recording: Recording, entry: CameraEntry, first: Mapping[str, RecordedMessage]) -> CameraSummary:
    calibration, frame_id, problem = None, None, None
    notes: tuple[str, ...] = ()
    try:
        info = first_camera_info(recording, entry.camera_info_topic, first.get(entry.camera_info_topic))
        if info is None:
            problem = f"no message on {entry.camera_info_topic}"
        else:
            frame_id = info.header.frame_id
            calibration, notes = read_camera_info(info, entry.name)
    except (RecordingError, RigError) as error:
        problem = str(error)
    encoding = _encoding(recording, entry.image_topic, first)
    return CameraSummary(entry.name, entry.image_topic, encoding, frame_id, calibration, problem, notes)


def _encoding(recording: Recording, topic: str, first: Mapping[str, RecordedMessage]) -> str | None:
    try:
        image = _first(recording, topic, first)
    except RecordingError:
        return None
    return None if image is None else str(getattr(image, "encoding", None) or image.format)


def _first(recording: Recording, topic: str, first: Mapping[str, RecordedMessage]) -> Any:
    return recording.deserialize(first[topic]) if topic in first else None
