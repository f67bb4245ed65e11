# SPDX-License-Identifier: Apache-2.0
"""The output topics and their messages, the same whether a node publishes them or a recording stores them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from cvcdepth_core.estimator import SurroundDepth
from cvcdepth_core.pointcloud import CloudLimits, merged_cloud, organised_cloud
from cvcdepth_core.rig import Rig
from cvcdepth_ros.camera_discovery import CAMERA_INFO_TYPE, IMAGE_TYPE
from cvcdepth_ros.messages import MessageFactory

POINT_CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"

MERGED_CLOUD = "points"
DEPTH, DEPTH_INFO, PICTURE, CLOUD = "depth/image_rect", "depth/camera_info", "image_rect", "points"
_CAMERA_TYPES = {
    DEPTH: IMAGE_TYPE,
    DEPTH_INFO: CAMERA_INFO_TYPE,
    PICTURE: IMAGE_TYPE,
    CLOUD: POINT_CLOUD_TYPE,
}


class OutputMessage(NamedTuple):
    """One message of a set."""

    topic: str
    """Below the node's name."""
    camera: str
    """The camera whose stamp it carries: its own, or the anchor for the merged cloud."""
    message: Any


def output_types(cameras: Sequence[str]) -> dict[str, str]:
    """Return every output topic, below the node's name, with its message type."""
    per_camera = {f"{camera}/{part}": type_ for camera in cameras for part, type_ in _CAMERA_TYPES.items()}
    return {**per_camera, MERGED_CLOUD: POINT_CLOUD_TYPE}


class SurroundMessages:
    """Builds the messages of surround sets, with the message classes of one library."""

    def __init__(self, factory: MessageFactory, depth_encoding: str) -> None:
        self._factory = factory
        self._encoding = depth_encoding

    def of_set(
        self,
        depth: SurroundDepth,
        rig: Rig,
        stamps: Mapping[str, int],
        frame_ids: Mapping[str, str],
        limits: CloudLimits,
        wanted: Callable[[str], object],
    ) -> Iterator[OutputMessage]:
        """Build, one after the other, the messages of the topics that are `wanted`.

        What belongs to one camera carries that camera's own stamp (ns) and optical frame, so that it matches the input
        image exactly; the merged cloud carries the anchor camera's stamp and the base frame.
        """
        for index, camera in enumerate(rig.names):
            for part, build in self._camera_messages(depth, index, stamps[camera], frame_ids[camera]).items():
                if wanted(f"{camera}/{part}"):
                    yield OutputMessage(f"{camera}/{part}", camera, build())
        if wanted(MERGED_CLOUD):
            cloud = merged_cloud(depth, rig, limits)
            message = self._factory.point_cloud(stamps[rig.anchor], rig.base_frame, cloud)
            yield OutputMessage(MERGED_CLOUD, rig.anchor, message)

    def _camera_messages(
        self, depth: SurroundDepth, index: int, stamp: int, frame_id: str
    ) -> dict[str, Callable[[], Any]]:
        """Return how to build each of one camera's messages."""
        metres, intrinsics, picture = depth.depth[index], depth.intrinsics[index], depth.pictures[index]
        return {
            DEPTH: lambda: self._factory.depth_image(stamp, frame_id, metres, self._encoding),
            DEPTH_INFO: lambda: self._factory.camera_info(stamp, frame_id, intrinsics, *metres.shape),
            PICTURE: lambda: self._factory.colour_image(stamp, frame_id, picture),
            CLOUD: lambda: self._factory.point_cloud(stamp, frame_id, organised_cloud(depth, index)),
        }
