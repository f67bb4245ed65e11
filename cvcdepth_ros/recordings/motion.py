# SPDX-License-Identifier: Apache-2.0
"""The vehicle's motion over a recording, as `/tf` or an odometry topic has it. No ROS here."""

from __future__ import annotations

from itertools import islice

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags import Recording
from cvcdepth_ros.messages.transform_topics import moving_transform_topics
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.messages.vehicle_motion import ODOMETRY_TYPE, MotionLink, VehicleMotion, motion_link

__all__ = ["ODOMETRY_TYPE", "MotionLink", "VehicleMotion", "find_motion_link"]

_MESSAGES_TO_FIND_MOTION = 1000


def find_motion_link(recording: Recording, base_frame: str, static: TransformTree) -> MotionLink | None:
    """Return the link of `/tf`, or else of an odometry topic, from elsewhere to a frame fixed to the base frame.

    None where there is none in the first thousand messages of any of these topics.
    """
    odometry = sorted(topic.name for topic in recording.topics.values() if topic.type == ODOMETRY_TYPE)
    for topic in (*moving_transform_topics(recording), *odometry):
        for message in islice(recording.messages([topic]), _MESSAGES_TO_FIND_MOTION):
            try:
                link = motion_link(topic, recording.deserialize(message), base_frame, static)
            except RecordingError:
                continue
            if link is not None:
                return link
    return None
