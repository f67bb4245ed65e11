# SPDX-License-Identifier: Apache-2.0
"""The loss terms by themselves: zero, masks, gradients, shapes."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from cvcdepth_core.rendering.photometric import TargetStatistics, masked_mean, photometric_error, ssim_distance
from cvcdepth_core.rendering.projection import axis_angle_to_rotation, rigid
from cvcdepth_core.training.losses import pose_consistency, smoothness

SEEDS = st.integers(0, 2**31)


def images(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def photometric_error_by_autograd(p: Tensor, t: Tensor) -> Tensor:
    """The formulas of method section 6 as they stand, left to autograd."""

    def mean(x: Tensor) -> Tensor:
        return F.avg_pool2d(F.pad(x, (1, 1, 1, 1), mode="reflect"), 3, stride=1)

    covariance = mean(p * t) - mean(p) * mean(t)
    variances = mean(p * p) - mean(p) ** 2 + mean(t * t) - mean(t) ** 2
    ssim = (2 * mean(p) * mean(t) + 1e-4) * (2 * covariance + 9e-4)
    ssim = ssim / ((mean(p) ** 2 + mean(t) ** 2 + 1e-4) * (variances + 9e-4) + 1e-8)
    distance = ((1 - ssim) / 2).clamp(0, 1)
    return 0.85 * distance.mean(1, keepdim=True) + 0.15 * (t - p).abs().mean(1, keepdim=True)


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, height=st.integers(2, 9), width=st.integers(2, 9))
def test_photometric_error_and_both_gradients_equal_the_formulas_left_to_autograd(seed, height, width):
    p = images(2, 3, height, width, seed=seed).requires_grad_()
    t = images(2, 3, height, width, seed=seed + 1).requires_grad_()
    weights = images(2, 1, height, width, seed=seed + 2)
    ours, theirs = photometric_error(p, t), photometric_error_by_autograd(p, t)
    torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)
    expected = torch.autograd.grad((theirs * weights).sum(), (p, t))
    torch.testing.assert_close(torch.autograd.grad((ours * weights).sum(), (p, t)), expected, rtol=1e-8, atol=1e-9)


def test_one_target_serves_several_predictions_and_collects_their_gradients():
    p, t = images(2, 4, 3, 3, 8, 9).requires_grad_(), images(2, 1, 3, 3, 8, 9, seed=1).requires_grad_()
    expanded = t.expand_as(p).detach().requires_grad_()
    shared, separate = photometric_error(p, t), photometric_error(p, expanded)
    torch.testing.assert_close(shared, separate)
    shared.square().sum().backward()
    separate.square().sum().backward()
    torch.testing.assert_close(t.grad, expanded.grad.sum(dim=1, keepdim=True))


@pytest.mark.parametrize("planes", [1, 2, 3, 6])
def test_views_that_do_not_fit_one_chunk_are_all_computed(monkeypatch, planes):
    p, t = images(2, 7, 3, 8, 9).requires_grad_(), images(1, 7, 3, 8, 9, seed=1).requires_grad_()
    whole = photometric_error(p, t)
    gradients = torch.autograd.grad(whole.square().sum(), (p, t))
    monkeypatch.setattr("cvcdepth_core.rendering.photometric._CHUNK_ELEMENTS", planes * 8 * 9)
    chunked = photometric_error(p, t)
    torch.testing.assert_close(chunked, whole)
    torch.testing.assert_close(torch.autograd.grad(chunked.square().sum(), (p, t)), gradients)


def test_statistics_of_targets_serve_several_calls():
    p, t = images(2, 4, 3, 8, 9), images(1, 4, 3, 8, 9, seed=1)
    measured = TargetStatistics.from_images(t)
    assert torch.equal(photometric_error(p, t, measured), photometric_error(p, t))


def test_equal_images_have_no_photometric_error_and_no_gradient():
    image = images(1, 3, 8, 9).requires_grad_()
    error = photometric_error(image, image.detach())
    assert float(error.detach().max()) < 1e-6
    error.sum().backward()
    assert float(image.grad.abs().max()) < 1e-5  # not quite zero: SSIM has 1e-8 in its denominator only


def test_a_constant_image_gives_zero_gradients_not_nan():
    image = torch.full((1, 3, 8, 9), 0.5, dtype=torch.float64, requires_grad=True)
    disparity = torch.full((1, 1, 8, 9), 0.5, dtype=torch.float64, requires_grad=True)
    (photometric_error(image, image.detach()).sum() + smoothness(disparity, image.detach()).sum()).backward()
    assert float(image.grad.abs().nan_to_num(1).max()) < 1e-4  # not quite zero: SSIM has 1e-8 in its denominator only
    assert not disparity.grad.nan_to_num(1).any()


@given(seed=SEEDS)
def test_ssim_distance_is_symmetric_and_within_zero_and_one(seed):
    x, y = images(1, 3, 6, 7, seed=seed), images(1, 3, 6, 7, seed=seed + 1)
    distance = ssim_distance(x, y)
    torch.testing.assert_close(distance, ssim_distance(y, x))
    assert 0 <= float(distance.min()) <= float(distance.max()) <= 1


def test_masked_mean_counts_only_what_the_mask_lets_through():
    error = torch.tensor([[[[1.0, 2.0], [3.0, float(100)]]]], dtype=torch.float64)
    mask = torch.tensor([[[[1.0, 1.0], [0.5, 0.0]]]], dtype=torch.float64)
    assert float(masked_mean(error, mask)) == pytest.approx(4.5 / 2.5)


def test_masked_mean_of_an_empty_mask_is_zero_with_zero_gradient():
    error = images(2, 1, 4, 5).requires_grad_()
    value = masked_mean(error, torch.zeros(2, 1, 4, 5, dtype=torch.float64))
    assert not value.any()
    value.sum().backward()
    assert not error.grad.any()


@given(scale=st.floats(0.01, 100))
def test_smoothness_does_not_depend_on_the_scale_of_the_disparity(scale):
    disparity, image = 0.1 + images(1, 1, 6, 7), images(1, 3, 6, 7, seed=1)
    torch.testing.assert_close(smoothness(scale * disparity, image), smoothness(disparity, image), rtol=1e-5, atol=0)


def test_smoothness_forgives_a_step_where_the_image_has_an_edge():
    step = torch.ones(1, 1, 6, 8, dtype=torch.float64)
    step[..., 4:] = 2
    edge = torch.zeros(1, 3, 6, 8, dtype=torch.float64)
    edge[..., 4:] = 1
    assert float(smoothness(step, edge)) < float(smoothness(step, torch.zeros_like(edge)))


def test_what_shows_nothing_has_no_part_in_the_smoothness():
    disparity, image = (0.1 + images(1, 1, 6, 7)).requires_grad_(), images(1, 3, 6, 7, seed=1)
    shown = torch.ones(1, 1, 6, 7, dtype=torch.float64)
    shown[..., :, 5:] = 0
    value = smoothness(disparity, image, shown)
    torch.testing.assert_close(value, smoothness(disparity[..., :5], image[..., :5]))
    (gradient,) = torch.autograd.grad(value.sum(), disparity)
    assert (gradient[..., 5:] == 0).all()
    torch.testing.assert_close(smoothness(disparity, image, torch.ones_like(shown)), smoothness(disparity, image))
    assert float(smoothness(disparity, image, torch.zeros_like(shown)).detach()) == 0


def test_losses_keep_every_leading_dimension():
    p, t = images(2, 3, 4, 3, 6, 7), images(2, 1, 4, 3, 6, 7)
    assert photometric_error(p, t).shape == (2, 3, 4, 1, 6, 7)
    assert masked_mean(photometric_error(p, t), torch.ones(2, 1, 4, 1, 6, 7)).shape == (2, 3, 4)
    assert smoothness(p[:, :, :, :1], p).shape == (2, 3, 4)
    assert smoothness(p[:, :, :, :1], p, torch.ones(2, 1, 4, 1, 6, 7)).shape == (2, 3, 4)


def test_pose_consistency_measures_metres_and_ten_times_radians():
    motions = torch.eye(4, dtype=torch.float64).repeat(1, 2, 3, 1, 1)
    motions[:, :, 1, 0, 3] = 0.3
    turn = torch.tensor([0.0, 0.02, 0.0], dtype=torch.float64)
    motions[:, :, 2] = rigid(axis_angle_to_rotation(turn), torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(pose_consistency(motions, anchor=0), torch.tensor([[0.0, 0.3, 0.2]]).double())


def test_pose_consistency_of_equal_motions_has_zero_gradients_not_nan():
    motions = torch.eye(4, dtype=torch.float64).repeat(1, 2, 3, 1, 1).requires_grad_()
    pose_consistency(motions, anchor=0).sum().backward()
    assert not motions.grad.nan_to_num(1).any()
