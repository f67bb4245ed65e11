# SPDX-License-Identifier: Apache-2.0
"""The diagrams of an evaluation, as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from cvcdepth_core.scoring.confidence import CalibrationTable
from cvcdepth_core.scoring.obstacles import RANGES, THRESHOLDS, ObstacleScores
from cvcdepth_core.scoring.scores import ALL, OVERLAP, Score
from cvcdepth_ros.evaluation.image_scores import SetScore
from cvcdepth_ros.evaluation.result import EvaluationResult
from cvcdepth_ros.reports.style import BLUE, GREEN, LINES, RED, TEXT, YELLOW, add_legend, add_title, dark_figure, to_png

_NAMED_RECORDINGS = 12


def error_by_range(result: EvaluationResult) -> bytes:
    """Draw Abs Rel by range of the true depth."""
    groups = [ALL, *result.scores.settings.range_names, OVERLAP]
    labels = ["all", *(f"{name} m" for name in result.scores.settings.range_names), "overlaps"]
    means = [result.summary(scaling=scaling).mean for scaling in ("metric", "median")]
    return _paired_bars("Abs Rel by range", labels, *([mean[group] for group in groups] for mean in means))


def error_by_camera(result: EvaluationResult) -> bytes:
    """Draw Abs Rel by camera."""
    cameras = [result.summary(scaling=scaling).cameras for scaling in ("metric", "median")]
    scores = [_of_all(found) for found in cameras]
    return _paired_bars("Abs Rel by camera", result.scores.cameras, *scores)


def time_series(sets: Sequence[SetScore]) -> bytes:
    """Draw Abs Rel and the label-free scores, set after set, recording after recording."""
    figure, (errors, disagreement) = dark_figure(13, 5.2, rows=2)
    numbers = np.arange(len(sets))
    starts = [i for i in range(len(sets)) if i == 0 or sets[i].recording != sets[i - 1].recording]
    _line(errors, numbers, starts, [s.abs_rel for s in sets], BLUE, "Abs Rel")
    _line(disagreement, numbers, starts, [s.label_free.spatial for s in sets], RED, "between cameras")
    _line(disagreement, numbers, starts, [s.label_free.temporal for s in sets], GREEN, "along the way")
    for axes, title in ((errors, "Abs Rel"), (disagreement, "median relative disagreement, label-free")):
        add_title(axes, title)
        axes.set_xlim(-0.5, max(len(sets) - 0.5, 0.5))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylim(0, 1.2 * axes.dataLim.ymax if axes.has_data() else 1)
        for start in starts[1:]:
            axes.axvline(start - 0.5, color=LINES)
    _name_recordings(errors, sets, starts)
    add_legend(disagreement)
    disagreement.set_xlabel("set", color=TEXT)
    return to_png(figure)


def label_free_against_error(sets: Sequence[SetScore]) -> bytes:
    """Draw each set's label-free scores against its Abs Rel."""
    figure, (axes,) = dark_figure(6.4, 3.4)
    for name, colour, label in (("spatial", RED, "between cameras"), ("temporal", GREEN, "along the way")):
        known = [s for s in sets if not np.isnan(s.abs_rel + getattr(s.label_free, name))]
        x, y = [getattr(s.label_free, name) for s in known], [s.abs_rel for s in known]
        axes.scatter(x, y, s=14, color=colour, label=label)
    add_title(axes, "Abs Rel over disagreement, a dot per set")
    axes.set_xlabel("median relative disagreement", color=TEXT)
    axes.set_ylabel("Abs Rel", color=TEXT)
    axes.margins(0.1)
    add_legend(axes)
    return to_png(figure)


def calibration_curve(table: CalibrationTable) -> bytes:
    """Draw how often depth is right over how sure it is said to be, and how many pixels that are."""
    figure, (axes,) = dark_figure(6.4, 3.4)
    edges = np.arange(len(table.pixels)) / len(table.pixels)
    shares = table.pixels / max(int(table.pixels.sum()), 1)
    axes.bar(edges + 0.05, shares, 0.09, color=LINES, label="share of the pixels")
    axes.plot([0, 1], [0, 1], color=TEXT, linewidth=0.8, linestyle="--", label="perfect")
    known = table.pixels > 0
    axes.plot(table.predicted[known], table.actual[known], color=BLUE, marker="o", label="right within 1.25")
    add_title(axes, "how often depth is right, by its confidence")
    axes.set_xlabel("confidence", color=TEXT)
    axes.set_ylim(0, 1.05)
    add_legend(axes)
    return to_png(figure)


def obstacles_by_confidence(obstacles: ObstacleScores) -> bytes:
    """Draw recall over precision of obstacles within each range, a point for each confidence that is asked for."""
    figure, (axes,) = dark_figure(6.4, 3.4)
    told = obstacles.told_thresholds
    recall, precision = obstacles.recall()[told], obstacles.precision()[told]
    for i, (metres, colour) in enumerate(zip(RANGES, (GREEN, YELLOW, BLUE), strict=True)):
        axes.plot(precision[:, i], recall[:, i], color=colour, marker="o", label=f"within {metres:g} m")
    for place, least in enumerate(np.array(THRESHOLDS)[told].tolist()):
        axes.annotate(f"{least:g}", (precision[place, -1], recall[place, -1]), color=TEXT, fontsize=7)
    add_title(axes, "obstacles: recall over precision, by least confidence")
    axes.set_xlabel("precision", color=TEXT)
    axes.set_ylabel("recall", color=TEXT)
    axes.set_xlim(0, 1.02)
    axes.set_ylim(0, 1.02)
    add_legend(axes)
    return to_png(figure)


def _paired_bars(title: str, labels: Sequence[str], predicted: Sequence[Score], scaled: Sequence[Score]) -> bytes:
    figure, (axes,) = dark_figure(6.4, 3.4)
    places = np.arange(len(labels))
    for shift, scores, colour, label in (
        (-0.2, predicted, BLUE, "as predicted"),
        (0.2, scaled, YELLOW, "median-scaled"),
    ):
        heights = [score.metrics["abs_rel"] for score in scores]
        bars = axes.bar(places + shift, heights, 0.38, color=colour, label=label)
        texts = ["" if np.isnan(height) else f"{height:.2f}" for height in heights]
        axes.bar_label(bars, texts, color=TEXT, fontsize=7, padding=1)
    axes.set_xticks(places, labels, rotation=20 if len(labels) > 4 else 0, ha="right" if len(labels) > 4 else "center")
    add_title(axes, title)
    axes.margins(y=0.15)
    add_legend(axes)
    return to_png(figure)


def _line(
    axes: Axes, numbers: np.ndarray, starts: Sequence[int], values: Sequence[float], colour: str, label: str
) -> None:
    """Draw a line that is broken between recordings."""
    x, y = np.insert(numbers.astype(float), starts, np.nan), np.insert(np.array(values, float), starts, np.nan)
    if not np.isnan(y).all():
        axes.plot(x, y, color=colour, label=label, linewidth=1.4, marker="." if len(values) < 200 else "")


def _name_recordings(axes: Axes, sets: Sequence[SetScore], starts: Sequence[int]) -> None:
    if len(starts) > _NAMED_RECORDINGS:
        return
    for start in starts:
        axes.annotate(
            sets[start].recording,
            (start - 0.4, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, -3),
            textcoords="offset points",
            va="top",
            color=TEXT,
            fontsize=7,
            parse_math=False,
        )


def _of_all(cameras: Mapping[str, Mapping[str, Score]]) -> list[Score]:
    return [scores[ALL] for scores in cameras.values()]
