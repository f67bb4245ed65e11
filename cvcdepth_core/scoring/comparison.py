# SPDX-License-Identifier: Apache-2.0
"""Significance of the difference between two results: paired bootstrap over common sets; rank correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.scoring.metrics import METRIC_NAMES, metrics_of
from cvcdepth_core.scoring.scores import ALL, Scaling, Scores

SetValues = dict[tuple[str, int], NDArray[np.float64]]
"""The numbers [N, M] of N cameras by (recording, stamp) of the set; NaN where there is none."""

SETS_TO_PROVE = 6
"""Fewest sets from which a difference can be significant. Where chance decides, n draws are all better or all worse in
2 / 2^n of the cases: 6 % of five draws, 3 % of six."""

_LEAST_SETS = 2


@dataclass(frozen=True)
class Difference:
    """One metric of two results over the same sets."""

    first: float
    second: float
    difference: float
    """second - first."""
    low: float
    """Lower end of the difference's bootstrap interval; the difference is significant when 0 is outside."""
    high: float
    """Upper end."""


@dataclass(frozen=True)
class Comparison:
    """Comparison of two results."""

    differences: dict[str, Difference]
    """By the names of what was compared: `METRIC_NAMES`."""
    sets: int
    """Surround sets that both results have."""
    measured: int
    """Sets among them for which both results have a number."""
    only_in_first: int
    only_in_second: int
    level: float
    resamples: int
    block: int
    """Consecutive sets that were drawn together."""
    seed: int

    @property
    def can_prove(self) -> bool:
        """Whether there are enough sets for the intervals to have their nominal level."""
        return self.measured >= SETS_TO_PROVE


def compare(
    first: Scores,
    second: Scores,
    *,
    scaling: Scaling = "metric",
    group: str = ALL,
    level: float = 0.95,
    resamples: int = 2000,
    block: int = 10,
    seed: int = 0,
) -> Comparison:
    """Compare the metrics (per image, mean over images, then cameras) over the sets that both results have.

    Sets are resampled with replacement, the same for both results. Consecutive sets look alike, so blocks of `block`
    consecutive ones (a second at 10 Hz) are drawn at once (circular block bootstrap, Politis and Romano 1992): single
    sets would give intervals far too narrow. Blocks are shortened to a sixth of the sets where there are few.
    Raises ConfigError when the settings or the cameras differ, or fewer than two sets are common.
    """
    if first.settings != second.settings:
        raise ConfigError(f"comparison: {first.settings} and {second.settings} cannot be compared")
    if sorted(first.cameras) != sorted(second.cameras):
        raise ConfigError(f"comparison: cameras {first.cameras} and {second.cameras} differ")
    before, after = (set_metrics(scores, first.cameras, scaling, group) for scores in (first, second))
    return compare_values(before, after, METRIC_NAMES, level=level, resamples=resamples, block=block, seed=seed)


def compare_values(
    first: SetValues,
    second: SetValues,
    names: Sequence[str],
    *,
    level: float = 0.95,
    resamples: int = 2000,
    block: int = 10,
    seed: int = 0,
) -> Comparison:
    """Compare numbers of any kind, called `names`, over the sets that both have; see `compare`.

    Raises ConfigError when fewer than two sets are common.
    """
    common = sorted(first.keys() & second.keys())
    if len(common) < _LEAST_SETS:
        raise ConfigError(f"comparison: {len(common)} sets in common, want {_LEAST_SETS} or more")
    block = max(1, min(block, len(common) // SETS_TO_PROVE))
    paired = np.stack([np.stack([values[key] for key in common]) for values in (first, second)])
    counts = _resampled_counts(len(common), block, resamples, seed)
    return Comparison(
        differences=_differences(paired, counts, level, names),
        sets=len(common),
        measured=int((~np.isnan(paired)).any(axis=(2, 3)).all(axis=0).sum()),
        only_in_first=len(first) - len(common),
        only_in_second=len(second) - len(common),
        level=level,
        resamples=resamples,
        block=block,
        seed=seed,
    )


def set_metrics(scores: Scores, cameras: Sequence[str], scaling: Scaling = "metric", group: str = ALL) -> SetValues:
    """Return each set's metrics [N, 7] by (recording, stamp), in the order of `cameras`; NaN without truth."""
    column = scores.settings.groups.index(group)
    found: SetValues = {}
    for table in scores.images:
        own = [metrics_of(table.of_camera(camera, scaling)[:, column]) for camera in cameras]
        missing = np.full((len(table), len(METRIC_NAMES)), np.nan)
        values = np.stack([metrics if len(metrics) else missing for metrics in own], axis=1)
        found |= {(table.recording, stamp): values[i] for i, stamp in enumerate(table.stamps_ns.tolist())}
    return found


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float:
    """Return Spearman's correlation of two series [n], over the places where both are known; NaN where undefined."""
    pairs = np.array([first, second], dtype=np.float64)
    pairs = pairs[:, ~np.isnan(pairs).any(axis=0)]
    ranks = np.stack([_ranks(series) for series in pairs])
    spread = ranks - ranks.mean(axis=1, keepdims=True) if ranks.size else ranks
    norm = float(np.sqrt((spread**2).sum(axis=1).prod()))
    return float(spread[0] @ spread[1]) / norm if norm > 0 else float("nan")


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ranks [n] from 0; equal values share the mean of their ranks."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    shared = np.cumsum(counts) - (counts + 1) / 2
    ranks: NDArray[np.float64] = shared[place]
    return ranks


def _resampled_counts(sets: int, block: int, resamples: int, seed: int) -> NDArray[np.float64]:
    """Return how often each set is drawn [resamples, sets]."""
    rng = np.random.default_rng(seed)
    starts = rng.integers(0, sets, size=(resamples, -(-sets // block), 1))
    drawn = ((starts + np.arange(block)) % sets).reshape(resamples, -1)[:, :sets]
    return np.stack([np.bincount(sample, minlength=sets) for sample in drawn]).astype(np.float64)


def _differences(
    paired: NDArray[np.float64], counts: NDArray[np.float64], level: float, names: Sequence[str]
) -> dict[str, Difference]:
    """Return the differences of `paired` [2, sets, N, M], with intervals over resampled `counts` [resamples, sets]."""
    first, second = (_weighted_means(values, np.ones((1, len(values))))[0] for values in paired)
    resampled = _weighted_means(paired[1], counts) - _weighted_means(paired[0], counts)
    low, high = np.nanquantile(resampled, [(1 - level) / 2, (1 + level) / 2], axis=0)
    columns = zip(first, second, second - first, low, high, strict=True)
    return {name: Difference(*map(float, row)) for name, row in zip(names, columns, strict=True)}


def _weighted_means(values: NDArray[np.float64], counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return means [R, M] of `values` [sets, N, M]: over the sets, each `counts` [R, sets] times, then the cameras."""
    flat = values.reshape(len(values), -1)
    known = ~np.isnan(flat)
    weights = counts @ known
    with np.errstate(invalid="ignore"):
        per_camera = (counts @ np.where(known, flat, 0.0) / weights).reshape(len(counts), *values.shape[1:])
    measured = ~np.isnan(per_camera)
    with np.errstate(invalid="ignore"):
        means: NDArray[np.float64] = np.where(measured, per_camera, 0.0).sum(axis=1) / measured.sum(axis=1)
    return means
