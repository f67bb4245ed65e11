# SPDX-License-Identifier: Apache-2.0
"""The verdict on a checkpoint: whether it is proven to be better than the one that it was trained from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.files import nan_to_null
from cvcdepth_core.scoring.comparison import SETS_TO_PROVE, Comparison, Difference, SetValues, compare, compare_values
from cvcdepth_core.scoring.scores import ALL, mean
from cvcdepth_ros.evaluation.image_scores import ImageScore
from cvcdepth_ros.evaluation.result import EvaluationResult

Basis = Literal["LiDAR", "label-free"]

LABEL_FREE_SCORE = "photometric"
"""Mean of the two photometric errors of an image, to its neighbours and to the picture before. Unlike disagreement it
cannot be made good by depth that is consistent and wrong: it has to explain the pictures. Depth by which nothing of an
image is seen elsewhere does not explain it: that counts as the greatest error, 1."""

LIDAR_SCORE = "abs_rel"
_UNEXPLAINED = 1.0
_SHOWN_METRICS = ("abs_rel", "rmse", "delta_1")


@dataclass(frozen=True)
class Verdict:
    """Whether weights are promoted, and why."""

    promoted: bool
    reason: str
    """The comparison in words, with the numbers."""
    basis: Basis | None = None
    """The measure that decided; None where nothing could be compared."""
    score: str | None = None
    """The name of the number; lower is better."""
    difference: Difference | None = None
    comparison: Comparison | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the verdict with JSON's types."""
        comparison = None
        if self.comparison is not None:
            comparison = {name: value for name, value in asdict(self.comparison).items() if name != "differences"}
            differences = {name: nan_to_null(asdict(one)) for name, one in self.comparison.differences.items()}
            comparison["differences"] = differences
        return {
            "promoted": self.promoted,
            "reason": self.reason,
            "basis": self.basis,
            "score": self.score,
            "difference": None if self.difference is None else nan_to_null(asdict(self.difference)),
            "comparison": comparison,
        }


def judge(before: EvaluationResult, after: EvaluationResult) -> Verdict:
    """Return the verdict on two evaluations of the same sets: by LiDAR where both have truth, else without labels."""
    basis: Basis = "LiDAR" if before.truth_points and after.truth_points else "label-free"
    score = LIDAR_SCORE if basis == "LiDAR" else LABEL_FREE_SCORE
    try:
        comparison = compare(before.scores, after.scores) if basis == "LiDAR" else _compare_label_free(before, after)
    except ConfigError as error:
        return Verdict(False, f"nothing was proven: {error}{_not_scored(before, after)}")
    difference = comparison.differences[score]
    promoted = comparison.can_prove and difference.high < 0  # False for NaN
    interval = f"{comparison.level:.0%} interval {difference.low:+.4f} to {difference.high:+.4f}"
    numbers = (
        f"{_name(score)} {difference.first:.4f} before, {difference.second:.4f} after, difference "
        f"{difference.difference:+.4f} ({interval}, {comparison.sets} held-out sets)"
    )
    words = "better than the start" if promoted else "not proven to be better than the start"
    if not comparison.can_prove:
        words = f"{words}, too few held-out sets: {comparison.measured}, want {SETS_TO_PROVE}"
    by = "by the LiDAR" if basis == "LiDAR" else "without LiDAR, by how well the depth explains the pictures"
    reason = f"{words}, {by}: {numbers}{_not_scored(before, after)}"
    return Verdict(promoted, reason, basis, score, difference, comparison)


def score_of(result: EvaluationResult) -> float:
    """Return the number that validations are ranked by, lower is better; NaN where nothing could be measured."""
    if result.truth_points:
        return result.summary().mean[ALL].metrics[LIDAR_SCORE]
    return mean([photometric(image) for image in result.images])


def numbers_of(result: EvaluationResult) -> dict[str, float]:
    """Return the numbers by which a run is followed; those that could not be measured are left out."""
    metrics = result.summary().mean[ALL].metrics
    found = {"score": score_of(result), "sets": float(len(result.sets))}
    found |= {name: metrics[name] for name in _SHOWN_METRICS}
    found |= {"scale": _median([image.scale for image in result.images])}
    found |= {
        name: mean([v for image in result.images if not math.isnan(v := getattr(image.label_free, name))])
        for name in ("spatial", "temporal", "spatial_photometric", "temporal_photometric")
    }
    if (pose := result.pose_score) is not None:
        found |= {"pose_ratio": pose.ratio, "pose_degrees": pose.degrees}
    return {name: value for name, value in found.items() if not math.isnan(value)}


def camera_numbers(result: EvaluationResult) -> dict[str, dict[str, float | None]]:
    """Return the numbers of each camera; None for what could not be measured."""
    cameras = result.summary().cameras
    return {camera: nan_to_null(_camera_numbers(result, camera, cameras[camera][ALL].metrics)) for camera in cameras}


def photometric(image: ImageScore) -> float:
    """Return the image's label-free score."""
    errors = (image.label_free.spatial_photometric, image.label_free.temporal_photometric)
    return mean([error for error in errors if not math.isnan(error)] or [_UNEXPLAINED])


def _not_scored(before: EvaluationResult, after: EvaluationResult) -> str:
    """Return the reasons why held-out parts were not scored, to be added to the verdict's; empty without any."""
    reasons = {failure.path: failure.reason for result in (before, after) for failure in result.failed}
    return "".join(f"; not scored: {reason}" for reason in reasons.values())


def _camera_numbers(result: EvaluationResult, camera: str, metrics: Mapping[str, float]) -> dict[str, float]:
    images = [image for image in result.images if image.camera == camera]
    shown = {name: metrics[name] for name in _SHOWN_METRICS}
    label_free = mean([photometric(image) for image in images])
    return {**shown, "scale": _median([image.scale for image in images]), LABEL_FREE_SCORE: label_free}


def _compare_label_free(before: EvaluationResult, after: EvaluationResult) -> Comparison:
    cameras = before.scores.cameras
    return compare_values(_label_free_values(before, cameras), _label_free_values(after, cameras), [LABEL_FREE_SCORE])


def _label_free_values(result: EvaluationResult, cameras: Sequence[str]) -> SetValues:
    values: SetValues = {}
    for image in result.images:
        key = (image.recording, image.stamp_ns)
        found = values.setdefault(key, np.full((len(cameras), 1), np.nan))
        found[cameras.index(image.camera)] = photometric(image)
    return values


def _median(values: Sequence[float]) -> float:
    numbers = [value for value in values if not math.isnan(value)]
    return float(np.median(numbers)) if numbers else math.nan


def _name(score: str) -> str:
    return {LIDAR_SCORE: "Abs Rel", LABEL_FREE_SCORE: "photometric error"}[score]
