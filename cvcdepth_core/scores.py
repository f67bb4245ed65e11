# SPDX-License-Identifier: Apache-2.0
"""Depth scores of many images: measured in parts, merged exactly, written to JSON and back without loss.

Every image (and every pool of images) is one row of sums and counts. Merging joins the rows, and means are taken with
`math.fsum`, which rounds once; so a result depends neither on the number of workers nor on their order.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeVar
from typing import Protocol as TypingProtocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.metrics import METRIC_NAMES, ErrorSums, median_ratio, sum_errors

Protocol = Literal["image", "pool"]
"""`image`: every image is one measurement (the field's). `pool`: the pixels of some consecutive images of a camera are,
and an incomplete last pool is left out (that of the published numbers)."""
Scaling = Literal["metric", "median"]
"""`metric`: depth as predicted. `median`: times median(truth) / median(prediction) of the measurement."""
SCALINGS: tuple[Scaling, ...] = ("metric", "median")

ALL, OVERLAP = "all", "overlap"


class Row(TypingProtocol):
    """One line of results."""

    @property
    def key(self) -> tuple[Any, ...]:
        """The recording's name, the set's stamp, and what tells the row from the others of that set."""


RowType = TypeVar("RowType", bound=Row)


def sorted_rows(rows: Iterable[RowType]) -> tuple[RowType, ...]:
    """Sort by recording and time; the rows of a set, which always come together, keep the rig's order.

    Raises ConfigError for a row that is there twice.
    """
    ordered = tuple(sorted(rows, key=lambda row: row.key[:2]))
    twice = [key for key, count in Counter(row.key for row in ordered).items() if count > 1]
    if twice:
        raise ConfigError(f"scores: {', '.join(map(str, twice[0]))} was measured twice")
    return ordered


def mean(values: Sequence[float]) -> float:
    """Return the mean, rounded once whatever the order; NaN for no values."""
    return math.fsum(values) / len(values) if values else math.nan


class ScoreSettings(BaseModel):
    """What is measured; numbers of different settings must not be compared."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    min_depth: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    """Metres; truth at or below it is left out, predictions are clamped to it."""
    max_depth: float = Field(default=80.0, gt=0, allow_inf_nan=False)
    """Metres; truth at or beyond it is left out, predictions are clamped to it."""
    range_edges: tuple[float, ...] = (0.0, 10.0, 20.0, 40.0, 80.0)
    """Metres of true depth at which range bins begin; the last one is open."""
    pool: int = Field(default=4, ge=1)
    """Consecutive images of a camera that form one pool."""

    @model_validator(mode="after")
    def _check(self) -> ScoreSettings:
        if self.min_depth >= self.max_depth:
            raise ValueError(f"min_depth {self.min_depth} must be below max_depth {self.max_depth}")
        if any(a >= b for a, b in zip(self.range_edges, self.range_edges[1:], strict=False)):
            raise ValueError(f"range_edges {self.range_edges} must ascend")
        return self

    @property
    def range_names(self) -> list[str]:
        """The names of the range bins: `0-10`, ..., `80+`."""
        *inner, last = self.range_edges
        return [f"{a:g}-{b:g}" for a, b in zip(inner, self.range_edges[1:], strict=True)] + [f"{last:g}+"]

    @property
    def groups(self) -> list[str]:
        """The names of all groups of pixels that are measured."""
        return [ALL, *self.range_names, OVERLAP]


class DepthSamples(NamedTuple):
    """One image's truth and the prediction there."""

    prediction: NDArray[np.float64]
    """[M] metres, NaN where there is none."""
    truth: NDArray[np.float64]
    """[M] metres."""
    overlap: NDArray[np.bool_]
    """[M] whether a neighbouring camera sees the point too."""


@dataclass(frozen=True)
class Measurement:
    """The errors of one image, or of one pool of images, of one camera."""

    recording: str
    stamp_ns: int
    """Of the set that the image (the pool's first) belongs to."""
    camera: str
    scale: float
    """median(truth) / median(prediction), NaN where nothing was predicted."""
    sums: Mapping[Scaling, Mapping[str, ErrorSums]]
    """By scaling and group; a group without truth is absent."""

    @property
    def key(self) -> tuple[str, int, str]:
        """What tells it from all other measurements."""
        return self.recording, self.stamp_ns, self.camera

    def to_json(self) -> dict[str, Any]:
        """Return it with JSON's types; sums are lists in the order of `ErrorSums`."""
        sums = {scaling: {group: list(s) for group, s in groups.items()} for scaling, groups in self.sums.items()}
        scale = None if math.isnan(self.scale) else self.scale
        return {"recording": self.recording, "stamp_ns": self.stamp_ns, "camera": self.camera, "scale": scale} | sums

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Measurement:
        """Undo `to_json`."""
        sums = {scaling: {group: ErrorSums(*s) for group, s in row[scaling].items()} for scaling in SCALINGS}
        scale = math.nan if row["scale"] is None else row["scale"]
        return cls(row["recording"], row["stamp_ns"], row["camera"], scale, sums)


class Score(NamedTuple):
    """The metrics of one group of pixels, of one camera or of their mean."""

    metrics: dict[str, float]
    """By `METRIC_NAMES`; NaN where there was no truth, or no prediction."""
    coverage: float
    """Share of the truth pixels with a prediction; NaN where there was no truth."""
    truth: int
    """Truth pixels."""
    measurements: int
    """Images or pools that the metrics are the mean of."""

    def to_json(self) -> dict[str, Any]:
        """Return it with JSON's types; what is NaN is null."""
        numbers = self.metrics | {"coverage": self.coverage}
        return {name: None if math.isnan(number) else number for name, number in numbers.items()} | {
            "truth_points": self.truth,
            "measurements": self.measurements,
        }


class Summary(NamedTuple):
    """The scores by group of pixels."""

    cameras: dict[str, dict[str, Score]]
    """Of each camera: the mean over its measurements."""
    mean: dict[str, Score]
    """The mean over the cameras that have a value."""

    def to_json(self) -> dict[str, Any]:
        """Return it with JSON's types."""
        cameras = {name: _json_by_group(scores) for name, scores in self.cameras.items()}
        return {"mean": _json_by_group(self.mean), "cameras": cameras}


@dataclass(frozen=True)
class Scores:
    """The rows of one or many recordings, sorted by recording and time."""

    settings: ScoreSettings
    images: tuple[Measurement, ...]
    pools: tuple[Measurement, ...]

    @classmethod
    def merged(cls, parts: Iterable[Scores]) -> Scores:
        """Join parts measured anywhere, in any order.

        Raises ConfigError when there is none, their settings differ, or an image was measured twice.
        """
        parts = list(parts)
        if not parts:
            raise ConfigError("scores: nothing to merge")
        settings = parts[0].settings
        for other in parts[1:]:
            if other.settings != settings:
                raise ConfigError(f"scores: settings {other.settings} and {settings} cannot be merged")
        return cls(
            settings,
            sorted_rows(row for part in parts for row in part.images),
            sorted_rows(row for part in parts for row in part.pools),
        )

    @property
    def cameras(self) -> list[str]:
        """The cameras' names, in the rig's order."""
        return list(dict.fromkeys(row.camera for row in self.images))

    def summary(self, protocol: Protocol = "image", scaling: Scaling = "metric") -> Summary:
        """Take the means: per camera over its measurements, then over the cameras."""
        rows = self.images if protocol == "image" else self.pools
        cameras = {}
        for camera in self.cameras:
            own = [row.sums[scaling] for row in rows if row.camera == camera]
            cameras[camera] = {g: _camera_score([s[g] for s in own if g in s]) for g in self.settings.groups}
        mean = {g: _mean_score([scores[g] for scores in cameras.values()]) for g in self.settings.groups}
        return Summary(cameras, mean)

    def to_json(self) -> dict[str, Any]:
        """Return everything with JSON's types."""
        return {
            "settings": self.settings.model_dump(mode="json"),
            "images": [row.to_json() for row in self.images],
            "pools": [row.to_json() for row in self.pools],
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Scores:
        """Undo `to_json`. Raises ConfigError when `content` was not written by it."""
        try:
            images, pools = (tuple(map(Measurement.from_json, content[key])) for key in ("images", "pools"))
            return cls(ScoreSettings.model_validate(content["settings"]), images, pools)
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"scores: not what this version writes: {error!r}") from error


class SurroundScorer:
    """Measures the sets of one recording, in order."""

    def __init__(self, recording: str, cameras: Sequence[str], settings: ScoreSettings) -> None:
        """Name the `recording` as no other recording of the evaluation is named."""
        self._recording = recording
        self._cameras = tuple(cameras)
        self._settings = settings
        self._images: list[Measurement] = []
        self._pools: list[Measurement] = []
        self._pooled_sets: list[tuple[int, Sequence[DepthSamples]]] = []

    def add(self, stamp_ns: int, samples: Sequence[DepthSamples]) -> list[Measurement]:
        """Measure one set, `samples` in the order of the cameras; return its rows.

        Raises ConfigError when there is not one for each camera.
        """
        if len(samples) != len(self._cameras):
            raise ConfigError(f"scores: samples of {len(samples)} cameras, expected {len(self._cameras)}")
        valid = [_within_limits(image, self._settings) for image in samples]
        measured = self._measure(stamp_ns, valid)
        self._images += measured
        self._pooled_sets.append((stamp_ns, valid))
        if len(self._pooled_sets) == self._settings.pool:
            self._close_pool()
        return measured

    def scores(self) -> Scores:
        """Return what was measured so far."""
        return Scores(self._settings, sorted_rows(self._images), sorted_rows(self._pools))

    def _close_pool(self) -> None:
        stamps, sets = zip(*self._pooled_sets, strict=True)
        joined = [DepthSamples(*map(np.concatenate, zip(*images, strict=True))) for images in zip(*sets, strict=True)]
        self._pools += self._measure(stamps[0], joined)
        self._pooled_sets.clear()

    def _measure(self, stamp_ns: int, samples: Sequence[DepthSamples]) -> list[Measurement]:
        rows = []
        for camera, image in zip(self._cameras, samples, strict=True):
            scale = median_ratio(image.prediction, image.truth)
            scaled = _clamp(image.prediction * scale, self._settings)
            sums: dict[Scaling, dict[str, ErrorSums]] = {
                "metric": _sums_by_group(image, self._settings),
                "median": _sums_by_group(image._replace(prediction=scaled), self._settings),
            }
            rows.append(Measurement(self._recording, stamp_ns, camera, scale, sums))
        return rows


def _within_limits(image: DepthSamples, settings: ScoreSettings) -> DepthSamples:
    """Keep the truth inside the limits; a prediction of 0 or less is none, like NaN."""
    kept = (image.truth > settings.min_depth) & (image.truth < settings.max_depth)
    prediction = np.where(image.prediction > 0, image.prediction, np.nan)[kept]
    return DepthSamples(_clamp(prediction, settings), image.truth[kept], image.overlap[kept])


def _clamp(prediction: NDArray[np.float64], settings: ScoreSettings) -> NDArray[np.float64]:
    clamped: NDArray[np.float64] = np.clip(prediction, settings.min_depth, settings.max_depth)
    return clamped


def _sums_by_group(image: DepthSamples, settings: ScoreSettings) -> dict[str, ErrorSums]:
    """Add up the errors of every group that has truth."""
    bins = np.digitize(image.truth, settings.range_edges)
    masks = {ALL: np.ones(len(image.truth), dtype=bool)}
    masks |= {name: bins == i for i, name in enumerate(settings.range_names, start=1)}
    masks[OVERLAP] = image.overlap
    return {g: sum_errors(image.prediction[mask], image.truth[mask]) for g, mask in masks.items() if mask.any()}


def _camera_score(sums: Sequence[ErrorSums]) -> Score:
    measured = [s.metrics() for s in sums if s.predicted]
    truth, predicted = sum(s.truth for s in sums), sum(s.predicted for s in sums)
    return Score(_means(measured), predicted / truth if truth else math.nan, truth, len(measured))


def _mean_score(scores: Sequence[Score]) -> Score:
    truth = sum(score.truth for score in scores)
    covered = [score.coverage for score in scores if score.truth]
    metrics = _means([score.metrics for score in scores if score.measurements])
    return Score(metrics, mean(covered), truth, sum(score.measurements for score in scores))


def _means(metrics: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: mean([m[name] for m in metrics]) for name in METRIC_NAMES}


def _json_by_group(scores: Mapping[str, Score]) -> dict[str, Any]:
    return {group: score.to_json() for group, score in scores.items()}
