# SPDX-License-Identifier: Apache-2.0
"""The gate: which of two evaluations of the same sets is better, judged on the shipped recording and simple depths."""

import math
from dataclasses import replace
from functools import cache

import pytest
from recordings import CAMERAS, SAMPLE

from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import evaluate_recording
from cvcdepth_ros.evaluation.result import EvaluationResult, Failure
from cvcdepth_ros.finetuning.judgement import camera_numbers, judge, numbers_of, score_of


@cache
def constant(depth: float, with_lidar: bool = True, start: float = 0.25) -> EvaluationResult:
    """The evaluation of so many metres everywhere, on seven sets."""
    fields = {"predictor": "constant", "constant_depth": depth, "height": 64, "width": 96}
    settings = EvaluationSettings.model_validate(fields)
    job = EvaluationJob("drive", str(SAMPLE), settings, lidar=None if with_lidar else (), start=start)
    return EvaluationResult.from_outcomes([job], [evaluate_recording(job)], settings.dependencies())


@pytest.mark.parametrize("with_lidar", [True, False])
def test_the_better_of_two_is_promoted_and_the_worse_and_the_same_are_not(with_lidar):
    near, far = constant(2.0, with_lidar), constant(10.0, with_lidar)
    verdict = judge(near, far)
    assert verdict.promoted
    assert verdict.basis == ("LiDAR" if with_lidar else "label-free")
    assert verdict.difference is not None
    assert verdict.difference.first == pytest.approx(score_of(near), rel=0.02)
    assert verdict.difference.second == pytest.approx(score_of(far), rel=0.02)
    assert not judge(far, near).promoted
    assert not judge(near, near).promoted


@pytest.mark.parametrize("with_lidar", [True, False])
def test_the_better_of_two_is_not_promoted_on_a_few_sets(with_lidar):
    verdict = judge(constant(2.0, with_lidar, start=0.45), constant(10.0, with_lidar, start=0.45))
    assert verdict.difference is not None
    assert verdict.difference.high < 0
    assert not verdict.promoted
    assert verdict.reason.startswith("not proven to be better than the start, too few held-out sets: 5, want 6, ")


def test_depth_by_which_nothing_is_seen_elsewhere_explains_nothing():
    lost = constant(0.01, with_lidar=False)
    assert score_of(lost) > 0.5 > score_of(constant(2.0, with_lidar=False))
    assert not judge(constant(10.0, with_lidar=False), lost).promoted
    assert judge(lost, constant(10.0, with_lidar=False)).promoted


def test_a_verdict_names_the_recordings_that_were_not_scored():
    near, far = constant(2.0), constant(10.0)
    lost = replace(far, failed=[Failure("other", "other.mcap", "other.mcap: no set: 3 refused")])
    assert judge(near, lost).reason.endswith(" held-out sets); not scored: other.mcap: no set: 3 refused")
    assert "not scored" not in judge(near, far).reason


def test_the_numbers_of_cameras_and_of_all_belong_together():
    numbers, cameras = numbers_of(constant(10.0)), camera_numbers(constant(10.0))
    assert cameras.keys() == set(CAMERAS)
    mean = math.fsum(found["abs_rel"] for found in cameras.values() if found["abs_rel"]) / len(cameras)
    assert numbers["abs_rel"] == numbers["score"] == pytest.approx(mean)
    assert "abs_rel" not in numbers_of(constant(10.0, with_lidar=False))
    assert camera_numbers(constant(10.0, with_lidar=False))["front"]["abs_rel"] is None
