# SPDX-License-Identifier: Apache-2.0
"""Poses of the vehicle from live messages: between those received, waited for a little, never made up."""

import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from recordings import JAZZY

from cvcdepth_core.rig.poses import Pose
from cvcdepth_ros.live.vehicle_poses import VehiclePoses
from cvcdepth_ros.messages.conversion import Covariances, bag_message_factory
from cvcdepth_ros.messages.transforms import TransformTree

MS = 1_000_000
TF = "/tf"


def place(x: float) -> Pose:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def moved(stamp: int, x: float, parent: str = "odom", child: str = "base_link") -> Any:
    message = bag_message_factory().static_transforms(stamp, parent, {child: place(x)})
    assert isinstance(message, JAZZY.types["tf2_msgs/msg/TFMessage"]) or message.transforms
    return message


def poses(fixed: Mapping[tuple[str, str], Pose] | None = None) -> VehiclePoses:
    tree = TransformTree()
    for (parent, child), pose in (fixed or {}).items():
        tree.add(parent, child, pose)
    return VehiclePoses("base_link", tree)


def test_a_pose_lies_between_the_two_around_it():
    found = poses()
    for step in range(3):
        found.add(TF, moved(step * 100 * MS, 1.0 * step))
    at = found.poses_at({"front": 50 * MS, "left": 125 * MS})
    assert at["front"][0, 3] == pytest.approx(0.5)
    assert at["left"][0, 3] == pytest.approx(1.25)
    assert found.topic == TF


def test_a_frame_that_is_fixed_to_the_base_will_do():
    found = poses({("base_link", "imu"): place(2.0)})
    found.add(TF, moved(0, 10.0, child="imu"))
    assert found.poses_at({"front": 0})["front"][0, 3] == pytest.approx(8.0)


def test_fixed_links_on_tf_are_no_motion():
    found = poses({("base_link", "imu"): place(2.0)})
    found.add(TF, moved(0, 2.0, parent="base_link", child="imu"))
    assert found.topic == ""
    assert found.poses_at({"front": 0}) is None


def test_odometry_messages_are_motion_too():
    found = poses()
    errors = Covariances(np.eye(6), np.eye(6))
    for stamp in (0, 100 * MS):
        message = bag_message_factory().odometry(stamp, "odom", "base_link", place(stamp / 1e8), np.arange(6.0), errors)
        found.add("/odom", message)
    assert found.poses_at({"front": 50 * MS})["front"][0, 3] == pytest.approx(0.5)
    assert message.twist.twist.angular.z == 5.0
    assert message.pose.covariance[7] == 1.0


def test_a_pose_that_comes_a_little_later_is_waited_for():
    found = poses()
    found.add(TF, moved(0, 0.0))
    later = threading.Timer(0.02, lambda: found.add(TF, moved(100 * MS, 1.0)))
    later.start()
    at = found.poses_at({"front": 100 * MS})
    later.join()
    assert at is not None
    assert at["front"][0, 3] == 1.0


def test_nothing_is_made_up_for_a_pose_that_does_not_come():
    found = poses()
    found.add(TF, moved(0, 0.0))
    assert found.poses_at({"front": 100 * MS}) is None
    began = time.monotonic()
    assert found.poses_at({"front": 60_000 * MS}) is None  # a source that is silent for long is not waited for
    assert time.monotonic() - began < 0.09


def test_stamps_that_go_back_begin_anew():
    found = poses()
    for stamp in (60_000 * MS, 60_100 * MS):
        found.add(TF, moved(stamp, 5.0))
    for stamp in (0, 100 * MS):
        found.add(TF, moved(stamp, 7.0))
    assert found.poses_at({"front": 50 * MS})["front"][0, 3] == 7.0
    assert found.poses_at({"front": 60_050 * MS}) is None


def test_an_impossible_pose_is_told_and_costs_nothing_else():
    found = poses()
    found.add(TF, moved(0, 1.0))
    broken = moved(100 * MS, 1.0)
    broken.transforms[0].transform.rotation.w = 0.0
    found.add(TF, broken)
    assert "quaternion" in found.problem
    found.add(TF, moved(100 * MS, 3.0))
    assert found.problem == ""
    assert found.poses_at({"front": 50 * MS})["front"][0, 3] == pytest.approx(2.0)
