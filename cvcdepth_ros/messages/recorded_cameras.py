# SPDX-License-Identifier: Apache-2.0
"""The cameras of a recording: its topics, with what their first messages tell."""

from collections.abc import Mapping
from itertools import islice
from typing import Any
from weakref import WeakKeyDictionary

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.images.video import VIDEO_EXTRA, video_is_read
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.messages.camera_discovery import (
    CAMERA_INFO_TYPE,
    RECORDED_IMAGE_TYPES,
    VIDEO_TYPES,
    FoundCameras,
    SeenTopic,
    find_cameras,
)
from cvcdepth_ros.messages.camera_info import MOST_UNCALIBRATED, is_uncalibrated

_found: WeakKeyDictionary[Recording, FoundCameras] = WeakKeyDictionary()


def find_recorded_cameras(
    recording: Recording, already_read: Mapping[str, RecordedMessage] | None = None
) -> FoundCameras:
    """Return the cameras of which something was recorded, and what is no camera, see `find_cameras`.

    A message of each topic is looked at: the recording's first one, where none was read before.
    """
    if recording not in _found:
        topics = {topic.name: topic.type for topic in recording.topics.values() if topic.count}
        described = [name for name, type_ in topics.items() if type_ in (CAMERA_INFO_TYPE, *RECORDED_IMAGE_TYPES)]
        known = already_read or {}
        firsts = {**recording.first_messages([name for name in described if name not in known]), **known}
        seen = {name: _seen(recording, name, firsts.get(name)) for name in described}
        found = find_cameras(topics, seen, RECORDED_IMAGE_TYPES)
        found.left_out += _unread_videos(found, topics)
        _found[recording] = found
    return _found[recording]


def _unread_videos(found: FoundCameras, types: Mapping[str, str]) -> list[str]:
    videos = [camera.image_topic for camera in found.cameras if types[camera.image_topic] in VIDEO_TYPES]
    if not videos or video_is_read():
        return []
    return [f"{', '.join(videos)}: video, which is not read without PyAV; {VIDEO_EXTRA} brings it"]


def first_camera_info(recording: Recording, topic: str, already_read: RecordedMessage | None = None) -> Any | None:
    """Return a topic's first CameraInfo with a calibration, the first one where none has; None where there is none.

    `already_read` is one that will do if it has a calibration. Raises RecordingError for one that cannot be read.
    """
    first = None if already_read is None else recording.deserialize(already_read)
    if first is not None and not is_uncalibrated(first):
        return first
    for message in islice(recording.messages([topic]), MOST_UNCALIBRATED):
        info = recording.deserialize(message)
        if not is_uncalibrated(info):
            return info
        first = first or info
    return first


def _seen(recording: Recording, name: str, message: Any) -> SeenTopic:
    count = recording.topics[name].count
    try:
        content = recording.deserialize(message) if message is not None else None
    except RecordingError:
        content = None
    if content is None:
        return SeenTopic(count)
    # Of a stereo pair, the right camera's P tells its distance from the left one, whose frame it has.
    shifted = hasattr(content, "p") and bool(content.p[3])
    return SeenTopic(count, _encoding(content), content.header.frame_id, shifted)


def _encoding(image: Any) -> str:
    """Return what was sent, or what a compressed image was made of ("bgr8; jpeg compressed bgr8")."""
    if hasattr(image, "encoding"):
        return str(image.encoding)
    original, separator, _ = str(getattr(image, "format", "")).partition(";")
    return original.strip() if separator else ""
