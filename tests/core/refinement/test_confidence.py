# SPDX-License-Identifier: Apache-2.0
"""Confidence maps: monotone, fitted to what was right, and refused where they mean nothing."""

import numpy as np
import pytest
import torch

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.refinement.confidence import (
    PRIOR_CONFIDENCE,
    REFINED_CONFIDENCE,
    ConfidenceMap,
    checked_share,
    fit_confidence_map,
    raw_confidence,
    trusted_share,
)


def test_a_map_is_linear_between_its_knots_and_constant_beyond():
    found = ConfidenceMap((0.2, 0.6), (0.1, 0.9))(torch.tensor([[0.0, 0.2, 0.4], [0.6, 1.0, torch.nan]]))
    torch.testing.assert_close(found, torch.tensor([[0.1, 0.1, 0.5], [0.9, 0.9, torch.nan]]), equal_nan=True)
    assert found.dtype == torch.float32


@pytest.mark.parametrize(
    ("raw", "probability"), [((0.5, 0.5), (0.1, 0.2)), ((0.1, 0.5), (0.4, 0.2)), ((), ()), ((0.1,), ())]
)
def test_what_is_no_monotone_function_is_refused(raw: tuple, probability: tuple):
    with pytest.raises(ConfigError, match="no monotone function"):
        ConfidenceMap(raw, probability)


def test_a_fitted_map_says_how_often_depth_was_right():
    random = np.random.default_rng(4)
    raw = random.uniform(0.5, 1.0, 60_000)
    truth = np.clip(2 * raw - 1, 0.1, 0.95)
    found = fit_confidence_map(raw, random.uniform(size=raw.size) < truth)
    tried = np.linspace(0.55, 0.97, 9)
    np.testing.assert_allclose(found(torch.from_numpy(tried)).numpy(), np.clip(2 * tried - 1, 0.1, 0.95), atol=0.03)


def test_shares_that_descend_are_pooled():
    raw = np.repeat([0.1, 0.2, 0.3, 0.4], 100)
    right = np.concatenate([np.arange(100) < share for share in (20, 60, 40, 90)])
    found = fit_confidence_map(raw, right, knots=4)
    assert found.raw == pytest.approx((0.1, 0.25, 0.4))
    assert found.probability == pytest.approx((0.2, 0.5, 0.9))


def test_raw_confidence_that_is_everywhere_the_same_gives_one_knot():
    found = fit_confidence_map(np.full(1000, 0.7), np.arange(1000) < 640)
    assert found.probability == (0.64,)


def test_too_few_pixels_are_refused_with_their_number():
    with pytest.raises(ConfigError, match="5 pixels, at least 12 are needed"):
        fit_confidence_map(np.ones(5), np.ones(5, bool))


@pytest.mark.parametrize("shipped", [REFINED_CONFIDENCE, PRIOR_CONFIDENCE])
def test_the_shipped_maps_use_much_of_the_range(shipped: ConfidenceMap):
    assert min(shipped.probability) < 0.4
    assert max(shipped.probability) > 0.95


def test_what_is_coarse_or_far_from_the_prior_is_less_sure():
    peak, zero, one = torch.tensor(0.9), torch.tensor(0.0), torch.tensor(1.0)
    assert raw_confidence(peak, zero, one) == pytest.approx(0.9)
    assert raw_confidence(peak, torch.tensor(-0.5), one) < 0.9
    assert 0 < raw_confidence(peak, zero, zero) < 0.9


def test_a_correction_that_is_likely_wrong_is_made_in_part_only():
    share = trusted_share(torch.tensor([0.5, 0.8, 0.9, 1.0]))
    assert 0 <= share[0] < share[1] < 1
    torch.testing.assert_close(share[2:], torch.ones(2))


def test_without_contrast_nothing_is_checked():
    torch.testing.assert_close(checked_share(torch.tensor([0.0, 0.025, 0.05, 1.0])), torch.tensor([0.0, 0.5, 1.0, 1.0]))
