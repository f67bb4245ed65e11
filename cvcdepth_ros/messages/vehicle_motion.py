# SPDX-License-Identifier: Apache-2.0
"""The vehicle's motion as `/tf` or odometry messages tell it. No ROS here."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.poses import Pose, pose_from_quaternion
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.transforms import PoseTrack, TransformTree, frame_name

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"


class MotionLink(NamedTuple):
    """The moving link between the world and the vehicle."""

    topic: str
    parent: str
    child: str
    """A frame of the vehicle."""
    child_T_base: Pose
    """[4, 4] the base frame's fixed pose in that frame."""


class VehicleMotion:
    """The vehicle's pose over time, from a moving link of `/tf` or an odometry topic."""

    def __init__(self, link: MotionLink) -> None:
        """Follow this link; messages of its topic are still to be added."""
        self.topic = link.topic
        self._track = PoseTrack(link.parent, link.child)
        self._child_T_base = link.child_T_base

    def add(self, message: Any) -> None:
        """Add a `tf2_msgs/TFMessage` or `nav_msgs/Odometry`; TransformError names the topic of an impossible pose."""
        if hasattr(message, "transforms"):
            try:
                self._track.add_message(message)
            except TransformError as error:
                raise TransformError(f"{self.topic}: {error}") from error
            return
        p, q = message.pose.pose.position, message.pose.pose.orientation
        pose = pose_from_quaternion((p.x, p.y, p.z), (q.x, q.y, q.z, q.w), self.topic)
        self._track.add(stamp_ns(message), pose)

    def base_pose(self, stamp: int) -> Pose:
        """Return world_T_base [4, 4], the world being the motion link's parent frame, at a stamp (ns).

        Raises TransformError outside of the time for which messages were added: nothing is extrapolated.
        """
        return self._track.lookup(stamp) @ self._child_T_base

    @property
    def newest_ns(self) -> int | None:
        """The stamp of the latest pose; None before the first."""
        return self._track.span[1] if len(self._track) else None

    def forget_before(self, stamp: int) -> None:
        """Drop what no stamp (ns) at or after this one needs, so that memory does not grow with the recording."""
        self._track.forget_before(stamp)


def motion_link(topic: str, message: Any, base_frame: str, static: TransformTree) -> MotionLink | None:
    """Return the link of a `tf2_msgs/TFMessage` or `nav_msgs/Odometry` from elsewhere to a frame fixed to the base.

    None where the message has none.
    """
    for link in getattr(message, "transforms", [message]):
        parent, child = frame_name(link.header.frame_id), frame_name(link.child_frame_id)
        child_T_base = _fixed_pose(static, child, base_frame)
        # Where sensors' fixed links are on /tf too, both of their ends ride along with the base.
        if child_T_base is not None and _fixed_pose(static, parent, base_frame) is None:
            return MotionLink(topic, parent, child, child_T_base)
    return None


def _fixed_pose(static: TransformTree, frame: str, base_frame: str) -> Pose | None:
    """Return frame_T_base where the two are fixed to each other, else None."""
    if frame == frame_name(base_frame):
        return np.eye(4)
    try:
        return static.lookup(frame, base_frame)
    except TransformError:
        return None
