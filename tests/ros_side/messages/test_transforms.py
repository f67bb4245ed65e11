# SPDX-License-Identifier: Apache-2.0
"""Transforms: looked up through the tree, interpolated over time, and refused by name when they cannot be right."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import CAMERAS, SAMPLE

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.poses import pose_from_quaternion
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.messages.transforms import PoseTrack, TransformTree


def shifted(x: float, y: float = 0.0, z: float = 0.0) -> Any:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def turned(degrees: float, x: float = 0.0) -> Any:
    """A turn to the left (about z), and a shift."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def tf_message(
    parent: str, child: str, translation: tuple = (0, 0, 0), rotation: tuple = (0, 0, 0, 1), ns: int = 0
) -> Any:
    stamp = SimpleNamespace(sec=ns // 10**9, nanosec=ns % 10**9)
    transform = SimpleNamespace(
        translation=SimpleNamespace(**dict(zip("xyz", translation, strict=True))),
        rotation=SimpleNamespace(**dict(zip("xyzw", rotation, strict=True))),
    )
    header = SimpleNamespace(stamp=stamp, frame_id=parent)
    return SimpleNamespace(transforms=[SimpleNamespace(header=header, child_frame_id=child, transform=transform)])


@pytest.fixture
def vehicle() -> TransformTree:
    """base_link -> roof -> camera_left (looking left) and roof -> lidar."""
    tree = TransformTree()
    tree.add("base_link", "roof", shifted(1, 0, 2))
    tree.add("roof", "camera_left", turned(90, x=0.5))
    tree.add("roof", "lidar", shifted(-2))
    return tree


# The tree


def test_points_go_up_the_tree(vehicle: TransformTree):
    np.testing.assert_allclose(vehicle.lookup("base_link", "camera_left") @ [1, 0, 0, 1], [1.5, 1, 2, 1])


def test_points_go_down_the_tree(vehicle: TransformTree):
    np.testing.assert_allclose(vehicle.lookup("camera_left", "base_link") @ [1.5, 1, 2, 1], [1, 0, 0, 1], atol=1e-15)


def test_points_go_from_one_branch_to_another(vehicle: TransformTree):
    np.testing.assert_allclose(vehicle.lookup("camera_left", "lidar") @ [2.5, 3, 0, 1], [3, 0, 0, 1], atol=1e-15)


def test_a_frame_seen_from_itself_is_where_it_is(vehicle: TransformTree):
    np.testing.assert_array_equal(vehicle.lookup("lidar", "lidar"), np.eye(4))


def test_leading_slashes_do_not_matter(vehicle: TransformTree):
    vehicle.add("/lidar", "/spinner", shifted(0, 0, 1))
    assert vehicle.lookup("base_link", "spinner")[2, 3] == 3
    assert vehicle.lookup("/base_link", "/roof")[2, 3] == 2


def test_a_link_that_is_sent_again_is_renewed(vehicle: TransformTree):
    vehicle.add("roof", "lidar", shifted(-3))
    assert vehicle.lookup("roof", "lidar")[0, 3] == -3


def test_a_matrix_changed_later_by_its_owner_does_not_change_the_tree(vehicle: TransformTree):
    pose = shifted(1)
    vehicle.add("roof", "antenna", pose)
    pose[0, 3] = 99
    assert vehicle.lookup("roof", "antenna")[0, 3] == 1


def test_a_missing_frame_is_named_with_the_known_ones(vehicle: TransformTree):
    known = r"known are \['base_link', 'camera_left', 'lidar', 'roof'\]"
    with pytest.raises(TransformError, match=f"base_link <- camera_rear: frame 'camera_rear' is unknown; {known}"):
        vehicle.lookup("base_link", "camera_rear")


def test_an_empty_tree_says_that_it_knows_nothing():
    with pytest.raises(TransformError, match=r"frame 'base_link' is unknown; known are \[\]"):
        TransformTree().lookup("base_link", "camera")


def test_a_missing_link_between_two_trees_is_named_with_their_roots(vehicle: TransformTree):
    vehicle.add("trailer", "camera_trailer", shifted(0))
    with pytest.raises(TransformError, match="'camera_trailer' from 'trailer', and nothing connects"):
        vehicle.lookup("base_link", "camera_trailer")


def test_a_second_parent_is_refused(vehicle: TransformTree):
    with pytest.raises(TransformError, match="'lidar' has two parents, 'roof' and 'base_link'"):
        vehicle.add("base_link", "lidar", shifted(0))


@pytest.mark.parametrize(("parent", "child"), [("lidar", "base_link"), ("roof", "base_link"), ("map", "map")])
def test_a_loop_is_refused(vehicle: TransformTree, parent: str, child: str):
    with pytest.raises(TransformError, match=f"{parent} <- {child} closes a loop"):
        vehicle.add(parent, child, shifted(0))


def test_a_matrix_that_is_no_rigid_motion_is_refused(vehicle: TransformTree):
    with pytest.raises(TransformError, match="roof <- camera"):
        vehicle.add("roof", "camera", np.diag([2.0, 1, 1, 1]))


# Messages


@pytest.mark.parametrize("norm", [0.0, 0.99, 1.01])
def test_a_quaternion_that_is_not_a_unit_one_is_named(norm: float):
    with pytest.raises(TransformError, match=r"base_link <- camera: quaternion .* has norm"):
        TransformTree().add_message(tf_message("base_link", "camera", rotation=(0, 0, 0, norm)))


def test_a_quaternion_that_was_rounded_is_normalised():
    tree = TransformTree()
    tree.add_message(tf_message("base_link", "camera", rotation=(0.7071, 0, 0, 0.7071)))
    rotation = tree.lookup("base_link", "camera")[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_named(bad: float):
    with pytest.raises(TransformError, match=f"base_link <- camera: .*{bad}"):
        TransformTree().add_message(tf_message("base_link", "camera", translation=(0, bad, 0)))


def test_the_recorded_tree_reaches_every_camera_and_the_lidar():
    tree = TransformTree()
    with open_recording(SAMPLE) as recording:
        for message in recording.messages(["/tf_static"]):
            tree.add_message(recording.deserialize(message))
    headings = {}
    for camera in CAMERAS:
        base_T_camera = tree.lookup("base_link", f"{camera}_camera_optical_frame")
        headings[camera] = np.degrees(np.arctan2(base_T_camera[1, 2], base_T_camera[0, 2]))  # of the optical axis
    ordered = sorted(headings, key=lambda camera: headings[camera])
    assert ordered in (
        ["right", "front_right", "front", "front_left", "left", "back"],
        ["back", "right", "front_right", "front", "front_left", "left"],
    )
    assert abs(headings["front"]) < 5
    assert tree.lookup("base_link", "pandar64")[2, 3] > 0.5


# Over time


def test_a_pose_between_two_stamps_is_interpolated():
    track = PoseTrack("odom", "base_link")
    track.add(1000, turned(0, x=0))
    track.add(2000, turned(90, x=10))
    np.testing.assert_allclose(track.lookup(1250), turned(22.5, x=2.5), atol=1e-12)


@given(st.floats(-179, 179), st.floats(-179, 179), st.integers(0, 1000))
def test_a_turn_is_at_constant_speed_and_by_the_shorter_way(start: float, turn: float, stamp: int):
    track = PoseTrack("odom", "base_link")
    track.add(0, turned(start))
    track.add(1000, turned(start + turn))
    np.testing.assert_allclose(track.lookup(stamp), turned(start + turn * stamp / 1000), atol=1e-9)


def test_a_stamp_that_was_recorded_gives_exactly_its_pose():
    track = PoseTrack("odom", "base_link")
    poses = {stamp: turned(stamp / 7, x=stamp / 3) for stamp in (30, 10, 20)}  # out of order, as over the network
    for stamp, pose in poses.items():
        track.add(stamp, pose)
    assert track.span == (10, 30)
    for stamp, pose in poses.items():
        np.testing.assert_array_equal(track.lookup(stamp), pose)


def test_a_stamp_that_comes_twice_counts_once():
    track = PoseTrack("odom", "base_link")
    track.add(10, turned(0, x=1))
    track.add(10, turned(0, x=2))
    assert len(track) == 1
    assert track.lookup(10)[0, 3] == 2


@pytest.mark.parametrize("stamp", [999, 2001])
def test_nothing_is_extrapolated(stamp: int):
    track = PoseTrack("odom", "base_link")
    track.add(1000, turned(0))
    track.add(2000, turned(0))
    with pytest.raises(TransformError, match=f"odom <- base_link at {stamp} ns: it is known from 1000 to 2000"):
        track.lookup(stamp)


def test_nothing_is_interpolated_over_a_long_gap():
    track = PoseTrack("odom", "base_link", longest_gap=0.5)
    for tenths in (0, 5, 11):
        track.add(tenths * 10**8, turned(0, x=tenths))
    assert track.lookup(4 * 10**8)[0, 3] == pytest.approx(4)
    assert track.lookup(11 * 10**8)[0, 3] == 11
    between = r"at 800000000 ns: it is known at 500000000 and 1100000000 ns, 0\.600 s apart, more than 0\.5 s"
    with pytest.raises(TransformError, match=between):
        track.lookup(8 * 10**8)


def test_a_track_without_poses_says_so():
    with pytest.raises(TransformError, match="no transform odom <- base_link at any time"):
        PoseTrack("odom", "base_link").lookup(5)


def test_a_track_takes_only_its_own_link():
    track = PoseTrack("/odom", "base_link")
    track.add_message(tf_message("map", "odom", ns=5))
    track.add_message(tf_message("odom", "/base_link", translation=(3, 0, 0), ns=3 * 10**9 + 7))
    assert track.span == (3 * 10**9 + 7, 3 * 10**9 + 7)
    assert track.lookup(3 * 10**9 + 7)[0, 3] == 3


def test_the_recorded_track_agrees_with_odometry_and_is_smooth_between_its_stamps():
    track, thinned, odometry = PoseTrack("odom", "base_link"), PoseTrack("odom", "base_link"), {}
    with open_recording(SAMPLE) as recording:
        for index, message in enumerate(recording.messages(["/tf"])):
            track.add_message(recording.deserialize(message))
            if index % 7 == 0:
                thinned.add_message(recording.deserialize(message))
        for message in recording.messages(["/odom"]):
            odom = recording.deserialize(message)
            p, q = odom.pose.pose.position, odom.pose.pose.orientation
            stamp = odom.header.stamp.sec * 10**9 + odom.header.stamp.nanosec
            odometry[stamp] = pose_from_quaternion((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
    assert len(odometry) == 70
    for stamp, odom_T_base in odometry.items():
        np.testing.assert_allclose(track.lookup(stamp), odom_T_base, atol=1e-9)
        if thinned.span[0] <= stamp <= thinned.span[1]:
            np.testing.assert_allclose(thinned.lookup(stamp), odom_T_base, atol=0.02)
