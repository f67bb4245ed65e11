# SPDX-License-Identifier: Apache-2.0
"""`report.html` of an evaluation: tables, diagrams, and the best, the median and the worst set."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cvcdepth_core.files import write_atomically
from cvcdepth_core.scoring.consistency import summarise_agreement
from cvcdepth_core.scoring.metrics import METRIC_NAMES
from cvcdepth_core.scoring.scores import SCALINGS, Score
from cvcdepth_core.visualization import DepthScale
from cvcdepth_ros.evaluation.image_scores import SetScore, correlations
from cvcdepth_ros.evaluation.job import EvaluationJob
from cvcdepth_ros.evaluation.measuring import Remeasuring
from cvcdepth_ros.evaluation.references import reference_titles
from cvcdepth_ros.evaluation.result import PROTOCOLS, EvaluationResult
from cvcdepth_ros.reports import evaluation_figures as figures
from cvcdepth_ros.reports.evaluation_pictures import GREATEST_ERROR, error_colours
from cvcdepth_ros.reports.shown_sets import ShownSet, chosen_sets, drawn_again, shown_set
from cvcdepth_ros.reports.style import render_page

_LEGEND_STEPS = 24
_METRIC_TITLES = dict(
    zip(METRIC_NAMES, ("Abs Rel", "Sq Rel", "RMSE", "RMSE log", "δ < 1.25", "δ < 1.25²", "δ < 1.25³"), strict=True)
)
_LABEL_FREE_TITLES = {
    "spatial": "disagreement between cameras",
    "temporal": "disagreement along the way",
    "spatial_photometric": "photometric error between cameras",
    "temporal_photometric": "photometric error along the way",
}


def write_report(path: Path, result: EvaluationResult, jobs: Mapping[str, EvaluationJob]) -> None:
    """Write the page; the jobs, by recording, are there to measure the sets again that it shows."""
    chosen = chosen_sets(result.sets)
    with Remeasuring() as again:
        shown = [_shown(title, score, result, jobs[score.recording], again) for title, score in chosen]
    write_atomically(path, render(result, shown).encode())


def render(result: EvaluationResult, shown: Sequence[ShownSet]) -> str:
    """Return the page as HTML."""
    content = {
        "result": result,
        "shown": shown,
        "lidar_set": _with_most_tiles(shown),
        "metric_titles": _METRIC_TITLES,
        "label_free_titles": _LABEL_FREE_TITLES,
        "reference_titles": reference_titles(result.configuration),
        "score_tables": _score_tables(result),
        "groups": _group_titles(result),
        "agreement": summarise_agreement(result.agreement),
        "correlations": correlations(result.sets),
        "obstacles": result.obstacles.to_json() if result.obstacles else None,
        "figures": _figures(result),
        "error_legend": _error_legend(),
        "depth_legend": _depth_legend(result),
        "configuration": json.dumps(result.configuration, indent=2),
    }
    return render_page("evaluation.html", content)


def _shown(title: str, score: SetScore, result: EvaluationResult, job: EvaluationJob, again: Remeasuring) -> ShownSet:
    return shown_set(title, [score], lambda: [drawn_again(title, score, result, job, again)])


def _with_most_tiles(shown: Sequence[ShownSet]) -> ShownSet | None:
    """Return the set whose LiDAR is shown in the cameras: the one in the middle that has any."""
    found = [one for one in shown if one.pictures and one.pictures[0].lidar]
    return found[len(found) // 2] if found else None


def _score_tables(result: EvaluationResult) -> list[tuple[str, dict[str, Score], dict[str, dict[str, Score]]]]:
    """Return title, means and scores by camera for both protocols and scalings."""
    titles = {
        ("image", "metric"): "Per image, as predicted",
        ("image", "median"): "Per image, median-scaled",
        ("pool", "metric"): f"Pools of {result.scores.settings.pool} images, as predicted",
        ("pool", "median"): f"Pools of {result.scores.settings.pool} images, median-scaled",
    }
    summaries = {(p, s): result.summary(p, s) for p in PROTOCOLS for s in SCALINGS}
    return [(titles[key], found.mean, found.cameras) for key, found in summaries.items()]


def _group_titles(result: EvaluationResult) -> dict[str, str]:
    ranges = {name: f"{name} m" for name in result.scores.settings.range_names}
    return {"all": "all", **ranges, "overlap": "where cameras overlap"}


def _figures(result: EvaluationResult) -> dict[str, bytes]:
    """Return the diagrams that have anything to show, as PNG."""
    series = {"series": figures.time_series(result.sets)}
    if result.obstacles is not None and len(result.obstacles.told_thresholds) > 1:
        series["obstacles"] = figures.obstacles_by_confidence(result.obstacles)
    if not result.truth_points:
        return series
    if result.confidence is not None:
        series["calibration"] = figures.calibration_curve(result.confidence.calibration)
    return series | {
        "ranges": figures.error_by_range(result),
        "cameras": figures.error_by_camera(result),
        "scatter": figures.label_free_against_error(result.sets),
    }


def _error_legend() -> dict[str, Any]:
    errors = np.linspace(-GREATEST_ERROR, GREATEST_ERROR, _LEGEND_STEPS)
    ticks = [f"{share:+.0%}" if share else "0" for share in np.linspace(-GREATEST_ERROR, GREATEST_ERROR, 5)]
    return {"colours": _css(error_colours(errors)), "ticks": ticks}


def _depth_legend(result: EvaluationResult) -> dict[str, Any]:
    scale = DepthScale(far=result.scores.settings.max_depth)
    depths = scale.near * (scale.far / scale.near) ** np.linspace(0.0, 1.0, _LEGEND_STEPS)
    ticks = scale.near * (scale.far / scale.near) ** np.linspace(0.0, 1.0, 5)
    return {"colours": _css(scale.colours(depths.astype(np.float32))), "ticks": [f"{tick:.2g} m" for tick in ticks]}


def _css(colours: np.ndarray) -> str:
    return ", ".join("rgb({}, {}, {})".format(*colour) for colour in colours.tolist())
