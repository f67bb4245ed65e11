# SPDX-License-Identifier: Apache-2.0
"""Depth scores of many images: merged exactly from parts, summarised, written to JSON and back without loss.

Of every image (and every pool of images) there are sums and counts, of which nothing is added up any further. Means are
taken with `math.fsum`, which rounds once; so a result depends neither on the number of workers nor on their order.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.files import nan_to_null
from cvcdepth_core.scoring.metrics import METRIC_NAMES, SUMS, Sums, metrics_of

EvaluationProtocol = Literal["image", "pool"]
"""`image`: every image is one measurement (the field's). `pool`: the pixels of some consecutive images of a camera are,
and an incomplete last pool is left out (that of the published numbers)."""
Scaling = Literal["metric", "median"]
"""`metric`: depth as predicted. `median`: times median(truth) / median(prediction) of the measurement."""
SCALINGS: tuple[Scaling, ...] = ("metric", "median")

ALL, OVERLAP = "all", "overlap"


def mean(values: Sequence[float]) -> float:
    """Return the mean, rounded once whatever the order; NaN for no values."""
    return math.fsum(values) / len(values) if values else math.nan


class ScoreSettings(BaseModel):
    """Settings of a measurement; numbers of different settings must not be compared."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    min_depth: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    """Metres; truth at or below it is left out, predictions are clamped to it."""
    max_depth: float = Field(default=80.0, gt=0, allow_inf_nan=False)
    """Metres; truth at or beyond it is left out, predictions are clamped to it."""
    range_edges: tuple[float, ...] = (0.0, 10.0, 20.0, 40.0, 80.0)
    """Metres of true depth at which range bins begin; the last one is open. None: there are no bins."""
    pool: int = Field(default=4, ge=1)
    """Consecutive images of a camera that form one pool."""
    parts: tuple[str, ...] = ()
    """Names of parts of the pixels that are measured apart, where the truth tells them (`SparseDepth.parts`)."""

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
        if not self.range_edges:
            return []
        *inner, last = self.range_edges
        return [f"{a:g}-{b:g}" for a, b in zip(inner, self.range_edges[1:], strict=True)] + [f"{last:g}+"]

    @property
    def groups(self) -> list[str]:
        """The names of all groups of pixels that are measured."""
        return [ALL, *self.range_names, OVERLAP, *self.parts]


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of one recording, in columns: 0.7 kB for an image, or for a pool of images, of a camera."""

    recording: str
    cameras: tuple[str, ...]
    stamps_ns: NDArray[np.int64]
    """[S] of the set that the images (a pool's first ones) belong to."""
    scales: NDArray[np.float64]
    """[S, N] median(truth) / median(prediction), NaN where nothing was predicted."""
    sums: Sums
    """[S, N, 2, G] by scaling (`SCALINGS`) and group (`ScoreSettings.groups`)."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def of_camera(self, camera: str, scaling: Scaling) -> Sums:
        """Return the sums [S, G] of one camera, [0, G] where the rig has no such camera."""
        if camera not in self.cameras:
            return self.sums[:0, 0, 0]
        return self.sums[:, self.cameras.index(camera), SCALINGS.index(scaling)]

    def scales_of(self, camera: str) -> NDArray[np.float64]:
        """Return the scales [S] of one camera, [0] where the rig has no such camera."""
        return self.scales[:, self.cameras.index(camera)] if camera in self.cameras else self.scales[:0, 0]

    def to_json(self) -> dict[str, Any]:
        """Return the content for JSON: the columns compressed, as the bytes of little-endian numbers."""
        columns = b"".join(
            np.ascontiguousarray(column).tobytes() for column in (self.stamps_ns, self.scales, self.sums)
        )
        packed = base64.b64encode(zlib.compress(columns)).decode("ascii")
        shape = {"sets": len(self), "groups": self.sums.shape[-1]}
        return {"recording": self.recording, "cameras": list(self.cameras), **shape, "columns": packed}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Measurements:
        """Return what `to_json` was called on."""
        cameras, sets, groups = tuple(content["cameras"]), int(content["sets"]), int(content["groups"])
        shapes: dict[np.dtype[Any], tuple[int, ...]] = {
            np.dtype("<i8"): (sets,),
            np.dtype("<f8"): (sets, len(cameras)),
            SUMS: (sets, len(cameras), len(SCALINGS), groups),
        }
        packed = zlib.decompress(base64.b64decode(content["columns"], validate=True))
        columns, offset = [], 0
        for dtype, shape in shapes.items():
            column = np.frombuffer(packed, dtype, math.prod(shape), offset).reshape(shape)
            offset += column.nbytes
            columns.append(column)
        return cls(str(content["recording"]), cameras, *columns)


class Score(NamedTuple):
    """The metrics of one group of pixels, of one camera or of their mean."""

    metrics: dict[str, float]
    """By `METRIC_NAMES`; NaN where there was no truth, or no prediction."""
    coverage: float
    """Share of the truth pixels with a prediction; NaN where there was no truth."""
    truth: int
    """Truth pixels."""
    measurements: int
    """Images or pools that the metrics are averaged over."""

    def to_json(self) -> dict[str, Any]:
        """Return the content for JSON, NaN as null."""
        counts = {"truth_points": self.truth, "measurements": self.measurements}
        return nan_to_null(self.metrics | {"coverage": self.coverage}) | counts


class Summary(NamedTuple):
    """The scores by group of pixels."""

    cameras: dict[str, dict[str, Score]]
    """Mean over the measurements of each camera."""
    mean: dict[str, Score]
    """Mean over the cameras that have a value."""

    def to_json(self) -> dict[str, Any]:
        """Return the content for JSON."""
        cameras = {name: _json_by_group(scores) for name, scores in self.cameras.items()}
        return {"mean": _json_by_group(self.mean), "cameras": cameras}


@dataclass(frozen=True, eq=False)
class Scores:
    """Measurements of one or many recordings, sorted by their names."""

    settings: ScoreSettings
    images: tuple[Measurements, ...]
    pools: tuple[Measurements, ...]

    @classmethod
    def merged(cls, parts: Iterable[Scores]) -> Scores:
        """Join parts measured anywhere, in any order.

        Raises ConfigError when there is none, their settings differ, or a recording was measured twice.
        """
        parts = list(parts)
        if not parts:
            raise ConfigError("scores: nothing to merge")
        settings = parts[0].settings
        for other in parts[1:]:
            if other.settings != settings:
                raise ConfigError(f"scores: settings {other.settings} and {settings} cannot be merged")
        images = _by_recording(table for part in parts for table in part.images)
        return cls(settings, images, _by_recording(table for part in parts for table in part.pools))

    @property
    def cameras(self) -> list[str]:
        """The cameras' names, in the rig's order."""
        return list(dict.fromkeys(camera for table in self.images if len(table) for camera in table.cameras))

    def summary(self, protocol: EvaluationProtocol = "image", scaling: Scaling = "metric") -> Summary:
        """Return the means: per camera over its measurements, then over the cameras."""
        tables = self.images if protocol == "image" else self.pools
        cameras = {}
        for camera in self.cameras:
            own = [table.of_camera(camera, scaling) for table in tables]
            cameras[camera] = {
                group: _camera_score(np.concatenate([sums[:, index] for sums in own]))
                for index, group in enumerate(self.settings.groups)
            }
        mean = {g: _mean_score([scores[g] for scores in cameras.values()]) for g in self.settings.groups}
        return Summary(cameras, mean)

    def scale_ratios(self, protocol: EvaluationProtocol = "image") -> dict[str, float]:
        """Return median(truth) / median(prediction) of each camera, the geometric mean; 1 where the scale is right."""
        tables = self.images if protocol == "image" else self.pools
        return {camera: _geometric_mean([table.scales_of(camera) for table in tables]) for camera in self.cameras}

    def to_json(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {
            "settings": self.settings.model_dump(mode="json"),
            "images": [table.to_json() for table in self.images],
            "pools": [table.to_json() for table in self.pools],
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Scores:
        """Return what `to_json` was called on. Raises ConfigError when `content` was not written by it."""
        try:
            images, pools = (tuple(map(Measurements.from_json, content[key])) for key in ("images", "pools"))
            return cls(ScoreSettings.model_validate(content["settings"]), images, pools)
        except (KeyError, TypeError, ValueError, zlib.error) as error:
            raise ConfigError(f"scores: not what this version writes: {error!r}") from error


def _by_recording(tables: Iterable[Measurements]) -> tuple[Measurements, ...]:
    ordered = tuple(sorted(tables, key=lambda table: table.recording))
    for one, following in pairwise(ordered):
        if one.recording == following.recording:
            raise ConfigError(f"scores: {one.recording} was measured twice")
    return ordered


def _camera_score(sums: Sums) -> Score:
    measured = metrics_of(sums[sums["predicted"] > 0])
    truth, predicted = (int(sums[name].sum(dtype=np.int64)) for name in ("truth", "predicted"))
    metrics = {name: mean(measured[:, i].tolist()) for i, name in enumerate(METRIC_NAMES)}
    return Score(metrics, predicted / truth if truth else math.nan, truth, len(measured))


def _mean_score(scores: Sequence[Score]) -> Score:
    truth = sum(score.truth for score in scores)
    covered = [score.coverage for score in scores if score.truth]
    metrics = _means([score.metrics for score in scores if score.measurements])
    return Score(metrics, mean(covered), truth, sum(score.measurements for score in scores))


def _means(metrics: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: mean([m[name] for m in metrics]) for name in METRIC_NAMES}


def _geometric_mean(ratios: Sequence[NDArray[np.float64]]) -> float:
    logarithms = np.log(np.concatenate(ratios))
    return math.exp(mean(logarithms[np.isfinite(logarithms)].tolist()))


def _json_by_group(scores: Mapping[str, Score]) -> dict[str, Any]:
    return {group: score.to_json() for group, score in scores.items()}
