# SPDX-License-Identifier: Apache-2.0
"""The output topics and their messages, the same whether a node publishes them or a recording stores them."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from cvcdepth_core.pointcloud import CloudLimits, merged_cloud, organised_cloud
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_ros.messages.camera_discovery import CAMERA_INFO_TYPE, IMAGE_TYPE
from cvcdepth_ros.messages.conversion import MessageFactory
from cvcdepth_ros.messages.point_clouds import POINT_CLOUD_TYPE
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet

STRING_TYPE = "std_msgs/msg/String"

MERGED_CLOUD = "points"
MERGED_CAMERAS = "points/cameras"
DEPTH, DEPTH_INFO = "depth/image_rect", "depth/camera_info"
PICTURE, PICTURE_INFO, CLOUD = "image_rect", "camera_info", "points"
_CAMERA_TYPES = {
    DEPTH: IMAGE_TYPE,
    DEPTH_INFO: CAMERA_INFO_TYPE,
    PICTURE: IMAGE_TYPE,
    PICTURE_INFO: CAMERA_INFO_TYPE,
    CLOUD: POINT_CLOUD_TYPE,
}


class OutputMessage(NamedTuple):
    """One message of a set."""

    topic: str
    """Below the node's name."""
    camera: str
    """The camera whose stamp it carries: its own, or the set's anchor for what belongs to the merged cloud."""
    message: Any


def output_types(cameras: Sequence[str]) -> dict[str, str]:
    """Return every output topic, below the node's name, with its message type."""
    per_camera = {f"{camera}/{part}": type_ for camera in cameras for part, type_ in _CAMERA_TYPES.items()}
    return {**per_camera, MERGED_CLOUD: POINT_CLOUD_TYPE, MERGED_CAMERAS: STRING_TYPE}


def camera_topics(camera: str) -> list[str]:
    """Return the output topics, below the node's name, for which this camera's depth is needed.

    What a merged cloud contains is known when it could be made.
    """
    return [*(f"{camera}/{part}" for part in _CAMERA_TYPES), MERGED_CLOUD, MERGED_CAMERAS]


class SurroundMessages:
    """Builds the messages of surround sets, with the message classes of one library."""

    def __init__(self, factory: MessageFactory, depth_encoding: str) -> None:
        self._factory = factory
        self._encoding = depth_encoding

    def of_set(
        self,
        estimated: EstimatedSet[Any],
        frame_ids: Mapping[str, str],
        limits: CloudLimits,
        wanted: Callable[[str], object],
    ) -> Iterator[OutputMessage]:
        """Build, one after the other, the messages of the topics that are `wanted`, for the cameras that are there.

        What belongs to one camera carries that camera's own stamp (ns) and optical frame, so that it matches the input
        image exactly; the merged cloud carries the stamp of the set's anchor and the base frame.
        """
        surround_set, rig, result = estimated.surround_set, estimated.rig, estimated.result
        for index, camera in enumerate(rig.names):
            if result.present[index]:
                stamp = surround_set.stamps_ns[camera]
                for part, build in self._camera_messages(result, index, stamp, frame_ids[camera]).items():
                    if wanted(f"{camera}/{part}"):
                        yield OutputMessage(f"{camera}/{part}", camera, build())
        for topic, build in self._merged_messages(surround_set.stamp_ns, result, rig, limits).items():
            if wanted(topic):
                yield OutputMessage(topic, surround_set.anchor, build())

    def _merged_messages(
        self, stamp: int, result: SurroundDepth, rig: Rig, limits: CloudLimits
    ) -> dict[str, Callable[[], Any]]:
        """Return how to build each of the messages about all cameras together."""
        contained = [name for name, present in zip(rig.names, result.present, strict=True) if present]
        description = {"stamp": stamp, "frame_id": rig.base_frame, "cameras": contained}
        return {
            MERGED_CLOUD: lambda: self._factory.point_cloud(stamp, rig.base_frame, merged_cloud(result, rig, limits)),
            MERGED_CAMERAS: lambda: self._factory.string(json.dumps(description)),
        }

    def _camera_messages(
        self, result: SurroundDepth, index: int, stamp: int, frame_id: str
    ) -> dict[str, Callable[[], Any]]:
        """Return how to build each of one camera's messages."""
        metres, intrinsics, picture = result.depth[index], result.intrinsics[index], result.pictures[index]
        return {
            DEPTH: lambda: self._factory.depth_image(stamp, frame_id, metres, self._encoding),
            DEPTH_INFO: lambda: self._factory.camera_info(stamp, frame_id, intrinsics, *metres.shape),
            PICTURE: lambda: self._factory.colour_image(stamp, frame_id, picture),
            PICTURE_INFO: lambda: self._factory.camera_info(stamp, frame_id, intrinsics, *metres.shape),
            CLOUD: lambda: self._factory.point_cloud(stamp, frame_id, organised_cloud(result, index)),
        }
