# SPDX-License-Identifier: Apache-2.0
"""On which topics a recording has its transforms: `/tf_static` and `/tf`, or those of one robot's namespace."""

from collections.abc import Sequence

from cvcdepth_ros.bags import Recording
from cvcdepth_ros.messages.recorded_cameras import find_recorded_cameras

TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"

_STATIC, _MOVING = "tf_static", "tf"


def static_transform_topics(recording: Recording) -> list[str]:
    """Return the topics with fixed transforms, see `_chosen`."""
    return _chosen(recording, _STATIC)


def moving_transform_topics(recording: Recording) -> list[str]:
    """Return the topics with moving transforms, see `_chosen`."""
    return _chosen(recording, _MOVING)


def describe_transform_topics(recording: Recording) -> str:
    """Say which topics of other names than `/tf_static` are used, or why none of several is; empty for the usual."""
    found, chosen = _called(recording, _STATIC), static_transform_topics(recording)
    if any(topic.strip("/") == _STATIC for topic in found) or not found:
        return ""
    if chosen:
        return f"transforms are those of {', '.join(chosen)}"
    return f"transforms were recorded on {', '.join(found)}, of several robots; none is known to be that of the cameras"


def _chosen(recording: Recording, name: str) -> list[str]:
    """Return `/NAME` (ROS 1: NAME) where it was recorded, else that of the one namespace there is.

    Of several namespaces it is the one that the cameras' topics are in too; where that tells nothing, none is taken.
    """
    found = _called(recording, name)
    plain = [topic for topic in found if topic.strip("/") == name]
    if plain or len(found) < 2:
        return plain or found
    cameras = [camera.image_topic for camera in find_recorded_cameras(recording).cameras]
    near = [topic for topic in found if cameras and _are_below(cameras, topic.removesuffix(name))]
    return near if len(near) == 1 else []


def _called(recording: Recording, name: str) -> list[str]:
    return sorted(
        topic.name
        for topic in recording.topics.values()
        if topic.type == TRANSFORMS_TYPE and topic.count and topic.name.rpartition("/")[2] == name
    )


def _are_below(topics: Sequence[str], namespace: str) -> bool:
    return all(topic.startswith(namespace) for topic in topics)
