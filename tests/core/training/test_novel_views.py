# SPDX-License-Identifier: Apache-2.0
"""Depth at turned cameras as a loss: zero where it agrees, its share where it does not, and never NaN."""

import math

import pytest
import torch
from scenes import random_batch, slanted_plane

from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.novel_views import (
    NovelViews,
    NovelViewsConfig,
    consistency_of_views,
    draw_turns,
    novel_poses,
    smoothness_of_views,
    turns_of,
    warped_depth,
)

RANGE, FOCAL_SCALE = (0.5, 80.0), 60.0


def novel_of(batch: RigBatch, depth: torch.Tensor, turns: torch.Tensor | None = None) -> NovelViews:
    turns = torch.zeros(*depth.shape[:2], 3).to(depth) if turns is None else turns
    return NovelViews(depth / 100, depth, novel_poses(batch.base_T_camera, turns), RANGE, FOCAL_SCALE)


@pytest.mark.parametrize("corrected", [False, True])
@pytest.mark.parametrize(("scale", "tolerance"), [(1.0, 1e-3), (1.2, 1e-2)])
def test_without_a_turn_the_depth_of_a_plane_differs_by_as_much_as_it_is_wrong(scale, tolerance, corrected):
    scene = slanted_plane()
    found = consistency_of_views(scene.batch, scene.depth, novel_of(scene.batch, scene.depth * scale), corrected)
    torch.testing.assert_close(found, torch.full_like(found, (scale - 1) / (scale + 1)), atol=tolerance, rtol=0)


def test_a_camera_agrees_with_itself_exactly():
    scene = slanted_plane()
    warp, (targets, sources) = warped_depth(scene.batch, scene.depth, novel_of(scene.batch, scene.depth), False)
    own = targets == sources
    seen = warp.masks[:, own] > 0
    torch.testing.assert_close(warp.images[:, own][seen], scene.depth[seen], atol=1e-5, rtol=1e-5)
    assert float(seen.double().mean()) > 0.95


def test_samples_and_cameras_are_reduced_on_their_own_and_gradients_are_finite():
    torch.manual_seed(3)
    batch = random_batch(2, 4, 32, 48)
    depth = (2 + 10 * torch.rand(2, 4, 1, 32, 48, dtype=torch.float64)).requires_grad_()
    other = (2 + 10 * torch.rand_like(depth)).requires_grad_()
    turns = draw_turns(NovelViewsConfig(), 4, [torch.Generator().manual_seed(i) for i in (1, 2)]).double()
    novel = novel_of(batch, other, turns)
    both = consistency_of_views(batch, depth, novel, False)
    assert both.shape == (2, 4)
    alone = novel_of(batch.first_sample(), other[:1], turns[:1])
    torch.testing.assert_close(consistency_of_views(batch.first_sample(), depth[:1], alone, False), both[:1])
    (both.sum() + smoothness_of_views(novel.disparity).sum()).backward()
    for gradient in (depth.grad, other.grad):
        assert gradient.isfinite().all()
        assert gradient.any()


def test_cameras_turned_away_from_everything_cost_nothing():
    scene = slanted_plane()
    turns = torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64).expand(1, 2, 3)
    novel = novel_of(scene.batch, scene.depth.clone().requires_grad_(), turns)
    found = consistency_of_views(scene.batch, scene.depth, novel, corrected=True)
    assert found.tolist() == [[0.0, 0.0]]


def test_turns_are_degrees_about_the_vehicles_axes_or_radians_as_published():
    drawn = torch.tensor([[0.0, 0.5, 1.0]])
    expected = torch.tensor([[-7.5, 0.0, 20.0]])
    torch.testing.assert_close(turns_of(NovelViewsConfig(radians=True), drawn), expected)
    torch.testing.assert_close(turns_of(NovelViewsConfig(), drawn), expected * math.pi / 180)
    generators = [torch.Generator().manual_seed(1) for _ in range(2)]
    one, other = draw_turns(NovelViewsConfig(), 200, generators)
    assert torch.equal(one, other)  # of generators that are alike
    limits = torch.tensor([7.5, 7.5, 20.0]) * math.pi / 180
    assert (one.abs() <= limits).all()
    assert (one.abs().amax(0) > 0.9 * limits).all()


def test_smoothness_is_that_of_disparity_relative_to_its_mean():
    ramp = torch.linspace(1, 2, 11).expand(2, 3, 1, 5, 11)
    torch.testing.assert_close(smoothness_of_views(ramp), torch.full((2, 3), 0.1 / 1.5))
    torch.testing.assert_close(smoothness_of_views(7 * ramp), smoothness_of_views(ramp))
