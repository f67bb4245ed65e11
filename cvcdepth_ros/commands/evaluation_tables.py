# SPDX-License-Identifier: Apache-2.0
"""The result of an evaluation as text for a terminal of 80 columns."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cvcdepth_core.scoring.scores import ALL
from cvcdepth_ros.console import paragraph, shortened, table
from cvcdepth_ros.evaluation.image_scores import LabelFree, label_free_by_camera, mean_label_free
from cvcdepth_ros.evaluation.references import BEST_CONSTANT, reference_titles

if TYPE_CHECKING:
    from cvcdepth_core.scoring.confidence_scores import ConfidenceScores
    from cvcdepth_core.scoring.obstacles import ObstacleScores
    from cvcdepth_core.scoring.scores import Score
    from cvcdepth_ros.evaluation.measuring import RecordingScores
    from cvcdepth_ros.evaluation.result import EvaluationResult

_SCORE_COLUMNS = ("abs_rel", "scaled", "scale", "rmse", "delta_1", "coverage", "truth")
_LABEL_FREE_COLUMNS = ("between cameras", "along the way", "photo between", "photo along")
_OBSTACLE_COLUMNS = ("recall", "precision", "squares", "predicted", "driven places", "said taken")
_CONFIDENCE_COLUMNS = ("abs_rel", "surest half", "ause", "aurg")
_NAME_WIDTH = 20

_SCALED = (
    "scaled: abs_rel after scaling each image by median(truth) / median(prediction). best constant: for each image the "
    "depth with the least abs_rel, which only the truth tells."
)
_CONFIDENCE = (
    "surest half: abs_rel of the half of the pixels with the largest confidence. ause: area above an oracle that "
    "removes the worst pixels first, 0 is perfect; aurg: area won over removal at random; both over abs_rel."
)
_OBSTACLES = (
    "Obstacles: squares of 0.5 m that are taken between 0.3 and 2 m above the ground, within so many metres of the "
    "vehicle. driven places: where the vehicle came to later, which must have been free."
)
_LABEL_FREE = (
    "No truth, so these are label-free scores, lower is better: by how much a point's depth differs between "
    "neighbouring cameras and from set to set (medians), and how ill it explains the other pictures (photometric). "
    "Flat ground that ignores every car agrees with itself: a model is to beat it in the photometric columns."
)


def evaluation_text(result: EvaluationResult, folder: Path) -> str:
    """Return one model's result: a line for each camera, recording and reference, and what was told of the model."""
    has_truth = bool(result.truth_points)
    blocks = [_score_table(result) if has_truth else _label_free_table(result)]
    if len(result.recordings) > 1:
        blocks.append(_recordings_table(result, has_truth))
    if result.confidence is not None and has_truth:
        blocks.append(_confidence_table(result.confidence))
    if result.obstacles is not None and (result.obstacles.counts.any() or result.obstacles.driven.any()):
        blocks.append(_obstacle_table(result.obstacles))
    return "\n\n".join(filter(None, [*blocks, "\n".join(_lines(result, folder))]))


def _lines(result: EvaluationResult, folder: Path) -> Iterator[str]:
    yield from (f"not evaluated: {failure.reason}" for failure in result.failed)
    yield from dict.fromkeys(found.summary["ground"]["told"] for found in result.recordings)
    reasons = {found.summary["no_flat_ground"]: None for found in result.recordings if found.summary["no_flat_ground"]}
    yield from (f"no flat ground to compare with: {reason}; see --ground-height" for reason in reasons)
    for seen in result.trained_on:
        yield paragraph(
            f"{seen.recording}: the model was trained on {seen.sets} of these {seen.scored} sets ({seen.trained_as}): "
            "its scores here do not tell how good it is elsewhere"
        )
    if result.pose_score is not None:
        yield f"pose network: {result.pose_score.describe()}"
    recordings = f"{len(result.recordings)} recording{'' if len(result.recordings) == 1 else 's'}"
    yield f"{len(result.sets)} sets of {recordings}, {result.truth_points} truth points"
    yield f"{folder}, of {result.model.id}"


def _score_table(result: EvaluationResult) -> str:
    summary, scaled = result.summary(), result.summary(scaling="median")
    ratios = result.scores.scale_ratios()
    groups = [(group, summary.mean[group], scaled.mean[group], "") for group in result.scores.settings.groups]
    cameras = [
        (name, found[ALL], scaled.cameras[name][ALL], f"{ratios[name]:.2f}") for name, found in summary.cameras.items()
    ]
    titles = reference_titles(result.configuration)
    references = [
        (titles[name], found.scores["metric"], found.scores["median"], "") for name, found in result.references.items()
    ]
    rows = [_score_row(*row) for row in (*cameras, *groups, *references)]
    return f"{_numbers('', _SCORE_COLUMNS, rows)}\n\n{paragraph(_SCALED)}"


def _confidence_table(confidence: ConfidenceScores) -> str:
    found = {**confidence.cameras, ALL: confidence.mean}
    rows = [(shortened(name, _NAME_WIDTH), *map(_number, numbers)) for name, numbers in found.items()]
    off = f"Calibration: confidence is off by {_number(confidence.calibration.expected_error)} on average."
    return f"{_numbers('confidence', _CONFIDENCE_COLUMNS, rows)}\n\n{paragraph(f'{_CONFIDENCE} {off}')}"


def _obstacle_table(obstacles: ObstacleScores) -> str:
    found = obstacles.to_json()
    rows = []
    for metres, within in found["within"].items():
        shares = [_number(math.nan if within[name] is None else within[name]) for name in ("recall", "precision")]
        taken = within["driven_places_taken"]
        numbers = (str(within["truth"]), str(within["predicted"]), str(within["driven_places"]))
        rows.append((f"within {metres} m", *shares, *numbers, "-" if taken is None else f"{taken:.1%}"))
    blocks = [_numbers("obstacles", _OBSTACLE_COLUMNS, rows), "", paragraph(_OBSTACLES)]
    nearest = found["nearest"]
    if nearest["median_error"] is not None:
        blocks.append(
            paragraph(
                f"Nearest obstacle within 20 m, by directions of 5 degrees: off by {nearest['median_error']:.2f} m "
                f"(median of {nearest['both']}), {nearest['missed']} missed, {nearest['invented']} invented."
            )
        )
    return "\n".join(blocks)


def _label_free_table(result: EvaluationResult) -> str:
    cameras = result.label_free
    titles = reference_titles(result.configuration)
    references = {titles[n]: found.label_free for n, found in result.references.items() if n != BEST_CONSTANT}
    found = {**cameras, ALL: mean_label_free(cameras.values()), **references}
    rows = [_label_free_row(name, numbers) for name, numbers in found.items()]
    return f"{_numbers('', _LABEL_FREE_COLUMNS, rows)}\n\n{paragraph(_LABEL_FREE)}"


def _recordings_table(result: EvaluationResult, has_truth: bool) -> str:
    """Return a line for each recording; where they have several rigs, with the rig's number."""
    rigs = list(dict.fromkeys(tuple(found.summary["cameras"]) for found in result.recordings))
    row = _recording_scores if has_truth else _recording_label_free
    columns = _SCORE_COLUMNS if has_truth else _LABEL_FREE_COLUMNS
    rows = []
    for found in result.recordings:
        rig = f"{rigs.index(tuple(found.summary['cameras'])) + 1}: " if len(rigs) > 1 else ""
        name, *numbers = row(f"{rig}{found.name}", found)
        rows.append((name, *numbers))
    told = [f"rig {i}: {', '.join(cameras)}" for i, cameras in enumerate(rigs, 1)] if len(rigs) > 1 else []
    return "\n".join([_numbers("recording", columns, rows), *told])


def _recording_scores(name: str, found: RecordingScores) -> tuple[str, ...]:
    metric, median = (found.scores.summary("image", scaling).mean[ALL] for scaling in ("metric", "median"))
    ratios = [math.log(ratio) for ratio in found.scores.scale_ratios().values() if not math.isnan(ratio)]
    ratio = f"{math.exp(sum(ratios) / len(ratios)):.2f}" if ratios else ""
    return _score_row(name, metric, median, ratio)


def _recording_label_free(name: str, found: RecordingScores) -> tuple[str, ...]:
    return _label_free_row(name, mean_label_free(label_free_by_camera(found.scores, [found.agreement]).values()))


def _numbers(first: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return table((first, *columns), rows, numbers=range(1, len(columns) + 1))


def _score_row(name: str, score: Score, scaled: Score, ratio: str) -> tuple[str, ...]:
    errors = (score.metrics["abs_rel"], scaled.metrics["abs_rel"])
    others = (score.metrics["rmse"], score.metrics["delta_1"], score.coverage)
    numbers = (*map(_number, errors), ratio, *map(_number, others))
    return (shortened(name, _NAME_WIDTH), *numbers, str(score.truth))


def _label_free_row(name: str, found: LabelFree) -> tuple[str, ...]:
    return (shortened(name, _NAME_WIDTH), *map(_number, found))


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"
