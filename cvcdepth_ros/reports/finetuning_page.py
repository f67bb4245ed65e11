# SPDX-License-Identifier: Apache-2.0
"""`report.html` of a run: the verdict, the scores and depth before and after, learning curves, masks, the data."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from cvcdepth_core.files import write_atomically
from cvcdepth_core.training.run_folder import LOG_FILE
from cvcdepth_ros.evaluation.image_scores import SetScore
from cvcdepth_ros.evaluation.job import EvaluationJob
from cvcdepth_ros.evaluation.measuring import Remeasuring
from cvcdepth_ros.evaluation.result import EvaluationResult
from cvcdepth_ros.finetuning.card import SCORE_TITLES, pose_lines
from cvcdepth_ros.finetuning.run import START_FILE, FinetuneResult
from cvcdepth_ros.reports.evaluation_pictures import SetPictures
from cvcdepth_ros.reports.learning_curves import RunLog, held_out_curves, loss_curves
from cvcdepth_ros.reports.shown_sets import ShownSet, chosen_sets, drawn_again, shown_set
from cvcdepth_ros.reports.style import render_page, to_png

_MASK_WIDTH = 480


def write_report(path: Path, result: FinetuneResult, card: Mapping[str, Any]) -> None:
    """Write the page."""
    log = RunLog.read(result.job.run / LOG_FILE)
    write_atomically(path, render(card, _shown_sets(result), log, _masks(result)).encode())


def render(card: Mapping[str, Any], shown: Sequence[ShownSet], log: RunLog, masks: Mapping[str, bytes]) -> str:
    """Return the page as HTML; `masks` are PNG files by name."""
    content = {
        "card": card,
        "shown": shown,
        "masks": masks,
        "score_titles": SCORE_TITLES,
        "pose_lines": list(filter(None, pose_lines(card["scores"]))),
        "curves": to_png(loss_curves(log)) if log.steps else None,
        "held_out": to_png(held_out_curves(log)) if log.validations else None,
        "configuration": json.dumps(card["configuration"], indent=2),
    }
    return render_page("finetuning.html", content)


def _shown_sets(result: FinetuneResult) -> list[ShownSet]:
    """Return the sets that are best, median and worst afterwards, as the start and the new weights see them."""
    before, after = result.before, result.after
    if before is None or after is None:
        return []
    earlier = {(found.recording, found.stamp_ns): found for found in before.sets}
    jobs = {part.job.name: part.job for part in result.parts}
    with Remeasuring() as start, Remeasuring() as end:
        networks = (
            _Network("before", result.job.run / START_FILE, before, start),
            _Network("after", result.weights, after, end),
        )
        return [
            _shown(title, [earlier[score.recording, score.stamp_ns], score], jobs[score.recording], networks)
            for title, score in chosen_sets(after.sets)
            if (score.recording, score.stamp_ns) in earlier
        ]


class _Network(NamedTuple):
    """The network before or after."""

    when: str
    weights: Path
    result: EvaluationResult
    again: Remeasuring
    """What measures with it, kept open from set to set."""

    def drawn(self, title: str, job: EvaluationJob, score: SetScore) -> SetPictures:
        """Draw a set as it sees it."""
        settings = job.settings.model_copy(update={"checkpoint": str(self.weights)})
        with_it = replace(job, settings=settings)
        return drawn_again(f"{title}, {self.when}", score, self.result, with_it, self.again)


def _shown(title: str, scores: Sequence[SetScore], job: EvaluationJob, networks: Sequence[_Network]) -> ShownSet:
    def draw() -> list[SetPictures]:
        return [network.drawn(title, job, score) for network, score in zip(networks, scores, strict=True)]

    return shown_set(title, scores, draw)


def _masks(result: FinetuneResult) -> dict[str, bytes]:
    """Return the masks that were found, small."""
    found = {}
    for name, path in result.prepared.found_masks.items():
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if mask is not None:
            height = round(_MASK_WIDTH * mask.shape[0] / mask.shape[1])
            small = cv2.resize(mask, (_MASK_WIDTH, height), interpolation=cv2.INTER_AREA)
            found[name] = cv2.imencode(".png", small)[1].tobytes()
    return found
