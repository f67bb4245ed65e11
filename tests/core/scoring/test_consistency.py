# SPDX-License-Identifier: Apache-2.0
"""Consistency on a ray-cast street: flat ground, a far wall, and a post in front of it."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from street_scene import FOCAL, HEIGHT, WIDTH, K, camera, cast, turned

from cvcdepth_core.rig.pinhole import pixel_rays
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.scoring.consistency import (
    Agreement,
    AgreementRow,
    AgreementTable,
    PosedDepth,
    agreement,
    disagreement,
    spatial_rows,
    summarise_agreement,
    temporal_rows,
)
from cvcdepth_core.surround_depth import SurroundDepth

RIG = Rig((camera("left", 0.4, 8.0), camera("right", -0.4, -8.0)), "base_link", "left", {})


def seen(world_T_base: np.ndarray | None = None, post: bool = True) -> PosedDepth:
    """What the rig sees from a place, with the right depth and the right poses."""
    poses = [(np.eye(4) if world_T_base is None else world_T_base) @ camera.base_T_camera for camera in RIG.cameras]
    depth, pictures = map(np.stack, zip(*(cast(pose, post) for pose in poses), strict=True))
    surround = SurroundDepth(depth, pictures, np.stack([K, K]), np.ones(2, bool))
    return PosedDepth.of(surround, RIG, None if world_T_base is None else [world_T_base] * 2)


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


def test_depth_agrees_along_the_recorded_motion_and_not_along_a_wrong_one():
    far_away = np.array([5e5, 4e6, 30.0])  # UTM coordinates must not cost precision
    here, there = np.eye(4), np.eye(4)
    there[:3, 3] = 0.5, 0.1, 0.0
    earlier, later = seen(here), seen(there)
    shifted = [
        PosedDepth(p.surround, p.world_T_camera + np.pad(far_away[:, None], ((0, 1), (3, 0)))) for p in (earlier, later)
    ]
    for first, second in ((later, earlier), (shifted[1], shifted[0])):
        rows = temporal_rows(RIG, first, second, 80.0)
        assert [(row.camera, row.other, row.kind) for row in rows] == [
            ("left", "left", "temporal"),
            ("right", "right", "temporal"),
        ]
        for row in rows:
            assert row.travelled == pytest.approx(math.hypot(0.5, 0.1))
            assert row.agreement.median < 1e-3
            assert row.agreement.photometric < 0.03
    still = PosedDepth(later.surround, earlier.world_T_camera)
    assert temporal_rows(RIG, still, earlier, 80.0)[0].agreement.median > 0.02


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
    known = PosedDepth.of(surround, RIG, [np.eye(4), moved])
    unknown = PosedDepth.of(surround, RIG, None)
    assert agreement(known, 0, known, 1).median < 1e-3
    assert agreement(unknown, 0, unknown, 1).median > 0.02


def test_every_neighbour_pair_has_a_row():
    rows = spatial_rows(RIG, seen(), 80.0)
    assert [row.pair for row in rows] == [("spatial", "left", "right"), ("spatial", "right", "left")]
    assert rows[0].travelled == pytest.approx(0.8)


def compared(values: Sequence[float]) -> AgreementTable:
    """A comparison of the same pair in every set, with nothing to compare where a value is NaN."""
    table = AgreementTable()
    for number, value in enumerate(values):
        found = Agreement(0 if math.isnan(value) else 9, value, value, value)
        table.add(number, [AgreementRow("spatial", "left", "right", 0.8, found)])
    return table


@given(st.permutations(range(6)), st.integers(0, 6))
def test_the_summary_is_the_mean_over_sets_in_any_order_and_passes_over_empty_ones(order, cut):
    values = [0.1, 0.2, 0.7, 0.3, 1e-9, math.nan]
    shuffled = [values[i] for i in order]
    (summary,) = summarise_agreement([compared(shuffled[:cut]), compared(shuffled[cut:])]).values()
    assert summary == (5, *[math.fsum(values[:5]) / 5] * 3)


def test_a_table_keeps_every_number_and_can_be_made_again_from_its_columns():
    table = compared([0.1, math.nan])
    table.add(1, [AgreementRow("temporal", "left", "left", 1.5, Agreement(4_000_000, 0.5, 0.9, 1 / 3))])
    again = AgreementTable(table.pairs, table.columns)
    assert again.pairs == [("spatial", "left", "right"), ("temporal", "left", "left")]
    rows = again.columns.tolist()
    assert rows[0] == (0, 0, 0.8, 9, 0.1, 0.1, 0.1)
    assert rows[1][:4] == (1, 0, 0.8, 0)
    assert all(map(math.isnan, rows[1][4:]))
    assert rows[2] == (1, 1, 1.5, 4_000_000, 0.5, 0.9, 1 / 3)
