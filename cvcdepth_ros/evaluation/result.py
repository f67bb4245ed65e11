# SPDX-License-Identifier: Apache-2.0
"""The result of an evaluation: the recordings' scores merged, as `metrics.json` holds them (docs/evaluation.md)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from cvcdepth_core.errors import ConfigError, RecordingError
from cvcdepth_core.files import nan_to_null
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.scoring.comparison import Comparison, compare
from cvcdepth_core.scoring.confidence_scores import ConfidenceScores
from cvcdepth_core.scoring.consistency import AgreementTable, summarise_agreement
from cvcdepth_core.scoring.obstacles import ObstacleScores
from cvcdepth_core.scoring.scores import ALL, SCALINGS, EvaluationProtocol, Scaling, Score, Scores, Summary
from cvcdepth_core.training.pose_network import PoseScore, pose_score_to_json
from cvcdepth_ros.evaluation.image_scores import (
    ImageScore,
    LabelFree,
    SetScore,
    correlations,
    image_scores,
    label_free_by_camera,
    mean_label_free,
)
from cvcdepth_ros.evaluation.job import Dependencies, EvaluationJob
from cvcdepth_ros.evaluation.measuring import RecordingScores
from cvcdepth_ros.evaluation.pose_scores import joined_pose_score
from cvcdepth_ros.evaluation.references import REFERENCES
from cvcdepth_ros.evaluation.trained_on import SeenSets, seen_in_training, trained_parts

SCHEMA = 2
_DECIDE_WHAT_IS_MEASURED = (
    "rig",
    "base_frame",
    "tolerance",
    "lidar",
    "lidar_tolerance",
    "no_occlusion_filter",
    "truth",
)

PROTOCOLS: tuple[EvaluationProtocol, ...] = ("image", "pool")


class Failure(NamedTuple):
    """A recording that could not be evaluated."""

    name: str
    path: str
    reason: str


class Model(NamedTuple):
    """The network or reference that was evaluated."""

    id: str
    """Its name in reports."""
    checkpoint: str | None
    """The checkpoint's path; None for an untrained network or a reference."""
    sha256: str | None
    """Hash of the checkpoint's bytes."""


class Reference(NamedTuple):
    """What looks at no picture, on all recordings that it could be scored on."""

    scores: Mapping[Scaling, Score]
    """Per image, the mean over the images and then over the cameras, all pixels together."""
    label_free: LabelFree
    """NaN where there is truth: depth that looks at no picture is not compared with itself then."""

    def to_json(self) -> dict[str, Any]:
        """Return the content for JSON, NaN as null."""
        scores = {scaling: score.to_json() for scaling, score in self.scores.items()}
        return {"scores": scores, "label_free": nan_to_null(self.label_free._asdict())}


@dataclass(frozen=True)
class EvaluationResult:
    """One model on all recordings."""

    version: str
    model: Model
    configuration: Mapping[str, Any]
    recordings: Sequence[RecordingScores]
    """Sorted by name, so that nothing depends on the order in which they were finished."""
    failed: Sequence[Failure]
    trained_on: Sequence[SeenSets] = ()
    """The sets among those scored that the checkpoint had been trained on, as far as it says."""

    @classmethod
    def from_outcomes(
        cls, jobs: Sequence[EvaluationJob], outcomes: Iterable[RecordingScores | Failure], depends_on: Dependencies
    ) -> EvaluationResult:
        """Return the result of jobs that differ in nothing but the recording; their outcomes come in any order.

        Raises RecordingError, with the first reason, when none could be evaluated.
        """
        found = list(outcomes)
        failed = [outcome for outcome in found if isinstance(outcome, Failure)]
        scores = [outcome for outcome in found if not isinstance(outcome, Failure)]
        if not scores:
            raise RecordingError(f"nothing could be evaluated: {failed[0].reason}")
        path = jobs[0].settings.checkpoint_path
        model = Model(scores[0].summary["model"], str(path) if path else None, depends_on.sha256)
        ordered = sorted(scores, key=lambda found: found.name)
        parts = trained_parts(load_checkpoint(path)) if path else []
        seen = seen_in_training(parts, (table for found in ordered for table in found.scores.images))
        return cls(depends_on.version, model, jobs[0].configuration(), ordered, sorted(failed), seen)

    @cached_property
    def scores(self) -> Scores:
        """The scores of all recordings together."""
        return Scores.merged(recording.scores for recording in self.recordings)

    @property
    def agreement(self) -> list[AgreementTable]:
        """The label-free comparisons, one table for each recording."""
        return [recording.agreement for recording in self.recordings]

    @property
    def images(self) -> Iterator[ImageScore]:
        """The scores image by image, computed while one iterates."""
        return chain.from_iterable(image_scores(self.scores, self.agreement))

    @cached_property
    def sets(self) -> list[SetScore]:
        """The scores set by set."""
        numbers = chain.from_iterable(range(len(table)) for table in self.scores.images)
        return list(map(SetScore.from_images, numbers, image_scores(self.scores, self.agreement)))

    def summary(self, protocol: EvaluationProtocol = "image", scaling: Scaling = "metric") -> Summary:
        """Return the means over all recordings."""
        return self.scores.summary(protocol, scaling)

    @cached_property
    def label_free(self) -> dict[str, LabelFree]:
        """The label-free scores of every camera."""
        return label_free_by_camera(self.scores, self.agreement)

    @cached_property
    def references(self) -> dict[str, Reference]:
        """The references by name, in the order of `REFERENCES`."""
        names = [name for name in REFERENCES if any(name in found.references for found in self.recordings)]
        return {name: self._reference(name) for name in names}

    def _reference(self, name: str) -> Reference:
        found = [recording.references[name] for recording in self.recordings if name in recording.references]
        scores = Scores.merged(one.scores for one in found)
        label_free = label_free_by_camera(scores, [one.agreement for one in found])
        by_scaling = {scaling: scores.summary("image", scaling).mean[ALL] for scaling in SCALINGS}
        return Reference(by_scaling, mean_label_free(label_free.values()))

    @cached_property
    def confidence(self) -> ConfidenceScores | None:
        """How good confidence is; None where it was not computed."""
        found = [recording.confidence for recording in self.recordings if recording.confidence is not None]
        return ConfidenceScores.merged(found) if found else None

    @cached_property
    def obstacles(self) -> ObstacleScores | None:
        """How a robot would feel it; None where that was not measured."""
        found = [recording.obstacles for recording in self.recordings if recording.obstacles is not None]
        return ObstacleScores.merged(found) if found else None

    @property
    def pose_score(self) -> PoseScore | None:
        """The checkpoint's pose network beside recorded motion; None where one of the two is missing."""
        return joined_pose_score(recording.summary for recording in self.recordings)

    @property
    def truth_points(self) -> int:
        """How many pixels have truth inside the depth limits."""
        return sum(int(recording.summary["truth_points"]) for recording in self.recordings)

    def to_json(self) -> dict[str, Any]:
        """Return the content of `metrics.json`."""
        return {
            "schema": SCHEMA,
            "version": self.version,
            "model": self.model._asdict(),
            "configuration": dict(self.configuration),
            "sets": len(self.sets),
            "truth_points": self.truth_points,
            "scores": {p: {s: self.summary(p, s).to_json() for s in SCALINGS} for p in PROTOCOLS},
            "scale_ratio": {p: nan_to_null(self.scores.scale_ratios(p)) for p in PROTOCOLS},
            "label_free": self._label_free(),
            "confidence": self.confidence.to_json() if self.confidence else None,
            "obstacles": self.obstacles.to_json() if self.obstacles else None,
            "pose_network": pose_score_to_json(self.pose_score),
            "references": {name: reference.to_json() for name, reference in self.references.items()},
            "recordings": [recording.summary for recording in self.recordings],
            "trained_on": [seen._asdict() for seen in self.trained_on],
            "failed": [failure._asdict() for failure in self.failed],
            "rows": self.scores.to_json(),
        }

    def _label_free(self) -> dict[str, Any]:
        pairs = [
            {"kind": kind, "camera": camera, "other": other} | nan_to_null(found._asdict())
            for (kind, camera, other), found in summarise_agreement(self.agreement).items()
        ]
        means = {
            "cameras": {name: nan_to_null(found._asdict()) for name, found in self.label_free.items()},
            "mean": nan_to_null(mean_label_free(self.label_free.values())._asdict()),
        }
        return {"pairs": pairs, **means, "rank_correlation_with_abs_rel": nan_to_null(correlations(self.sets))}


@dataclass(frozen=True)
class StoredResult:
    """The part of a `metrics.json` that a comparison needs."""

    model_id: str
    scores: Scores
    configuration: Mapping[str, Any]
    lidars: Mapping[str, Any]
    """The topics that truth came from, by recording."""

    @classmethod
    def read(cls, path: Path) -> StoredResult:
        """Read a `metrics.json`; ConfigError when the file is none."""
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            schema, model_id, rows = content["schema"], content["model"]["id"], content["rows"]
            configuration = dict(content["configuration"])
            lidars = {recording["name"]: recording["lidar"] for recording in content["recordings"]}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{path}: not a metrics.json of evaluate: {error!r}") from error
        if schema != SCHEMA:
            raise ConfigError(f"{path}: schema is {schema}, expected {SCHEMA}")
        return cls(str(model_id), Scores.from_json(rows), configuration, lidars)

    def measured_differently(self, other: StoredResult) -> list[str]:
        """Return the names of the options and found LiDARs that differ, so that not only the models do."""
        options = [
            name for name in _DECIDE_WHAT_IS_MEASURED if self.configuration.get(name) != other.configuration.get(name)
        ]
        common = self.lidars.keys() & other.lidars.keys()
        found = [f"lidar of {name}" for name in sorted(common) if self.lidars[name] != other.lidars[name]]
        return options + (found if "lidar" not in options else [])


def comparison_to_json(first: StoredResult, second: StoredResult) -> dict[str, Any]:
    """Return the content of `comparison.json`: two results over the sets that both have, metric and median-scaled."""
    found = {scaling: compare(first.scores, second.scores, scaling=scaling) for scaling in SCALINGS}
    return {
        "schema": SCHEMA,
        "first": first.model_id,
        "second": second.model_id,
        **_without_differences(found["metric"]),
        "can_prove": found["metric"].can_prove,
        "measured_differently": first.measured_differently(second),
        "differences": {scaling: _differences(comparison) for scaling, comparison in found.items()},
    }


def _without_differences(comparison: Comparison) -> dict[str, Any]:
    return {name: value for name, value in asdict(comparison).items() if name != "differences"}


def _differences(comparison: Comparison) -> dict[str, Any]:
    return {name: nan_to_null(asdict(difference)) for name, difference in comparison.differences.items()}
