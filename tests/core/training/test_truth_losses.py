# SPDX-License-Identifier: Apache-2.0
"""The terms where depth is known: zero, masks, gradients, shapes; and batches that hold truth."""

import math

import pytest
import torch
from scenes import random_batch, random_prediction
from torch import Tensor

from cvcdepth_core.errors import ImageError, RigError
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.objective import ObjectiveConfig, Prediction, evaluate_objective
from cvcdepth_core.training.truth_losses import FAR, LogErrors, sky_error

TERMS = {"truth", "truth_shape", "truth_outlines", "truth_sky"}


def depths(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 1 + 30 * torch.rand(shape, dtype=torch.float64, generator=generator)


def test_true_depth_has_no_error_and_a_wrong_scale_has_that_of_its_logarithm():
    truth = depths(2, 3, 1, 8, 12)
    exact, scaled = LogErrors.of(truth, truth), LogErrors.of(1.3 * truth, truth)
    for value in (exact.mean(), exact.of_steps(), scaled.of_steps()):
        torch.testing.assert_close(value, torch.zeros(2, 3, dtype=torch.float64))
    torch.testing.assert_close(scaled.mean(), torch.full((2, 3), math.log(1.3), dtype=torch.float64))
    assert float(scaled.deviation().max()) < 2e-3  # the root's floor


def test_what_is_not_known_has_no_part_in_any_term():
    truth, depth = depths(2, 3, 1, 8, 12), depths(2, 3, 1, 8, 12, seed=1)
    hidden = torch.zeros_like(truth, dtype=torch.bool)
    hidden[..., 2:6, 3:9] = True
    truth[hidden] = math.nan
    depth.requires_grad_()
    errors = LogErrors.of(depth, truth)
    total = errors.mean() + errors.deviation() + errors.of_steps() + sky_error(depth, depth - 10, truth)
    total.sum().backward()
    assert bool(torch.isfinite(total).all())
    assert float(depth.grad[hidden].abs().max()) == 0.0
    assert float(depth.grad[~hidden].abs().min()) > 0.0


def test_with_nothing_known_there_is_nothing_to_learn():
    truth = torch.full((2, 1, 1, 8, 12), math.nan)
    depth = depths(2, 1, 1, 8, 12).float().requires_grad_()
    errors = LogErrors.of(depth, truth)
    total = errors.mean() + errors.of_steps() + sky_error(depth, None, truth)
    assert torch.equal(total.detach(), torch.zeros(2, 1))


def test_far_away_only_what_is_too_near_is_wrong():
    truth = torch.tensor([150.0, 150.0, 150.0, math.inf, math.inf]).view(5, 1, 1, 1)
    depth = torch.tensor([120.0, 300.0, 50.0, 200.0, 25.0]).view(5, 1, 1, 1)
    torch.testing.assert_close(LogErrors.of(depth, truth).mean(), torch.tensor([0, 0, math.log(2), 0, 0]))
    torch.testing.assert_close(sky_error(depth, None, truth), torch.tensor([0, 0, 0, 0, math.log(FAR / 25)]))


def test_the_skys_logit_is_told_the_sky_from_what_is_near_and_nothing_of_what_is_far():
    truth = torch.tensor([math.inf, 10.0, 150.0, math.nan]).view(4, 1, 1, 1)
    logits = torch.zeros(4, 1, 1, 1, requires_grad=True)
    sky_error(torch.full_like(truth, 200.0), logits, truth).sum().backward()
    torch.testing.assert_close(logits.grad.flatten(), torch.tensor([-0.5, 0.5, 0.0, 0.0]))


def test_the_expected_error_is_least_surprising_where_it_is_the_error_and_leaves_depth_alone():
    truth = depths(1, 1, 8, 12)
    depth = (1.2 * truth).requires_grad_()
    errors = LogErrors.of(depth, truth)
    right, low, high = (errors.surprise(torch.full_like(truth, math.log(0.18 * f))) for f in (1.0, 0.5, 2.0))
    assert right < low
    assert right < high
    assert not right.requires_grad


def with_truth(batch: RigBatch, truth: Tensor, contexts: bool) -> RigBatch:
    return RigBatch(
        batch.frames if contexts else batch.frames[:, :1],
        batch.masks,
        batch.intrinsics,
        batch.base_T_camera,
        batch.targets if contexts else batch.targets[:0],
        batch.sources if contexts else batch.sources[:0],
        batch.camera_names,
        truth=truth,
    )


def test_a_batch_without_contexts_learns_from_truth_alone():
    torch.manual_seed(0)
    whole = random_batch(2, 3, 32, 48)
    batch = with_truth(whole, depths(2, 3, 1, 32, 48), contexts=False)
    prediction = random_prediction(whole)
    prediction = Prediction(prediction.disparity, prediction.depth, prediction.motions[:, :0])
    value = evaluate_objective(batch, prediction, ObjectiveConfig())
    assert set(value.terms) == TERMS
    expected = sum(getattr(ObjectiveConfig(), name) * term for name, term in value.terms.items())
    torch.testing.assert_close(value.per_sample, expected.mean(dim=1))


def test_with_contexts_truth_adds_to_the_other_terms_and_its_weight_of_zero_leaves_it_out():
    torch.manual_seed(0)
    whole = random_batch(2, 3, 32, 48)
    prediction = random_prediction(whole)
    noise = torch.zeros(2, 2, 3, 1, 32, 48, dtype=torch.float64)
    plain = evaluate_objective(whole, prediction, ObjectiveConfig(), noise)
    batch = with_truth(whole, depths(2, 3, 1, 32, 48), contexts=True)
    both = evaluate_objective(batch, prediction, ObjectiveConfig(), noise)
    assert set(both.terms) == set(plain.terms) | TERMS
    assert bool((both.per_sample > plain.per_sample).all())
    without = evaluate_objective(batch, prediction, ObjectiveConfig(truth=0.0), noise)
    torch.testing.assert_close(without.per_sample, plain.per_sample)


def test_sparse_truth_tells_neither_outlines_nor_sky():
    torch.manual_seed(0)
    whole = random_batch(2, 3, 32, 48)
    truth = torch.where(torch.rand(2, 3, 1, 32, 48) < 0.1, depths(2, 3, 1, 32, 48), math.nan)
    batch = with_truth(whole, truth, contexts=False)
    batch.truth_is_sparse = True
    prediction = random_prediction(whole)
    depth = prediction.depth.detach().requires_grad_()
    sky = torch.zeros_like(depth).requires_grad_()
    prediction = Prediction(prediction.disparity, depth, prediction.motions[:, :0], sky)
    value = evaluate_objective(batch, prediction, ObjectiveConfig())
    assert set(value.terms) == {"truth", "truth_shape"}
    value.loss.backward()
    assert sky.grad is None
    assert torch.equal(depth.grad != 0, torch.isfinite(truth))


def test_what_is_taken_for_the_sky_can_be_left_out_of_what_pictures_teach():
    torch.manual_seed(0)
    batch = random_batch(2, 3, 32, 48)
    noise = torch.zeros(2, 2, 3, 1, 32, 48, dtype=torch.float64)
    sky = torch.full((2, 3, 1, 32, 48), -4.0, dtype=torch.float64)
    sky[..., :12, :] = 4.0
    shares = {}
    for leave_out in (True, False):
        found = random_prediction(batch)
        disparity, depth = found.disparity.detach().requires_grad_(), found.depth.detach().requires_grad_()
        prediction = Prediction(disparity, depth, found.motions, sky)
        config = ObjectiveConfig(corrected=True, leave_out_sky=leave_out)
        evaluate_objective(batch, prediction, config, noise).loss.backward()
        sums = [(part.grad.abs()[..., rows, :].mean()) for part in (disparity, depth) for rows in (TOP, BOTTOM)]
        shares[leave_out] = float(sums[0] / sums[1]), float(sums[2] / sums[3])
    assert shares[True][0] == 0.0  # of the smoothness
    assert shares[True][1] < 0.02  # what is left comes through the brightness that pictures are aligned by
    assert min(shares[False]) > 0.3


def test_of_a_network_that_does_not_tell_the_sky_nothing_is_left_out():
    torch.manual_seed(0)
    batch = random_batch(2, 3, 32, 48)
    batch.masks[..., 20:, :] = 0.0
    noise, prediction = torch.zeros(2, 2, 3, 1, 32, 48, dtype=torch.float64), random_prediction(batch)
    values = [evaluate_objective(batch, prediction, ObjectiveConfig(leave_out_sky=out), noise) for out in (True, False)]
    assert torch.equal(values[0].per_sample, values[1].per_sample)


TOP, BOTTOM = slice(0, 10), slice(14, None)


def test_a_batch_with_nothing_to_learn_from_or_impossible_truth_is_refused_by_name():
    whole = random_batch(2, 3, 32, 48)
    truth = depths(2, 3, 1, 32, 48)
    with pytest.raises(ImageError, match="a batch without context frames needs truth"):
        RigBatch(whole.frames[:, :1], *(getattr(whole, n) for n in FIELDS), camera_names=whole.camera_names)
    with pytest.raises(ImageError, match=r"truth: shape is \[2, 3, 1, 32, 40\], expected \[2, 3, 1, 32, 48\]"):
        with_truth(whole, truth[..., :40], contexts=True)
    truth[1, 2, 0, 4, 5] = -3.0
    with pytest.raises(ImageError, match=r"sample 1, camera camera2: truth of -3\.0 m, expected above 0"):
        with_truth(whole, truth, contexts=True)
    with pytest.raises(RigError, match="no neighbour"):  # as ever, where contexts are to be learned from
        RigBatch(
            whole.frames, whole.masks, whole.intrinsics, whole.base_T_camera,
            whole.targets[:0], whole.sources[:0], whole.camera_names,
        )  # fmt: skip


FIELDS = ("masks", "intrinsics", "base_T_camera", "targets", "sources")
