# SPDX-License-Identifier: Apache-2.0
"""Two views of a ray-cast street (flat ground, a far wall, a post in front of it) agree where both see the same."""

import math
from dataclasses import replace

import numpy as np
import pytest
from street_scene import FOCAL, HEIGHT, RIG, WIDTH, K, seen, turned

from cvcdepth_core.rendering.agreement import PosedDepth, agreement, disagreement
from cvcdepth_core.rig.pinhole import pixel_rays
from cvcdepth_core.surround_depth import SurroundDepth


def with_depth(posed: PosedDepth, depth: np.ndarray) -> PosedDepth:
    surround = replace(posed.surround, depth=depth.astype(np.float32))
    return PosedDepth(surround, posed.world_T_camera)


def test_right_geometry_agrees_between_cameras_and_explains_the_pictures():
    view = seen()
    for i, j in ((0, 1), (1, 0)):
        found = agreement(view, i, view, j)
        assert found.pixels > 0.4 * HEIGHT * WIDTH
        assert found.median < 1e-4
        assert found.percentile_90 < 1e-3
        assert found.photometric < 0.03


@pytest.mark.parametrize(("axis", "least_90"), [("up", 0.04), ("aside", 0.005)])
def test_one_extrinsic_turned_by_one_degree_is_seen(axis, least_90):
    """Turned aside, depth of a wall ahead hardly changes, and the pictures tell."""
    view = seen()
    poses = view.world_T_camera.copy()
    turn = turned(1.0)[:3, :3]
    right_R_turned = {"aside": turn[[[0], [2], [1]], [0, 2, 1]], "up": turn[[[2], [0], [1]], [2, 0, 1]]}[axis]
    poses[1, :3, :3] = poses[1, :3, :3] @ right_R_turned
    wrong = PosedDepth(view.surround, poses)
    right, found = agreement(view, 0, view, 1), agreement(wrong, 0, wrong, 1)
    assert found.median > 100 * right.median
    assert found.percentile_90 > least_90
    assert found.photometric > 3 * right.photometric


def test_what_the_post_hides_from_the_other_camera_is_not_counted():
    view = seen()
    # The post covers some ground and wall for the right camera that the left one sees.
    difference = disagreement(view, 0, view, 1)
    z_in_right = _right_camera_depth_of_left_pixels(view)
    assert (z_in_right > 1.2).sum() > 100  # truly hidden: the other's depth is much smaller
    assert np.isnan(difference[z_in_right > 1.2]).all()
    assert (difference > 0.02).sum() < 20  # along silhouettes, which lie between the other's pixels


def _right_camera_depth_of_left_pixels(view: PosedDepth) -> np.ndarray:
    """z in the right camera over the depth that it has there, by a plain loop; 0 outside."""
    left, right = view.world_T_camera
    right_T_left = np.linalg.inv(right) @ left
    ratio = np.zeros((HEIGHT, WIDTH))
    rays = pixel_rays(K, HEIGHT, WIDTH)
    for v in range(HEIGHT):
        for u in range(WIDTH):
            x, y, z = right_T_left[:3, :3] @ (rays[v, u] * view.surround.depth[0, v, u]) + right_T_left[:3, 3]
            column, row = FOCAL * x / z + K[0, 2], FOCAL * y / z + K[1, 2]
            if z > 0 and 0 <= round(column) < WIDTH and 0 <= round(row) < HEIGHT:
                ratio[v, u] = z / view.surround.depth[1, round(row), round(column)]
    return ratio


def test_a_surface_that_one_camera_invents_is_counted_since_the_other_sees_through_it():
    view = seen(post=False)
    depth = view.surround.depth.copy()
    depth[1, 20:70, 30:90] = 4.0
    difference = disagreement(with_depth(view, depth), 0, with_depth(view, depth), 1)
    assert (difference > 0.3).sum() > 1000


def test_a_scaled_camera_disagrees_by_its_scale():
    view = seen(post=False)
    depth = view.surround.depth * np.array([1.0, 1.2])[:, None, None]
    scaled = with_depth(view, depth)
    assert agreement(scaled, 0, scaled, 1).median == pytest.approx(2 * 0.2 / 2.2, abs=0.02)


def test_far_points_and_unknown_ones_are_not_compared():
    view = seen()
    none = with_depth(view, np.full_like(view.surround.depth, np.nan))
    assert agreement(view, 0, none, 1).pixels == agreement(none, 0, view, 1).pixels == 0
    assert math.isnan(agreement(none, 0, view, 1).photometric)
    near = disagreement(view, 0, view, 1, max_depth=5.0)
    assert np.isnan(near[view.surround.depth[0] >= 5.0]).all()
    assert not np.isnan(near).all()


def test_cameras_that_share_no_view_give_nothing():
    view = seen()
    away = PosedDepth(view.surround, np.stack([view.world_T_camera[0], turned(180) @ view.world_T_camera[1]]))
    found = agreement(away, 0, away, 1)
    assert found.pixels == 0
    assert all(map(math.isnan, found[1:]))


def test_the_vehicles_motion_between_two_exposures_is_taken_into_account():
    moved = np.eye(4)
    moved[:3, 3] = 0.6, 0.0, 0.0
    first, second = seen(np.eye(4)), seen(moved)
    surround = SurroundDepth(
        np.stack([first.surround.depth[0], second.surround.depth[1]]),
        np.stack([first.surround.pictures[0], second.surround.pictures[1]]),
        first.surround.intrinsics,
        np.ones(2, bool),
    )
    known = PosedDepth.from_rig(surround, RIG, [np.eye(4), moved])
    unknown = PosedDepth.from_rig(surround, RIG, None)
    assert agreement(known, 0, known, 1).median < 1e-3
    assert agreement(unknown, 0, unknown, 1).median > 0.02
