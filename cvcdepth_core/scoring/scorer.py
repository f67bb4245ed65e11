# SPDX-License-Identifier: Apache-2.0
"""Measures depth against truth, set by set, as `Scores` that can be merged with others."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.scoring.metrics import SUMS, ErrorSums, Sums, median_ratio, sum_errors
from cvcdepth_core.scoring.scores import SCALINGS, Measurements, Scores, ScoreSettings


class DepthSamples(NamedTuple):
    """Truth of one image, and the prediction at the same pixels."""

    prediction: NDArray[np.float64]
    """[M] metres, NaN where there is none."""
    truth: NDArray[np.float64]
    """[M] metres."""
    overlap: NDArray[np.bool_]
    """[M] whether a neighbouring camera sees the point too."""
    parts: Mapping[str, NDArray[np.bool_]] = MappingProxyType({})
    """[M] each: `SparseDepth.parts`."""

    def of(self, part: str) -> NDArray[np.bool_]:
        """Return which pixels [M] belong to a part; none where the truth does not tell it."""
        return self.parts.get(part, np.zeros(len(self.truth), dtype=bool))


class SurroundScorer:
    """Measures the sets of one recording, in order."""

    def __init__(self, recording: str, cameras: Sequence[str], settings: ScoreSettings) -> None:
        """Begin without sets; the name `recording` is unique within the evaluation."""
        self._settings = settings
        self._cameras = tuple(cameras)
        self._images, self._pools = (_Columns(recording, self._cameras, len(settings.groups)) for _ in range(2))
        self._pooled_sets: list[tuple[int, Sequence[DepthSamples]]] = []

    def add(self, stamp_ns: int, samples: Sequence[DepthSamples]) -> int:
        """Measure one set, `samples` in the order of the cameras; return how many pixels have truth inside the limits.

        Raises ConfigError when there is not one for each camera.
        """
        if len(samples) != len(self._cameras):
            raise ConfigError(f"scores: samples of {len(samples)} cameras, expected {len(self._cameras)}")
        valid = [_within_limits(image, self._settings) for image in samples]
        self._images.add(stamp_ns, *self._measure(valid))
        self._pooled_sets.append((stamp_ns, valid))
        if len(self._pooled_sets) == self._settings.pool:
            self._close_pool()
        return sum(len(image.truth) for image in valid)

    def scores(self) -> Scores:
        """Return the scores of the sets so far."""
        return Scores(self._settings, (self._images.table(),), (self._pools.table(),))

    def _close_pool(self) -> None:
        stamps, sets = zip(*self._pooled_sets, strict=True)
        joined = [_joined(images, self._settings.parts) for images in zip(*sets, strict=True)]
        self._pools.add(stamps[0], *self._measure(joined))
        self._pooled_sets.clear()

    def _measure(self, samples: Sequence[DepthSamples]) -> tuple[list[float], Sums]:
        """Return the scales [N] and the sums [N, 2, G]."""
        scales, sums = [], []
        for image in samples:
            scale = median_ratio(image.prediction, image.truth)
            scaled = image._replace(prediction=_clamp(image.prediction * scale, self._settings))
            scales.append(scale)
            sums.append([_sums_by_group(found, self._settings) for found in (image, scaled)])
        return scales, np.array(sums, dtype=SUMS)


class _Columns:
    """The columns of `Measurements` while they grow."""

    def __init__(self, recording: str, cameras: tuple[str, ...], groups: int) -> None:
        self._recording, self._cameras, self._groups = recording, cameras, groups
        self._stamps, self._scales, self._sums = array("q"), array("d"), bytearray()

    def add(self, stamp_ns: int, scales: Sequence[float], sums: Sums) -> None:
        self._stamps.append(stamp_ns)
        self._scales.extend(scales)
        self._sums += sums.tobytes()

    def table(self) -> Measurements:
        cameras = len(self._cameras)
        sums = np.frombuffer(bytes(self._sums), SUMS).reshape(-1, cameras, len(SCALINGS), self._groups)
        scales = np.array(self._scales, dtype=np.float64).reshape(-1, cameras)
        return Measurements(self._recording, self._cameras, np.array(self._stamps, dtype=np.int64), scales, sums)


def _within_limits(image: DepthSamples, settings: ScoreSettings) -> DepthSamples:
    """Keep the truth inside the limits; a prediction of 0 or less is none, like NaN."""
    kept = (image.truth > settings.min_depth) & (image.truth < settings.max_depth)
    prediction = np.where(image.prediction > 0, image.prediction, np.nan)[kept]
    parts = {name: mask[kept] for name, mask in image.parts.items()}
    return DepthSamples(_clamp(prediction, settings), image.truth[kept], image.overlap[kept], parts)


def _joined(images: Sequence[DepthSamples], parts: Sequence[str]) -> DepthSamples:
    return DepthSamples(
        np.concatenate([image.prediction for image in images]),
        np.concatenate([image.truth for image in images]),
        np.concatenate([image.overlap for image in images]),
        {name: np.concatenate([image.of(name) for image in images]) for name in parts},
    )


def _clamp(prediction: NDArray[np.float64], settings: ScoreSettings) -> NDArray[np.float64]:
    clamped: NDArray[np.float64] = np.clip(prediction, settings.min_depth, settings.max_depth)
    return clamped


def _sums_by_group(image: DepthSamples, settings: ScoreSettings) -> list[ErrorSums]:
    """Add up the errors of every group."""
    bins = np.digitize(image.truth, settings.range_edges)
    ranges = [bins == i for i, _ in enumerate(settings.range_names, start=1)]
    masks = [np.ones(len(image.truth), dtype=bool), *ranges, image.overlap, *map(image.of, settings.parts)]
    return [sum_errors(image.prediction[mask], image.truth[mask]) for mask in masks]
