# SPDX-License-Identifier: Apache-2.0
"""`report.html` of a run: the verdict, the scores and depth before and after, learning curves, masks, the data."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jinja2

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.training.run_folder import LOG_FILE
from cvcdepth_ros.evaluation.image_scores import SetScore
from cvcdepth_ros.evaluation.job import EvaluationJob
from cvcdepth_ros.evaluation.result import EvaluationResult
from cvcdepth_ros.finetuning.card import SCORE_TITLES
from cvcdepth_ros.finetuning.run import START_FILE, FineTuned
from cvcdepth_ros.reports.evaluation_page import chosen_sets, drawn_again, to_data_url, to_number
from cvcdepth_ros.reports.evaluation_pictures import SetPictures
from cvcdepth_ros.reports.learning_curves import RunLog, held_out_curves, loss_curves

_MASK_WIDTH = 480


class ShownSet(NamedTuple):
    """A held-out set, before and after."""

    title: str
    before: SetScore
    after: SetScore
    pictures: tuple[SetPictures, SetPictures] | None
    problem: str
    """Why there are no pictures."""


def write_report(path: Path, tuned: FineTuned, card: Mapping[str, Any]) -> None:
    """Write the page."""
    log = RunLog.read(tuned.order.run / LOG_FILE)
    write_atomically(path, render(card, _shown_sets(tuned), log, _masks(tuned)).encode())


def render(card: Mapping[str, Any], shown: Sequence[ShownSet], log: RunLog, masks: Mapping[str, bytes]) -> str:
    """Return the page; whatever comes from files is escaped by the template engine. `masks` are PNGs by name."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(__package__), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    environment.filters |= {"number": _number, "data_url": to_data_url}
    return environment.get_template("run.html").render(
        card=card,
        shown=shown,
        masks=masks,
        score_titles=SCORE_TITLES,
        curves=loss_curves(log) if log.steps else None,
        held_out=held_out_curves(log) if log.validations else None,
        configuration=json.dumps(card["configuration"], indent=2),
    )


def _shown_sets(tuned: FineTuned) -> list[ShownSet]:
    """Return the sets that are best, median and worst afterwards."""
    if tuned.before is None or tuned.after is None:
        return []
    earlier = {(found.recording, found.stamp_ns): found for found in tuned.before.sets}
    jobs = {part.job.name: part.job for part in tuned.parts}
    return [
        _shown(title, earlier[after.recording, after.stamp_ns], after, tuned, jobs[after.recording])
        for title, after in chosen_sets(tuned.after.sets)
        if (after.recording, after.stamp_ns) in earlier
    ]


def _shown(title: str, before: SetScore, after: SetScore, tuned: FineTuned, job: EvaluationJob) -> ShownSet:
    try:
        results = (
            ("before", tuned.order.run / START_FILE, tuned.before, before),
            ("after", tuned.weights, tuned.after, after),
        )
        drawn = [
            _drawn(f"{title}, {when}", job, weights, result, set_) for when, weights, result, set_ in results if result
        ]
    except (CvcDepthError, OSError) as error:
        return ShownSet(title, before, after, None, str(error))
    return ShownSet(title, before, after, (drawn[0], drawn[1]), "")


def _drawn(title: str, job: EvaluationJob, weights: Path, result: EvaluationResult, score: SetScore) -> SetPictures:
    settings = job.settings.model_copy(update={"checkpoint": str(weights)})
    return drawn_again(title, score, result, replace(job, settings=settings))


def _masks(tuned: FineTuned) -> dict[str, bytes]:
    """Return the masks that were found, small."""
    found = {}
    for name, path in tuned.prepared.found_masks.items():
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if mask is not None:
            height = round(_MASK_WIDTH * mask.shape[0] / mask.shape[1])
            small = cv2.resize(mask, (_MASK_WIDTH, height), interpolation=cv2.INTER_AREA)
            found[name] = cv2.imencode(".png", small)[1].tobytes()
    return found


def _number(value: float | None, digits: int = 3) -> str:
    return to_number(float("nan") if value is None else value, digits)
