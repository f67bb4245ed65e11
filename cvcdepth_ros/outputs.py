# SPDX-License-Identifier: Apache-2.0
"""The node's publishers. What nobody subscribes is not computed."""

from collections.abc import Mapping
from typing import NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from cvcdepth_core.estimator import SurroundDepth
from cvcdepth_core.pointcloud import CloudLimits, merged_cloud, organised_cloud
from cvcdepth_core.rig import Rig
from cvcdepth_ros.messages import ros_message_factory


class _CameraPublishers(NamedTuple):
    depth: Publisher
    depth_info: Publisher
    picture: Publisher
    points: Publisher


class SurroundOutputs:
    """Publishes one set's depth, pictures and clouds under the node's private names."""

    def __init__(self, node: Node, cameras: list[str], depth_encoding: str) -> None:
        self._node = node
        self._messages = ros_message_factory()
        self._encoding = depth_encoding
        self._points = self._publisher(PointCloud2, "~/points")
        self._cameras = {
            name: _CameraPublishers(
                depth=self._publisher(Image, f"~/{name}/depth/image_rect"),
                depth_info=self._publisher(CameraInfo, f"~/{name}/depth/camera_info"),
                picture=self._publisher(Image, f"~/{name}/image_rect"),
                points=self._publisher(PointCloud2, f"~/{name}/points"),
            )
            for name in cameras
        }

    def wanted(self) -> bool:
        """Whether anybody subscribes anything."""
        return any(publisher.get_subscription_count() for publisher in self._all())

    def publish(
        self,
        surround: SurroundDepth,
        rig: Rig,
        stamps: Mapping[str, int],
        frame_ids: Mapping[str, str],
        limits: CloudLimits,
    ) -> None:
        """Publish one set.

        What belongs to one camera carries that camera's own stamp (ns) and optical frame, so that it matches the input
        image exactly; the merged cloud carries the anchor camera's stamp and the base frame.
        """
        for index, name in enumerate(rig.names):
            self._publish_camera(surround, index, name, stamps[name], frame_ids[name])
        if self._points.get_subscription_count():
            cloud = merged_cloud(surround, rig, limits)
            self._points.publish(self._messages.point_cloud(stamps[rig.anchor], rig.base_frame, cloud))

    def close(self) -> None:
        """Drop all publishers."""
        for publisher in self._all():
            self._node.destroy_publisher(publisher)

    def _publish_camera(self, surround: SurroundDepth, index: int, name: str, stamp: int, frame_id: str) -> None:
        publishers, depth = self._cameras[name], surround.depth[index]
        if publishers.depth.get_subscription_count():
            publishers.depth.publish(self._messages.depth_image(stamp, frame_id, depth, self._encoding))
        if publishers.depth_info.get_subscription_count():
            info = self._messages.camera_info(stamp, frame_id, surround.intrinsics[index], *depth.shape)
            publishers.depth_info.publish(info)
        if publishers.picture.get_subscription_count():
            publishers.picture.publish(self._messages.colour_image(stamp, frame_id, surround.pictures[index]))
        if publishers.points.get_subscription_count():
            publishers.points.publish(self._messages.point_cloud(stamp, frame_id, organised_cloud(surround, index)))

    def _all(self) -> list[Publisher]:
        return [self._points, *(publisher for camera in self._cameras.values() for publisher in camera)]

    def _publisher(self, message_class: type, topic: str) -> Publisher:
        return self._node.create_publisher(
            message_class,
            topic,
            # Overrides are written into the profile that is handed over: each publisher needs its own.
            QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.RELIABLE),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
