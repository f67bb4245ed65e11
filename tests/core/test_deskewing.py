# SPDX-License-Identifier: Apache-2.0
"""Points of cameras that fire one after the other, brought to one moment, in a ray-cast street of known geometry."""

from dataclasses import replace

import numpy as np
import pytest
from street_scene import RIG, WALL, seen

from cvcdepth_core.pointcloud import CameraMoments, CloudLimits, merged_cloud
from cvcdepth_core.surround_depth import SurroundDepth

SPEED, SPREAD = 10.0, 0.081
"""Metres per second, and seconds between the two cameras' exposures."""


def place(x: float, yaw: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[0, 3] = x
    return pose


@pytest.fixture(scope="module", params=[0.0, 0.03], ids=["straight", "turning"])
def drive(request) -> tuple[SurroundDepth, np.ndarray]:
    """What the left camera sees first, and the right one later from farther on; and where the vehicle was."""
    poses = np.stack([place(0.0), place(SPEED * SPREAD, request.param)])
    left, right = (seen(pose, post=False).surround for pose in poses)
    depth, pictures = np.stack([left.depth[0], right.depth[1]]), np.stack([left.pictures[0], right.pictures[1]])
    return replace(left, depth=depth, pictures=pictures), poses


def wall_of(surround: SurroundDepth, camera: int, moments: CameraMoments | None) -> np.ndarray:
    """x of the points of one camera that lie on the wall."""
    alone = replace(surround, present=np.arange(2) == camera)
    cloud = merged_cloud(alone, RIG, CloudLimits(), moments)
    return cloud[cloud[:, 2] > 0.1, 0]


def test_points_are_misplaced_by_the_way_between_exposures_and_no_longer_when_moved(drive):
    surround, poses = drive
    moved = CameraMoments.moved(RIG, poses, anchor=0)
    before = np.abs(wall_of(surround, 1, None) - WALL)
    after = np.abs(wall_of(surround, 1, moved) - WALL)
    assert np.median(before) == pytest.approx(SPEED * SPREAD, abs=0.2)
    assert after.max() < 0.05
    np.testing.assert_allclose(wall_of(surround, 0, moved), WALL, atol=1e-4)  # the anchor's stay


def test_any_camera_can_be_the_one_whose_moment_is_meant(drive):
    surround, poses = drive
    moved = CameraMoments.moved(RIG, poses, anchor=1)
    in_world = merged_cloud(surround, RIG, CloudLimits(), moved)[:, :3] @ poses[1][:3, :3].T + poses[1][:3, 3]
    assert np.abs(in_world[in_world[:, 2] > 0.1, 0] - WALL).max() < 0.05


def test_points_tell_by_how_much_later_they_were_seen_also_when_thinned(drive):
    surround, poses = drive
    moments = CameraMoments.moved(RIG, poses, anchor=0)._replace(seconds=np.array([0.0, SPREAD]))
    cloud = merged_cloud(surround, RIG, CloudLimits(), moments)
    assert cloud.shape[1] == 5
    np.testing.assert_array_equal(np.unique(cloud[:, 4]), np.float32([0, SPREAD]))
    own = merged_cloud(replace(surround, present=np.array([False, True])), RIG, CloudLimits(), moments)
    np.testing.assert_array_equal(cloud[cloud[:, 4] > 0], own)
    thin = merged_cloud(surround, RIG, CloudLimits(voxel=0.5), moments)
    assert {row.tobytes() for row in thin} < {row.tobytes() for row in cloud}
