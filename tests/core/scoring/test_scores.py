# SPDX-License-Identifier: Apache-2.0
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.scoring.metrics import METRIC_NAMES, SUMS, metrics_of, sum_errors
from cvcdepth_core.scoring.scorer import DepthSamples, SurroundScorer
from cvcdepth_core.scoring.scores import ALL, OVERLAP, Scores, ScoreSettings

CAMERAS = ("front", "left", "back")


def samples(prediction, truth, overlap=None) -> DepthSamples:
    truth = np.array(truth, dtype=float)
    overlap = np.zeros(len(truth), dtype=bool) if overlap is None else np.array(overlap)
    return DepthSamples(np.array(prediction, dtype=float), truth, overlap)


def random_set(rng: np.random.Generator, cameras: int = 3) -> list[DepthSamples]:
    images = []
    for _ in range(cameras):
        truth = rng.uniform(0.2, 100, rng.integers(0, 40))
        prediction = truth * rng.lognormal(0, 0.4, len(truth))
        prediction[rng.random(len(truth)) < 0.1] = np.nan
        images.append(DepthSamples(prediction, truth, rng.random(len(truth)) < 0.3))
    return images


def scored(recording: str, sets: int, seed: int, config: ScoreSettings | None = None) -> Scores:
    scorer = SurroundScorer(recording, CAMERAS, config or ScoreSettings())
    rng = np.random.default_rng(seed)
    for index in range(sets):
        scorer.add(index * 100, random_set(rng))
    return scorer.scores()


def test_metrics_equal_those_worked_out_by_hand():
    # Truth 2, 4, 10; predicted 3, 4, 5: errors 1, 0, -5; ratios 1.5, 1, 2.
    sums = np.array(sum_errors(np.array([3.0, 4.0, 5.0]), np.array([2.0, 4.0, 10.0])), dtype=SUMS)
    metrics = dict(zip(METRIC_NAMES, metrics_of(sums).tolist(), strict=True))
    assert metrics["abs_rel"] == pytest.approx((0.5 + 0 + 0.5) / 3)
    assert metrics["sq_rel"] == pytest.approx((0.5 + 0 + 2.5) / 3)
    assert metrics["rmse"] == pytest.approx(math.sqrt(26 / 3))
    assert metrics["rmse_log"] == pytest.approx(math.sqrt((math.log(1.5) ** 2 + math.log(2) ** 2) / 3))
    assert [metrics[f"delta_{i}"] for i in (1, 2, 3)] == pytest.approx([1 / 3, 2 / 3, 2 / 3])


def test_a_perfect_prediction_has_no_error_in_any_group():
    scorer = SurroundScorer("drive", ["front"], ScoreSettings(max_depth=200))
    truth = [1.0, 15, 30, 60, 150]
    scorer.add(0, [samples(truth, truth, [True] * 5)])
    for scaling in ("metric", "median"):
        for score in scorer.scores().summary("image", scaling).mean.values():
            assert score.metrics == dict(zip(METRIC_NAMES, [0, 0, 0, 0, 1, 1, 1], strict=True))
            assert score.coverage == 1.0


def reference_metrics(pairs: list[tuple[float, float]]) -> list[float]:
    """The metrics in plain Python, from their definitions."""
    n = len(pairs)
    deltas = [max(p / t, t / p) for p, t in pairs]
    return [
        sum(abs(p - t) / t for p, t in pairs) / n,
        sum((p - t) ** 2 / t for p, t in pairs) / n,
        (sum((p - t) ** 2 for p, t in pairs) / n) ** 0.5,
        (sum((math.log(p) - math.log(t)) ** 2 for p, t in pairs) / n) ** 0.5,
        *(sum(delta < 1.25**power for delta in deltas) / n for power in (1, 2, 3)),
    ]


def reference_summary(sets, config: ScoreSettings, median: bool, low: float, high: float) -> list[float]:
    """Abs Rel and the others of the truth in [low, high): per image, mean over images, then over cameras."""
    cameras = []
    for camera in range(3):
        rows = []
        for images in sets:
            image = images[camera]
            pairs = [
                (min(max(p, config.min_depth), config.max_depth), t)
                for p, t in zip(image.prediction.tolist(), image.truth.tolist(), strict=True)
                if config.min_depth < t < config.max_depth and not math.isnan(p)
            ]
            if median and pairs:
                middle = (len(pairs) - 1) // 2
                scale = sorted(t for _, t in pairs)[middle] / sorted(p for p, _ in pairs)[middle]
                pairs = [(min(max(p * scale, config.min_depth), config.max_depth), t) for p, t in pairs]
            pairs = [(p, t) for p, t in pairs if low <= t < high]
            if pairs:
                rows.append(reference_metrics(pairs))
        if rows:
            cameras.append([sum(column) / len(rows) for column in zip(*rows, strict=True)])
    return [sum(column) / len(cameras) for column in zip(*cameras, strict=True)]


@pytest.mark.parametrize("median", [False, True])
def test_all_numbers_equal_an_independent_implementation_on_random_depths(median):
    config = ScoreSettings(min_depth=0.5, max_depth=90)
    rng = np.random.default_rng(3)
    sets = [random_set(rng) for _ in range(5)]
    scorer = SurroundScorer("drive", CAMERAS, config)
    for index, images in enumerate(sets):
        scorer.add(index, images)
    summary = scorer.scores().summary("image", "median" if median else "metric")
    bins = {ALL: (0, math.inf), "0-10": (0, 10), "10-20": (10, 20), "20-40": (20, 40), "40-80": (40, 80)}
    for group, (low, high) in (bins | {"80+": (80, math.inf)}).items():
        expected = reference_summary(sets, config, median, low, high)
        assert list(summary.mean[group].metrics.values()) == pytest.approx(expected, rel=1e-12), group


def test_the_overlap_group_holds_only_the_marked_pixels():
    scorer = SurroundScorer("drive", ["front"], ScoreSettings())
    scorer.add(0, [samples([11.0, 30.0, 5.0], [10.0, 10.0, 5.0], [True, False, False])])
    mean = scorer.scores().summary().mean
    assert mean[OVERLAP].metrics["abs_rel"] == pytest.approx(0.1)
    assert mean[OVERLAP].truth == 1


def test_coverage_counts_missing_predictions_and_errors_do_not():
    scorer = SurroundScorer("drive", ["front"], ScoreSettings())
    scorer.add(0, [samples([2.0, math.nan, 0.0, -1.0], [1.0, 2.0, 3.0, 4.0])])
    score = scorer.scores().summary().mean[ALL]
    assert (score.coverage, score.metrics["abs_rel"]) == (0.25, 1.0)


def test_an_image_without_any_prediction_leaves_coverage_and_no_error():
    scorer = SurroundScorer("drive", ["front"], ScoreSettings())
    scorer.add(0, [samples([math.nan], [1.0])])
    score = scorer.scores().summary("image", "median").mean[ALL]
    assert score.coverage == 0.0
    assert math.isnan(score.metrics["abs_rel"])
    assert json.loads(json.dumps(score.to_json(), allow_nan=False))["abs_rel"] is None


def test_the_scale_ratio_is_the_geometric_mean_over_the_images_with_a_prediction():
    scorer = SurroundScorer("drive", ["front", "back"], ScoreSettings())
    nothing = samples([math.nan], [1.0])
    scorer.add(0, [samples([5.0], [10.0]), nothing])
    scorer.add(1, [samples([20.0], [10.0]), samples([5.0, 5.0, 5.0], [1.0, 6.0, 9.0])])
    scorer.add(2, [nothing, nothing])
    assert scorer.scores().scale_ratios() == pytest.approx({"front": 1.0, "back": 1.2})


def test_depth_limits_leave_truth_out_and_clamp_predictions():
    scorer = SurroundScorer("drive", ["front"], ScoreSettings(min_depth=1, max_depth=50))
    scorer.add(0, [samples([0.1, 500.0, 3.0, 3.0, 3.0], [2.0, 25.0, 1.0, 50.0, 0.5])])
    score = scorer.scores().summary().mean[ALL]
    assert score.truth == 2
    assert score.metrics["abs_rel"] == pytest.approx((0.5 + 1.0) / 2)


def test_a_pool_joins_the_pixels_of_consecutive_images_and_an_incomplete_one_is_left_out():
    scorer = SurroundScorer("drive", ["front"], ScoreSettings(pool=2))
    for stamp, (p, t) in enumerate([([2.0], [1.0]), ([1.0] * 3, [1.0] * 3), ([9.0], [1.0])]):
        scorer.add(stamp, [samples(p, t)])
    scores = scorer.scores()
    assert scores.summary("pool").mean[ALL].metrics["abs_rel"] == pytest.approx(1 / 4)
    assert scores.summary("image").mean[ALL].metrics["abs_rel"] == pytest.approx((1 + 0 + 8) / 3)


def test_a_camera_without_truth_does_not_enter_the_mean():
    scorer = SurroundScorer("drive", ["front", "left"], ScoreSettings())
    scorer.add(0, [samples([2.0], [1.0]), samples([], [])])
    summary = scorer.scores().summary()
    assert summary.mean[ALL].metrics["abs_rel"] == 1.0
    assert math.isnan(summary.cameras["left"][ALL].metrics["abs_rel"])


@settings(deadline=None, max_examples=25)
@given(st.data())
def test_the_summary_depends_neither_on_the_parts_nor_on_their_order(data):
    recordings = [scored(f"drive{i}", sets=5, seed=i) for i in range(5)]
    whole = Scores.merged(recordings)
    shuffled = data.draw(st.permutations(recordings))
    cuts = sorted(data.draw(st.lists(st.integers(1, 4), max_size=3, unique=True)))
    workers = [Scores.merged(shuffled[a:b]) for a, b in zip([0, *cuts], [*cuts, 5], strict=True)]
    through_json = [Scores.from_json(json.loads(json.dumps(part.to_json(), allow_nan=False))) for part in workers]
    merged = Scores.merged(through_json)
    assert merged.to_json() == whole.to_json()
    for protocol in ("image", "pool"):
        for scaling in ("metric", "median"):
            expected = json.dumps(whole.summary(protocol, scaling).to_json())
            assert json.dumps(merged.summary(protocol, scaling).to_json()) == expected


def test_merging_weighs_every_image_the_same_whatever_recording_it_is_from():
    long, short = (SurroundScorer(name, ["front"], ScoreSettings()) for name in ("long", "short"))
    for stamp in range(3):
        long.add(stamp, [samples([2.0], [1.0])])
    short.add(0, [samples([1.0], [1.0])])
    assert Scores.merged([short.scores(), long.scores()]).summary().mean[ALL].metrics["abs_rel"] == 0.75


def test_merging_refuses_nothing_twice_the_same_and_different_settings():
    part = scored("drive", 2, 0)
    with pytest.raises(ConfigError, match="nothing to merge"):
        Scores.merged([])
    with pytest.raises(ConfigError, match="drive was measured twice"):
        Scores.merged([part, part])
    with pytest.raises(ConfigError, match="cannot be merged"):
        Scores.merged([part, scored("other", 2, 0, ScoreSettings(max_depth=200))])


@pytest.mark.parametrize(
    "change", [{"columns": "eJw="}, {"columns": "?"}, {"sets": 3}, {"groups": "x"}, {"cameras": 1}]
)
def test_foreign_json_is_refused(change):
    content = scored("drive", 2, 0).to_json()
    content["images"][0] |= change
    with pytest.raises(ConfigError, match="not what this version writes"):
        Scores.from_json(content)
    with pytest.raises(ConfigError, match="not what this version writes"):
        Scores.from_json({"settings": {}, "images": [{"recording": "x"}], "pools": []})


def test_an_image_takes_a_kilobyte_and_not_more():
    (images,), (pools,) = (part := scored("drive", 8, 0)).images, part.pools
    used = sum(column.nbytes for table in (images, pools) for column in (table.stamps_ns, table.scales, table.sums))
    assert used / (8 * len(CAMERAS)) < 1000


def test_a_set_with_too_few_cameras_is_refused():
    with pytest.raises(ConfigError, match="2 cameras, expected 3"):
        SurroundScorer("drive", CAMERAS, ScoreSettings()).add(0, [samples([], [])] * 2)


@pytest.mark.parametrize("wrong", [{"min_depth": 5, "max_depth": 5}, {"range_edges": (0, 20, 10)}, {"pool": 0}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ScoreSettings(**wrong)
