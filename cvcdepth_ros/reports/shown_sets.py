# SPDX-License-Identifier: Apache-2.0
"""The sets that a page shows: which ones, and their pictures, for which they are measured once more."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_ros.evaluation.image_scores import SetScore
from cvcdepth_ros.evaluation.job import EvaluationJob
from cvcdepth_ros.evaluation.measuring import Remeasuring
from cvcdepth_ros.evaluation.result import EvaluationResult
from cvcdepth_ros.reports.evaluation_pictures import SetPictures, draw_set


class ShownSet(NamedTuple):
    """A set that a page shows, as one network or several, one after the other, see it."""

    title: str
    scores: Sequence[SetScore]
    """Of each network."""
    pictures: Sequence[SetPictures]
    """Of each network; empty where there are none."""
    problem: str
    """Why there are no pictures."""


def chosen_sets(sets: Sequence[SetScore]) -> list[tuple[str, SetScore]]:
    """Return the best, the median and the worst set, each once; nothing where no set has any score.

    Where some sets have truth, it is they that are ranked: an error and a disagreement cannot be compared.
    """
    with_truth = [found for found in sets if not math.isnan(found.abs_rel)]
    ranked = sorted((f for f in with_truth or sets if not math.isnan(f.rank)), key=lambda found: found.rank)
    places = {"Best set": 0, "Median set": (len(ranked) - 1) // 2, "Worst set": len(ranked) - 1}
    by_place = {place: title for title, place in places.items()}
    return [(title, ranked[place]) for place, title in sorted(by_place.items()) if 0 <= place < len(ranked)]


def shown_set(title: str, scores: Sequence[SetScore], draw: Callable[[], Sequence[SetPictures]]) -> ShownSet:
    """Return the set with the pictures that `draw` returns, or with what that raises of the family as the problem."""
    try:
        return ShownSet(title, scores, draw(), "")
    except (CvcDepthError, OSError) as error:
        return ShownSet(title, scores, [], str(error))


def drawn_again(
    title: str, score: SetScore, result: EvaluationResult, job: EvaluationJob, again: Remeasuring
) -> SetPictures:
    """Measure a set of a result once more, for its pictures; the errors of the family say why that is not possible."""
    recording = next(found for found in result.recordings if found.name == score.recording)
    measured = again.measured_set(job, score.stamp_ns, int(recording.log_times[score.number]))
    return draw_set(measured, f"{title}: {score.recording}", job.settings.max_depth)
