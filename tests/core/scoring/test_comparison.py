# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.scoring.comparison import compare, compare_values, rank_correlation
from cvcdepth_core.scoring.metrics import METRIC_NAMES
from cvcdepth_core.scoring.scorer import DepthSamples, SurroundScorer
from cvcdepth_core.scoring.scores import ALL, Scores, ScoreSettings

CAMERAS = ("front", "left")


def predicted(
    error: float, seed: int = 0, sets: int = 60, config: ScoreSettings | None = None, start: int = 0
) -> Scores:
    """Scores of predictions that are off by a factor with this mean, and as random as the seed says."""
    truth_rng, rng = np.random.default_rng(99), np.random.default_rng(seed)
    scorer = SurroundScorer("drive", CAMERAS, config or ScoreSettings())
    for stamp in range(start, start + sets):
        images = []
        for _ in CAMERAS:
            truth = truth_rng.uniform(2, 60, 20)
            factor = 1 + error + 0.05 * rng.standard_normal(20)
            images.append(DepthSamples(truth * factor, truth, np.zeros(20, dtype=bool)))
        scorer.add(stamp, images)
    return scorer.scores()


def test_a_better_result_is_told_from_one_that_is_only_luckier():
    worse, better, lucky = predicted(0.2, 0), predicted(0.1, 1), predicted(0.2, 2)
    improved = compare(worse, better).differences["abs_rel"]
    assert improved.low < improved.difference < improved.high < 0
    same = compare(worse, lucky).differences["abs_rel"]
    assert same.low < 0 < same.high


def test_the_means_are_those_of_the_summary():
    first, second = predicted(0.2, 0), predicted(0.1, 1)
    found = compare(first, second).differences
    for name in METRIC_NAMES:
        assert found[name].first == pytest.approx(first.summary().mean[ALL].metrics[name], rel=1e-12)
        assert found[name].second == pytest.approx(second.summary().mean[ALL].metrics[name], rel=1e-12)
        assert found[name].difference == found[name].second - found[name].first


def test_a_result_does_not_differ_from_itself():
    scores = predicted(0.2)
    for difference in compare(scores, scores).differences.values():
        assert (difference.difference, difference.low, difference.high) == (0.0, 0.0, 0.0)


def test_the_same_seed_gives_the_same_interval_and_another_one_another():
    first, second = predicted(0.2, 0), predicted(0.19, 1)
    assert compare(first, second, seed=3) == compare(first, second, seed=3)
    assert compare(first, second, seed=3).differences != compare(first, second, seed=4).differences


def test_the_interval_covers_the_true_difference_about_as_often_as_it_says():
    covered = 0
    for seed in range(40):
        pair = predicted(0.2, seed, sets=20), predicted(0.18, seed + 500, sets=20)
        found = compare(*pair, level=0.8, resamples=200, block=1).differences["abs_rel"]
        covered += found.low <= -0.02 <= found.high
    assert 24 <= covered <= 38


def test_only_common_sets_are_compared_and_the_others_are_counted():
    found = compare(predicted(0.2, sets=30), predicted(0.2, sets=30, start=10))
    assert (found.sets, found.only_in_first, found.only_in_second) == (20, 10, 10)


def test_blocks_are_shortened_where_sets_are_few():
    assert compare(predicted(0.2, sets=60), predicted(0.1, sets=60)).block == 10
    few = compare(predicted(0.2, 0, sets=12), predicted(0.1, 1, sets=12))
    assert few.block == 2
    assert few.differences["abs_rel"].low < few.differences["abs_rel"].high


def test_a_few_sets_prove_nothing_even_where_all_agree():
    five, six = (compare(predicted(0.2, 0, sets=n), predicted(0.1, 1, sets=n)) for n in (5, 6))
    assert five.differences["abs_rel"].high < 0
    assert (five.can_prove, six.can_prove) == (False, True)


def test_sets_without_truth_prove_nothing():
    values = {("drive", stamp): np.array([[math.nan if stamp < 4 else 1.0], [math.nan]]) for stamp in range(9)}
    found = compare_values(values, values, ["abs_rel"])
    assert (found.sets, found.measured, found.can_prove) == (9, 5, False)


def test_blocks_widen_the_interval_where_consecutive_sets_are_alike():
    slow, none = (SurroundScorer("drive", ["front"], ScoreSettings()) for _ in range(2))
    for stamp in range(200):
        factor = 1.1 + 0.1 * math.sin(stamp / 20)
        slow.add(stamp, [DepthSamples(np.array([10 * factor]), np.array([10.0]), np.array([False]))])
        none.add(stamp, [DepthSamples(np.array([10.0]), np.array([10.0]), np.array([False]))])
    widths = []
    for block in (1, 10):
        found = compare(slow.scores(), none.scores(), block=block).differences["abs_rel"]
        widths.append(found.high - found.low)
    assert widths[1] > 2 * widths[0]


def test_blocks_do_not_widen_the_interval_of_independent_sets():
    pair = predicted(0.2, 0, sets=200), predicted(0.18, 1, sets=200)
    single, blocks = (compare(*pair, block=block).differences["abs_rel"] for block in (1, 10))
    assert blocks.high - blocks.low < 1.5 * (single.high - single.low)


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(ConfigError, match=r"max_depth=80.*max_depth=50"):
        compare(predicted(0.2), predicted(0.2, config=ScoreSettings(max_depth=50)))
    with pytest.raises(ConfigError, match="0 sets in common"):
        compare(predicted(0.2, sets=4), predicted(0.2, sets=4, start=4))
    with pytest.raises(ConfigError, match=r"cameras .* differ"):
        compare(predicted(0.2), SurroundScorer("drive", ["front"], ScoreSettings()).scores())


def test_rank_correlation():
    assert rank_correlation([1, 2, 3, 4], [10, 20, 30, 1000]) == pytest.approx(1.0)
    assert rank_correlation([1, 2, 3], [3, 2, 1]) == pytest.approx(-1.0)
    # By hand: ranks 0, 1.5, 1.5, 3 and 0, 2, 1, 3: 4.5 / sqrt(4.5 * 5).
    assert rank_correlation([1, 2, 2, 9], [0, 5, 4, 6]) == pytest.approx(4.5 / math.sqrt(22.5))
    assert rank_correlation([1, math.nan, 2, 3], [5, 0, 6, math.nan]) == pytest.approx(1.0)
    assert math.isnan(rank_correlation([1, 1, 1], [1, 2, 3]))
    assert math.isnan(rank_correlation([], []))
