# SPDX-License-Identifier: Apache-2.0
"""Scores of confidence: against an oracle, against chance, and what it says against what is."""

import math

import numpy as np
import pytest

from cvcdepth_core.scoring.confidence import CalibrationTable, ConfidenceSamples, confidence_samples, sparsification
from cvcdepth_core.scoring.sparse_depth import SparseDepth

RANDOM = np.random.default_rng(2)
TRUTH = RANDOM.uniform(2.0, 50.0, 4000)
PREDICTION = TRUTH * np.exp(RANDOM.normal(0.0, 0.2, TRUTH.size))
ERROR = np.abs(PREDICTION - TRUTH) / TRUTH


def samples(confidence: np.ndarray) -> ConfidenceSamples:
    return ConfidenceSamples(PREDICTION, confidence, TRUTH)


def test_confidence_that_knows_the_errors_is_the_oracle():
    found = sparsification(samples(np.exp(-ERROR)))
    assert found.ause == pytest.approx(0.0, abs=1e-9)
    assert found.aurg > 0.4
    assert found.abs_rel == pytest.approx(ERROR.mean())
    assert found.surest_half == pytest.approx(np.sort(ERROR)[: ERROR.size // 2].mean())


def test_confidence_that_says_nothing_wins_nothing():
    for confidence in (RANDOM.uniform(size=TRUTH.size), np.full(TRUTH.size, 0.7)):
        found = sparsification(samples(confidence))
        assert found.aurg == pytest.approx(0.0, abs=0.05)
        assert found.surest_half == pytest.approx(ERROR.mean(), rel=0.05)
    assert found.aurg == pytest.approx(0.0, abs=1e-9)  # equal confidence: in whatever order the pixels come


def test_confidence_that_is_upside_down_is_worse_than_chance():
    assert sparsification(samples(ERROR)).aurg < -0.3


def test_ause_and_aurg_add_up_to_what_the_oracle_wins():
    ranked, oracle = (sparsification(samples(c)) for c in (np.exp(-ERROR - RANDOM.normal(0, 0.3, ERROR.size)), -ERROR))
    assert ranked.ause + ranked.aurg == pytest.approx(oracle.aurg)


def test_a_hand_made_curve():
    found = sparsification(ConfidenceSamples(np.array([1.0, 1.5]), np.array([0.9, 0.1]), np.array([1.0, 1.0])))
    # 0.25 is left of both pixels, 0 of the surer one: it stays alone from the 26th percent on (round half to even).
    assert found.abs_rel == pytest.approx(0.25)
    assert found.surest_half == 0.0
    assert found.ause == 0.0


def test_perfect_depth_has_nothing_to_rank_and_no_pixel_has_no_score():
    perfect = sparsification(ConfidenceSamples(TRUTH, RANDOM.uniform(size=TRUTH.size), TRUTH))
    assert (perfect.abs_rel, perfect.ause) == (0.0, 0.0)
    assert all(math.isnan(value) for value in sparsification(ConfidenceSamples(*(np.empty(0),) * 3)))


def test_a_table_compares_what_confidence_says_with_what_is():
    confidence = RANDOM.choice([0.25, 0.75], TRUTH.size)
    right = RANDOM.uniform(size=TRUTH.size) < confidence
    prediction = TRUTH * np.where(right, 1.1, 1.6)
    table = CalibrationTable.from_samples(ConfidenceSamples(prediction, confidence, TRUTH))
    assert table.pixels.sum() == TRUTH.size
    np.testing.assert_allclose(table.predicted[[2, 7]], [0.25, 0.75])
    np.testing.assert_allclose(table.actual[[2, 7]], [0.25, 0.75], atol=0.04)
    np.testing.assert_allclose(table.median_log_error[[2, 7]], [math.log(1.6), math.log(1.1)], atol=0.005)
    assert np.isnan(table.actual[[0, 5, 9]]).all()
    assert table.expected_error < 0.04
    overconfident = CalibrationTable.from_samples(ConfidenceSamples(prediction, np.ones(TRUTH.size), TRUTH))
    assert overconfident.expected_error == pytest.approx(0.5, abs=0.03)


def test_tables_of_images_add_up_to_that_of_all_pixels():
    whole = samples(RANDOM.uniform(size=TRUTH.size))
    parts = [ConfidenceSamples(*(values[part] for values in whole)) for part in (slice(0, 900), slice(900, None))]
    added = CalibrationTable.empty()
    for part in parts:
        added = added + CalibrationTable.from_samples(part)
    one = CalibrationTable.from_samples(whole)
    np.testing.assert_array_equal(added.errors, one.errors)
    np.testing.assert_array_equal(added.right, one.right)
    np.testing.assert_allclose(added.confidence, one.confidence)


def test_an_empty_table_expects_nothing():
    assert math.isnan(CalibrationTable.empty().expected_error)


def test_samples_are_taken_where_depth_is_known_and_truth_is_in_range():
    truth = SparseDepth(np.array([0, 1, 2, 3]), np.array([0, 1, 2, 3]), np.array([5.0, 90.0, 7.0, 8.0]), 4, 4)
    depth, confidence = np.full((4, 4), 6.0), np.linspace(0, 1, 16).reshape(4, 4)
    depth[2, 2], depth[3, 3] = np.nan, 0.1
    found = confidence_samples(depth, confidence, truth, min_depth=0.5)
    np.testing.assert_allclose(found.prediction, [6.0, 0.5])
    np.testing.assert_allclose(found.confidence, [0.0, 1.0])
    np.testing.assert_allclose(found.truth, [5.0, 8.0])
