# SPDX-License-Identifier: Apache-2.0
"""The rig file's camera poses on `/tf_static`, but for those that TF has already."""

import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.poses import Pose
from cvcdepth_ros.messages.conversion import ros_message_factory
from cvcdepth_ros.messages.rig_assembly import RigAssembler
from cvcdepth_ros.messages.transforms import Link, TransformTree, frame_name, link_of

_STATIC, _MOVING = "/tf_static", "/tf"
_LISTENING_SECONDS = 2.0
_SAME_PLACE = 0.01  # metres, and elements of the rotation
_DEPTH = 100


class RigTransforms:
    """Listens to TF for two seconds, then publishes what nobody else does.

    A frame with two parents would break the tree of everybody: what TF has is left alone, and whoever publishes one of
    our frames later is told of.
    """

    def __init__(self, node: Node, assembler: RigAssembler) -> None:
        """Begin to listen; `assembler` knows the cameras' frames, some perhaps later. ImportError without tf2_msgs."""
        from tf2_msgs.msg import TFMessage

        self._node, self._assembler = node, assembler
        self._tree = TransformTree()
        self._ours: dict[str, Pose] = {}
        self._told: set[str] = set()
        self._began = time.monotonic()
        self._subscriptions: dict[str, Subscription] = {}
        for topic, durability in ((_STATIC, DurabilityPolicy.TRANSIENT_LOCAL), (_MOVING, DurabilityPolicy.VOLATILE)):
            self._subscriptions[topic] = node.create_subscription(TFMessage, topic, self._on_message, _qos(durability))
        self._publisher = node.create_publisher(TFMessage, _STATIC, _qos(DurabilityPolicy.TRANSIENT_LOCAL, depth=1))

    def poll(self) -> None:
        """Publish the poses whose frames are known and that TF lacks. To be called regularly."""
        if time.monotonic() - self._began < _LISTENING_SECONDS:
            return
        if _MOVING in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop(_MOVING))
        new = {frame: pose for frame, pose in self._given() if frame not in self._ours and not self._is_on_tf(frame)}
        if new:
            self._ours |= new
            base_frame, stamp = self._assembler.layout.base_frame, self._node.get_clock().now().nanoseconds
            self._publisher.publish(ros_message_factory().static_transforms(stamp, base_frame, self._ours))
            self._node.get_logger().info(f"published on {_STATIC}, below {base_frame}: {', '.join(new)}")
        for frame, pose in self._given():
            self._tell_of_difference(frame, pose)

    def close(self) -> None:
        """Drop subscriptions and publisher."""
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._node.destroy_publisher(self._publisher)

    def _given(self) -> Iterator[tuple[str, Pose]]:
        """Give the frames and poses of the cameras that the rig file places, and of its turned views."""
        yield from self._assembler.view_poses().items()
        for camera in self._assembler.layout.cameras:
            frame = self._assembler.frame_id(camera.name)
            if camera.base_T_camera is not None and frame:
                yield frame_name(frame), camera.base_T_camera.matrix(f"camera {camera.name}: base_T_camera")

    def _is_on_tf(self, frame: str) -> bool:
        """Whether the frame has a parent on TF, or is itself above the vehicle's frame."""
        above_vehicle = self._tree.ancestors(self._assembler.layout.base_frame)
        return len(self._tree.ancestors(frame)) > 1 or frame in above_vehicle

    def _on_message(self, message: Any) -> None:
        for transform in message.transforms:
            with suppress(TransformError):  # one that is impossible is no place for a frame
                self._add(link_of(transform))

    def _add(self, link: Link) -> None:
        if link.child not in self._ours:
            self._tree.add(link.parent, link.child, link.parent_T_child)
        elif link.parent != frame_name(self._assembler.layout.base_frame):
            self._tell(link.child, f"hangs from {link.parent} too, which breaks the tree: set publish_tf:=false")

    def _tell_of_difference(self, frame: str, pose: Pose) -> None:
        try:
            on_tf = self._tree.lookup(self._assembler.layout.base_frame, frame)
        except TransformError:
            return
        if frame not in self._ours and not np.allclose(on_tf, pose, atol=_SAME_PLACE):
            metres = np.linalg.norm(on_tf[:3, 3] - pose[:3, 3])
            self._tell(frame, f"is elsewhere on TF than in the rig file, by {metres:.2f} m; the rig file's is used")

    def _tell(self, frame: str, text: str) -> None:
        if frame not in self._told:
            self._told.add(frame)
            self._node.get_logger().warning(f"{_STATIC}: frame {frame} {text}")


def _qos(durability: DurabilityPolicy, depth: int = _DEPTH) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )
