# SPDX-License-Identifier: Apache-2.0
"""When a lasting problem is told, told again, and told to be over."""

from cvcdepth_ros.live.standing_problems import Notice, Problem, StandingProblems


class Told:
    """Problems on a clock of their own, asked about four times a second as the node does."""

    def __init__(self) -> None:
        self.now = 0.0
        self._problems = StandingProblems(repeat=30.0, clock=lambda: self.now)

    def during(self, seconds: float, **found: Problem) -> list[tuple[float, Notice]]:
        """Return what is told while these problems last, and when."""
        told = []
        end = self.now + seconds
        while self.now < end:
            told += [(self.now, notice) for notice in self._problems.update(found)]
            self.now += 0.25
        return told


def test_what_passes_by_itself_is_not_told():
    told = Told()
    assert told.during(2.5, sets=Problem("too old")) == []
    assert told.during(10.0) == []


def test_what_lasts_is_told_once_then_slowly_again_and_its_end_once():
    told = Told()
    lasting = told.during(100.0, sets=Problem("too old"))
    assert [when for when, _ in lasting] == [3.0, 33.0, 63.0, 93.0]
    assert lasting[0][1] == Notice("sets: too old (for 3 s now)", is_over=False)
    assert lasting[1][1].text == "sets: too old (for 33 s now)"
    assert [notice for _, notice in told.during(100.0)] == [Notice("sets: mended after 100 s", is_over=True)]


def test_another_reason_for_the_same_problem_is_not_a_new_one():
    told = Told()
    assert len(told.during(4.0, sets=Problem("by 1 s"))) == 1
    assert told.during(20.0, sets=Problem("by 2 s")) == []
    ((_, notice),) = told.during(10.0, sets=Problem("by 3 s"))
    assert "by 3 s" in notice.text


def test_each_subject_has_its_own_patience_and_may_leave_its_end_to_others():
    told = Told()
    found = told.during(12.0, left=Problem("stale", patience=10.0, is_end_told=False), sets=Problem("none"))
    assert [(when, notice.text.partition(":")[0]) for when, notice in found] == [(3.0, "sets"), (10.0, "left")]
    assert [notice.text.partition(":")[0] for _, notice in told.during(1.0)] == ["sets"]
