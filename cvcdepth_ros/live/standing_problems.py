# SPDX-License-Identifier: Apache-2.0
"""Problems that last: when to tell of each in the log, so that it is heard and does not drown the rest. No ROS here."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

PATIENCE_SECONDS = 3.0
"""How long a problem lasts before it is told: what passes by itself, as at a start, is none."""
REPEAT_SECONDS = 30.0


class Problem(NamedTuple):
    """What is wrong now, and what helps."""

    text: str
    patience: float = PATIENCE_SECONDS
    """Seconds that it lasts before it is told."""
    is_end_told: bool = True
    """Whether its end is to be told here; somebody else may do that."""


class Notice(NamedTuple):
    """One line for the log."""

    text: str
    is_over: bool
    """Whether it tells of a problem's end."""


@dataclass
class _Standing:
    """A problem that is there."""

    problem: Problem
    since: float
    told_at: float | None = None


class StandingProblems:
    """Tells of each subject's problem once it lasts, then again at long intervals, and of its end."""

    def __init__(self, repeat: float = REPEAT_SECONDS, clock: Callable[[], float] = time.monotonic) -> None:
        """Tell of what lasts every `repeat` seconds."""
        self._repeat = repeat
        self._clock = clock
        self._standing: dict[str, _Standing] = {}

    def update(self, found: Mapping[str, Problem]) -> list[Notice]:
        """Take the problems that there are now, by subject, and return what is to be told of them.

        The text of a problem may change while it lasts: it is the same one as long as its subject has any.
        """
        now = self._clock()
        notices = [self._end(subject, now) for subject in self._standing.keys() - found.keys()]
        for subject, problem in found.items():
            standing = self._standing.setdefault(subject, _Standing(problem, now))
            standing.problem = problem
            notices.append(self._reminder(subject, standing, now))
        return [notice for notice in notices if notice is not None]

    def _end(self, subject: str, now: float) -> Notice | None:
        ended = self._standing.pop(subject)
        if ended.told_at is None or not ended.problem.is_end_told:
            return None
        return Notice(f"{subject}: mended after {now - ended.since:.0f} s", is_over=True)

    def _reminder(self, subject: str, standing: _Standing, now: float) -> Notice | None:
        lasted = now - standing.since
        if standing.told_at is None:
            is_due = lasted >= standing.problem.patience
        else:
            is_due = now - standing.told_at >= self._repeat
        if not is_due:
            return None
        standing.told_at = now
        return Notice(f"{subject}: {standing.problem.text} (for {lasted:.0f} s now)", is_over=False)
