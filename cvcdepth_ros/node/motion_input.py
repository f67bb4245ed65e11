# SPDX-License-Identifier: Apache-2.0
"""The node's subscriptions for the vehicle's motion: `/tf` with `/tf_static`, or an odometry topic."""

from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from cvcdepth_core.errors import TransformError
from cvcdepth_ros.live.vehicle_poses import VehiclePoses
from cvcdepth_ros.messages.conversion import ros_message_class
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.messages.vehicle_motion import ODOMETRY_TYPE

_TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"
_MOVING, _STATIC = "/tf", "/tf_static"


class MotionInput:
    """Hands what it receives to `poses`, from when somebody needs them on: `/tf` can be a lot of messages."""

    def __init__(self, node: Node, base_frame: str, odometry_topic: str) -> None:
        """Listen to nothing yet; without `odometry_topic`, the motion is that of `/tf`."""
        self._node = node
        self._odometry_topic = odometry_topic
        self._fixed = TransformTree()
        self.poses = VehiclePoses(base_frame, self._fixed)
        self._subscriptions: list[Subscription] | None = None

    def connect(self) -> None:
        """Subscribe, unless that has been done."""
        if self._subscriptions is not None:
            return
        self._subscriptions = []
        try:
            self._subscribe(_TRANSFORMS_TYPE, _STATIC, self._add_fixed, is_latched=True)
            if not self._odometry_topic:
                self._subscribe(_TRANSFORMS_TYPE, _MOVING, lambda message: self.poses.add(_MOVING, message))
        except ImportError:
            if not self._odometry_topic:
                self._node.get_logger().info("motion is taken from the pictures: tf2_msgs is not installed")
        if self._odometry_topic:
            topic = self._odometry_topic
            self._subscribe(ODOMETRY_TYPE, topic, lambda message: self.poses.add(topic, message))

    def close(self) -> None:
        """Drop the subscriptions."""
        for subscription in self._subscriptions or ():
            self._node.destroy_subscription(subscription)

    def _add_fixed(self, message: Any) -> None:
        try:
            self._fixed.add_message(message)
        except TransformError as error:
            self._node.get_logger().error(f"{_STATIC}: {error}", throttle_duration_sec=5.0)

    def _subscribe(self, type_name: str, topic: str, callback: Any, is_latched: bool = False) -> None:
        durability = DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability
        )
        found = self._node.create_subscription(ros_message_class(type_name), topic, callback, qos)
        self._subscriptions = [*(self._subscriptions or ()), found]
