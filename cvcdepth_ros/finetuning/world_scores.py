# SPDX-License-Identifier: Apache-2.0
"""Scores on worlds that are held out: how well depth is known there, and whether a training made it forget."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.networks.registry import RIG_CONDITIONED
from cvcdepth_core.scoring.comparison import Comparison, Difference, SetValues, compare_values
from cvcdepth_core.scoring.metrics import METRIC_NAMES, SUMS, metrics_of, sum_errors
from cvcdepth_core.training.config import TrainingConfig
from cvcdepth_core.training.model import SurroundModel
from cvcdepth_core.training.starting_model import build_surround_model
from cvcdepth_ros.training_data.world_views import ViewReader, batch_of_views

NOT_TOLD = (
    f"depth.network is not {RIG_CONDITIONED}: a network that is not told its rig learns no rig's scale from worlds"
)
_MIN_DEPTH = 0.5  # metres, of scores
_TOGETHER = 8  # views that are scored at a time
_DECIDING = "delta_1"
"""The share of pixels within 1.25: one view in which the sky is seen in a wall decides the mean Abs Rel of all."""


class ViewScores:
    """Scores weights on whole views of held-out drives, at most `most` of them."""

    def __init__(
        self, reader: ViewReader, config: TrainingConfig, device: torch.device, most: int | None = None
    ) -> None:
        chosen = np.random.default_rng(config.seed).permutation(len(reader.views))[:most]
        self._reader, self._config, self._device = reader, config, device
        self.views = [reader.views[i] for i in sorted(chosen.tolist())]

    def __call__(self, model: SurroundModel) -> NDArray[np.float64]:
        """Return the metrics [V, M] of each view's pixels nearer than `evaluation.max_depth`; NaN without any.

        As in `evaluate`, predictions are clamped: a near pixel that is taken for the sky is wrong, not infinitely so.
        """
        rows, farthest = [], self._config.evaluation.max_depth
        for start in range(0, len(self.views), _TOGETHER):
            views = [self._reader.read(v, self._config.worlds, None) for v in self.views[start : start + _TOGETHER]]
            batch = batch_of_views(views).to(self._device)
            as_it_is = torch.zeros(len(views), dtype=torch.bool, device=self._device)
            depth = model(batch, batch.frames, as_it_is, as_it_is).depth[:, 0, 0].double().cpu().numpy()
            for found, view in zip(depth, views, strict=True):
                known = (view.truth > _MIN_DEPTH) & (view.truth < farthest)
                clamped = found[known].clip(_MIN_DEPTH, farthest)
                rows.append(sum_errors(clamped, view.truth[known].astype(np.float64)))
        return metrics_of(np.array(rows, SUMS))

    def of_file(self, checkpoint: Path) -> NDArray[np.float64]:
        """Return the metrics of the weights in a file."""
        model = build_surround_model(self._config, load_checkpoint(checkpoint)).to(self._device).eval()
        with torch.inference_mode():
            return self(model)


def mean_scores(metrics: NDArray[np.float64]) -> dict[str, float]:
    """Return the mean over views of each of `METRIC_NAMES`."""
    means = np.nanmean(metrics, axis=0)
    return {name: round(float(mean), 4) for name, mean in zip(METRIC_NAMES, means, strict=True)}


@dataclass(frozen=True)
class WorldVerdict:
    """What a training did to the depth of worlds."""

    before: dict[str, float]
    """The start's scores, mean over views."""
    after: dict[str, float]
    views: int
    difference: Difference
    """Of the share of pixels within 1.25 of the truth, which is better when higher."""
    is_worse: bool
    """Whether it is proven that the weights know less of worlds than their start."""

    def describe(self) -> str:
        """Return the comparison in words, with the numbers."""
        words = "worse than the start" if self.is_worse else "not proven to be worse than the start"
        one = self.difference
        return (
            f"{words} on worlds: δ < 1.25 {one.first:.4f} before, {one.second:.4f} after, difference "
            f"{one.difference:+.4f} (95% interval {one.low:+.4f} to {one.high:+.4f}, {self.views} held-out views); "
            f"Abs Rel {self.before['abs_rel']:.4f} before, {self.after['abs_rel']:.4f} after"
        )

    def to_json(self) -> dict[str, Any]:
        """Return the verdict with JSON's types."""
        return {**asdict(self), "verdict": self.describe()}


def compare_worlds(scores: ViewScores, before: NDArray[np.float64], after: NDArray[np.float64]) -> WorldVerdict:
    """Compare two weights' metrics on the same views, by bootstrap; views that follow each other are drawn together.

    ConfigError where there are fewer than two.
    """
    comparison: Comparison = compare_values(_values(scores, before), _values(scores, after), METRIC_NAMES)
    difference = comparison.differences[_DECIDING]
    is_worse = comparison.can_prove and difference.high < 0
    return WorldVerdict(mean_scores(before), mean_scores(after), len(scores.views), difference, is_worse)


def _values(scores: ViewScores, metrics: NDArray[np.float64]) -> SetValues:
    names = [(f"{view.shard:06d}/{view.camera:03d}", view.set) for view in scores.views]
    return {name: row[None] for name, row in zip(names, metrics, strict=True)}


def describe_drives(paths: Sequence[Path]) -> str:
    """Return number and hash of shards, of their names and sizes: the same choices give the same bytes."""
    told = "\n".join(f"{path.name} {path.stat().st_size}" for path in paths)
    return f"{len(paths)} drives {hashlib.sha256(told.encode()).hexdigest()[:16]}"
