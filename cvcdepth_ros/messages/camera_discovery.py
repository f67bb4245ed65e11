# SPDX-License-Identifier: Apache-2.0
"""Find the cameras among a recording's or a live system's topics by ROS's naming: one namespace, one camera.

A camera is a namespace with a `camera_info` and at least one image topic (image_pipeline's convention).
"""

import re
from collections.abc import Container, Mapping

from cvcdepth_core.rig.rig_file import CameraEntry

IMAGE_TYPE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE_TYPE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"

_INFO_SUFFIX = "/camera_info"
# Image-transport plugins other than `compressed`, and depth images, are not camera pictures.
_NOT_PICTURES = ("depth", "compressedDepth", "theora", "zstd")


def discover_cameras(topic_types: Mapping[str, str]) -> list[CameraEntry]:
    """Return the cameras found in `topic_types` (topic name -> type), by name; their frames and poses are still open.

    Where a camera has several image topics, raw pictures come before compressed ones and unrectified before rectified
    (rectifying once, to the network's size, loses least).
    """
    infos = sorted(topic for topic, type_name in topic_types.items() if type_name == CAMERA_INFO_TYPE)
    namespaces = [topic.removesuffix(_INFO_SUFFIX) for topic in infos if topic.endswith(_INFO_SUFFIX)]
    given = (namespace for namespace in namespaces if not is_output(namespace + _INFO_SUFFIX, topic_types))
    found = {namespace: _image_topics(namespace, topic_types) for namespace in given}
    with_images = {namespace: topics for namespace, topics in found.items() if topics}
    names = _shortest_unique_names(list(with_images))
    return [
        CameraEntry(
            name=names[namespace],
            image_topic=topics[0],
            camera_info_topic=namespace + _INFO_SUFFIX,
            rectified="image_rect" in topics[0],
        )
        for namespace, topics in with_images.items()
    ]


def is_output(topic: str, topics: Container[str]) -> bool:
    """Whether a topic is the rectified picture, or its camera_info, that a node or `run` of ours has put out.

    They stand beside the depth of the same picture, where a camera's raw pictures do not.
    """
    namespace = topic.rpartition("/")[0]
    beside = ("image_rect", "depth/image_rect", "depth/camera_info")
    return all(f"{namespace}/{part}" in topics for part in beside) and f"{namespace}/image_raw" not in topics


def _image_topics(namespace: str, topic_types: Mapping[str, str]) -> list[str]:
    """Image topics of the namespace, best first; none for the namespace of a depth image."""
    if namespace.rsplit("/", 1)[-1] == "depth":
        return []
    topics = [
        topic
        for topic, type_name in topic_types.items()
        if type_name in (IMAGE_TYPE, COMPRESSED_IMAGE_TYPE)
        and topic.startswith(namespace + "/")
        and not any(part in _NOT_PICTURES for part in topic.removeprefix(namespace).split("/"))
    ]
    return sorted(topics, key=lambda t: (topic_types[t] != IMAGE_TYPE, "image_rect" in t, "image_raw" not in t, t))


def _shortest_unique_names(namespaces: list[str]) -> dict[str, str]:
    """Call each camera by the last part of its namespace, by more parts where that is not unique, else numbered."""
    parts = {namespace: namespace.strip("/").split("/") for namespace in namespaces}
    depth = max((len(found) for found in parts.values()), default=1)
    for count in range(1, depth + 1):
        names = {namespace: _camera_name("_".join(found[-count:])) for namespace, found in parts.items()}
        if len(set(names.values())) == len(names):
            return names
    return {namespace: f"{name}_{number}" for number, (namespace, name) in enumerate(names.items())}


def _camera_name(topic_part: str) -> str:
    """Make a camera's name of a part of a topic, which may be empty, a number, or of no ROS system's characters."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", topic_part)
    return name if name[:1].isalpha() else f"camera_{name}".rstrip("_")
