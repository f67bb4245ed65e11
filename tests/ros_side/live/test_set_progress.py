# SPDX-License-Identifier: Apache-2.0
"""Why no set gets through: what is said of it, and of which camera. The synchroniser and the mailbox are real."""

from collections.abc import Mapping
from dataclasses import asdict

import pytest

from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.live.mailbox import Mailbox
from cvcdepth_ros.live.set_progress import NodeClock, SetProgress
from cvcdepth_ros.surround_sets.synchronizer import SurroundSynchronizer

CAMERAS = ("front", "left", "back")
YEAR = 365.25 * 86400
WALL, SIMULATED = NodeClock(False, has_publisher=False), NodeClock(True, has_publisher=True)


class Stream:
    """Three cameras at 10 Hz, matched, and read from a mailbox at once."""

    def __init__(self, tolerance: float = 0.05, min_cameras: int = 0, ros_time_ahead: float = 0.0) -> None:
        self.now = 1000.0
        self._synchroniser: SurroundSynchronizer[str] = SurroundSynchronizer(
            CAMERAS, "front", tolerance, min_cameras=min_cameras
        )
        self._mailbox: Mailbox[str] = Mailbox(0.5, lambda: round((self.now + ros_time_ahead) * NANOSECONDS))
        self._progress = SetProgress(self._synchroniser.required, tolerance, 0.5, lambda: self.now)
        self.passed = "skipped: no subscriber"

    def run(self, seconds: float, late: Mapping[str, float] | None = None, silent: tuple[str, ...] = ()) -> None:
        """Let the cameras send, some of them with stamps that are `late` seconds too great, and some not at all."""
        counts = {"published": 0, "skipped: no subscriber": 0, "skipped: rig not complete": 0}
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            for name in CAMERAS:
                if name not in silent:
                    stamp = round((self.now + (late or {}).get(name, 0.0)) * NANOSECONDS)
                    for found in self._synchroniser.add(name, stamp, name):
                        self._mailbox.put(found)
            counts[self.passed] += self._mailbox.get(timeout=0) is not None
            self._progress.update(self._synchroniser.statistics(), asdict(self._mailbox.statistics()) | counts)

    def problem(self, clock: NodeClock = WALL, **reasons: str) -> str:
        return self._progress.problem(reasons, clock, self._mailbox.stale_age)


def test_while_sets_get_through_there_is_none():
    stream = Stream()
    stream.run(10.0)
    assert stream.problem() == ""


def test_while_no_image_comes_there_is_none_either():
    stream = Stream()
    stream.run(10.0, silent=CAMERAS)
    assert stream.problem() == ""


def test_it_is_not_said_before_it_has_lasted_and_no_more_when_it_is_mended():
    stream = Stream()
    stream.run(1.0, late={"left": 3600.0})
    assert stream.problem() == ""
    stream.run(5.0, late={"left": 3600.0})
    assert stream.problem() != ""
    stream.run(3.0)
    assert stream.problem() == ""


@pytest.mark.parametrize(
    ("late", "told"),
    [
        ({"left": 3600.0 * 3}, "camera left's stamps are 3.0 hours ahead of the others'"),
        ({"back": -37.0}, "camera back's stamps are 37.0 s behind the others'"),
        ({"front": 2 * YEAR}, "camera front's stamps are 2.0 years ahead of the others'"),
    ],
)
def test_the_camera_with_a_wrong_clock_is_named_with_the_difference(late, told):
    stream = Stream()
    stream.run(8.0, late=late)
    assert stream.problem() == f"no set: {told}: set its clock, or stamp_offset in the rig file"


def test_the_camera_that_fires_at_another_time_is_named_with_the_distance_and_the_tolerance():
    stream = Stream(tolerance=0.01)
    stream.run(8.0, late={"back": 0.04})
    assert "than tolerance (0.01 s) allows: camera back's nearest by 0.040 s; raise tolerance" in stream.problem()
    assert "left" not in stream.problem()


def test_the_camera_that_sends_nothing_is_named_with_its_reason_and_what_goes_on_without_it():
    stream = Stream()
    stream.run(8.0, silent=("back",))
    told = stream.problem(back="no publisher on /back/image")
    assert told == (
        "no set: 3 cameras are needed: camera back: no publisher on /back/image; min_cameras:=2 goes on without"
    )


@pytest.mark.parametrize(
    ("ahead", "clock", "remedies"),
    [
        (6 * YEAR, WALL, ["by 6.0 years", "--clock", "-p use_sim_time:=true", "-p max_age:=0.0"]),
        (6 * YEAR, NodeClock(False, has_publisher=True), ["by 6.0 years", "start the node with -p use_sim_time:=true"]),
        (900.0, SIMULATED, ["by 900.0 s", "/clock is another recording's"]),
        (0.7, WALL, ["by 0.700 s", "raise max_age"]),
    ],
)
def test_sets_that_are_too_old_are_told_with_their_age_and_the_remedy_for_it(ahead, clock, remedies):
    stream = Stream(ros_time_ahead=ahead)
    stream.run(5.0)
    told = stream.problem(clock)
    assert told.startswith("every set is older than max_age (0.5 s)")
    assert all(remedy in told for remedy in remedies), told


def test_sets_of_an_incomplete_rig_are_told_with_what_each_camera_lacks():
    stream = Stream()
    stream.passed = "skipped: rig not complete"
    stream.run(5.0)
    told = stream.problem(left="waiting for camera_info on /left/camera_info")
    assert told == (
        "sets are skipped: too few cameras are complete: camera left: waiting for camera_info on /left/camera_info"
    )


def test_slow_cameras_are_given_the_time_of_several_images():
    synchroniser: SurroundSynchronizer[str] = SurroundSynchronizer(CAMERAS, "front", 0.05)
    now = 0.0
    progress = SetProgress(3, 0.05, 0.5, lambda: now)
    for number in range(12):
        now = number * 1.5
        for name in CAMERAS:
            synchroniser.add(name, round((now + (5.0 if name == "left" and number > 9 else 0.0)) * NANOSECONDS), name)
        progress.update(synchroniser.statistics(), {})
    assert progress.problem({}, WALL, None) == ""


def test_a_simulated_clock_that_nobody_publishes_is_told():
    assert "nothing publishes /clock" in NodeClock(True, has_publisher=False).problem
    assert NodeClock(True, has_publisher=True).problem == NodeClock(False, has_publisher=False).problem == ""
