# SPDX-License-Identifier: Apache-2.0
"""Obstacles found and invented, in a ray-cast street whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from street_scene import RIG, seen

from cvcdepth_core.scoring.driven_space import DrivenSpace
from cvcdepth_core.scoring.obstacles import RANGES, ObstacleScorer, ObstacleScores
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_core.surround_depth import SurroundDepth


def scores(predicted: SurroundDepth, true: SurroundDepth | None) -> ObstacleScores:
    depths = np.full_like(predicted.depth, np.nan) if true is None else true.depth
    scorer = ObstacleScorer()
    scorer.add(predicted, RIG, [SparseDepth.from_image(depth) for depth in depths], None, 0)
    return scorer.scores()


@pytest.fixture(scope="module")
def with_post() -> SurroundDepth:
    return seen().surround


@pytest.fixture(scope="module")
def without_post() -> SurroundDepth:
    return seen(post=False).surround


def test_right_depth_finds_every_obstacle_and_invents_none(with_post):
    found = scores(with_post, with_post)
    assert found.has_truth
    assert found.counts[0, :, 0].tolist()[0] == 0  # nothing stands within 5 m
    assert found.counts[0, 1, 0] > 2
    np.testing.assert_array_equal(found.recall()[0, 1:], 1.0)
    np.testing.assert_array_equal(found.precision()[0, 1:], 1.0)
    assert np.abs(found.errors).max() < 0.3
    assert found.sectors[1:].tolist() == [0, 0]


def test_a_post_that_depth_does_not_show_is_missed(with_post, without_post):
    found = scores(without_post, with_post)
    assert found.recall()[0, 1] == 0
    assert found.recall()[0, 2] < 1
    assert np.nanmax(found.errors) > 4  # the wall is behind it


def test_a_post_that_is_not_there_is_invented(with_post, without_post):
    found = scores(with_post, without_post)
    assert found.counts[0, 1, 0] == 0
    assert found.precision()[0, 1] == 0
    assert np.isnan(found.recall()[0, 1])


def test_what_the_truth_does_not_tell_counts_for_nothing(with_post, without_post):
    blind = replace(without_post, depth=np.where(without_post.depth > 5, np.float32(np.nan), without_post.depth))
    found = scores(with_post, blind)
    assert found.counts[0, 1, 2] == 0


def test_wrong_scale_finds_nothing_that_is_there(with_post):
    near = replace(with_post, depth=0.6 * with_post.depth)
    found = scores(near, with_post)
    assert found.recall()[0, 1] < 0.5
    assert found.precision()[0, 1] < 0.5
    assert np.median(found.errors) < -1.5


def test_less_sure_points_are_left_out_along_the_curve(with_post):
    confidence = np.where(with_post.depth < 8, np.float32(0.5), np.float32(0.9))
    found = scores(replace(with_post, confidence=confidence), with_post)
    assert found.told_thresholds == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(found.recall()[:3, 1], 1.0)
    np.testing.assert_array_equal(found.recall()[3:, 1], 0.0)
    assert [point["min_confidence"] for point in found.to_json()["by_confidence"]] == [0.0, 0.2, 0.4, 0.6, 0.8]


def test_without_truth_nothing_is_compared(with_post):
    found = scores(with_post, None)
    assert not found.has_truth
    assert not found.counts.any()
    within = found.to_json()["within"]["20"]
    assert within["recall"] is None
    assert within["precision"] is None


def test_recordings_are_joined_and_kept_without_loss(with_post, without_post):
    one, two = scores(with_post, with_post), scores(without_post, with_post)
    both = ObstacleScores.merged([one, two])
    np.testing.assert_array_equal(both.counts, one.counts + two.counts)
    assert len(both.errors) == len(one.errors) + len(two.errors)
    again = ObstacleScores.from_arrays(both.to_arrays())
    assert again.to_json() == both.to_json()


def pose(x: float, y: float = 0.0) -> np.ndarray:
    found = np.eye(4)
    found[:2, 3] = x, y
    return found


def test_where_the_vehicle_has_driven_nothing_can_have_stood():
    driven, nothing = DrivenSpace(RANGES), np.zeros((0, 2))
    driven.add(pose(0), np.array([[8.0, 0.3], [8.0, 3.0]]), 0)
    for i in range(1, 13):
        driven.add(pose(i), nothing, i * 10**8)
    within_5, within_10, within_20 = driven.counts().tolist()
    assert within_5[1] == 0
    assert within_10[1] == within_20[1] == 3  # at 7, 8 and 9 m something was said to stand where the vehicle is
    assert within_20[0] == sum(1 for a in range(13) for b in range(a + 1, 13) if b - a >= 2)


def test_after_a_jump_back_in_time_earlier_sets_are_forgotten():
    driven = DrivenSpace(RANGES)
    driven.add(pose(0), np.array([[4.0, 0.0]]), 10**9)
    driven.add(pose(4), np.zeros((0, 2)), 0)
    assert not driven.counts().any()
