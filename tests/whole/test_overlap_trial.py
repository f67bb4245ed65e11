# SPDX-License-Identifier: Apache-2.0
"""The overlap monitor on the sample: a turned and a blurred camera are named; told by the tool that says how soon."""

from argparse import Namespace
from typing import Any

import pytest
from recordings import SAMPLE
from repository import load_tool

from cvcdepth_core.rig_health.overlap_monitor import OverlapMonitor


@pytest.fixture(scope="module")
def tool():
    return load_tool("overlap_trial")


@pytest.fixture(scope="module")
def drive(tool: Any):
    return tool.recorded_drive(SAMPLE)


@pytest.mark.parametrize(
    ("camera", "change"), [("left", "yaw 1 degree"), ("front", "pitch 1 degree"), ("back", "blurred")]
)
def test_on_a_real_street_the_right_camera_alone_is_named_within_five_seconds(
    tool: Any, drive: Any, camera: str, change: str
):
    changed = drive.changed(drive.rig.names.index(camera), tool.CHANGES[change])
    seconds = tool.trial(drive, changed, camera, Namespace(healthy=8.0, seconds=5.0), [])
    assert 0 < float(seconds) < 5  # the names of others would stand behind the number


def test_the_trial_tells_what_was_not_found_and_who_was_named_instead(tool: Any):
    assert tool.outcome({}, "back") == "**not found**"
    assert tool.outcome({"left": -1.0}, "back") == "**not found** (left at -1.0)"
    assert tool.outcome({"left or back": 2.0, "back": 3.0}, "back") == "2.0 (left or back at 2.0)"


def test_a_confirmed_camera_does_not_confirm_what_another_one_shows_for_a_moment(drive: Any):
    monitor = OverlapMonitor(drive.rig)

    def measure() -> None:
        for trend in monitor._trends:
            trend.measurements += 1

    left, right = drive.rig.names.index("left"), drive.rig.names.index("right")
    values = dict.fromkeys(monitor._pairs, 0.0)
    values |= {pair: 1.0 for pair in values if left in pair}
    assert not list(monitor._named("misalignment", values, 0.5, 0))
    measure()
    values |= {pair: 2.0 for pair in values if right in pair}
    named = [finding.cameras for finding in monitor._named("misalignment", values, 0.5, 10**9)]
    assert named == [("left",)]
    measure()
    named = [finding.cameras for finding in monitor._named("misalignment", values, 0.5, 2 * 10**9)]
    assert sorted(named) == [("left",), ("right",)]


LOOSE = pytest.mark.xfail(
    reason="default model of December 2026: 'right seems turned by 0.9 degrees', where 0.5 are told"
)


@pytest.mark.parametrize("stride", [4, pytest.param(7, marks=LOOSE)])
def test_an_intact_rig_raises_no_alarm_when_few_sets_of_a_looped_drive_are_seen(drive: Any, stride: int):
    monitor = OverlapMonitor(drive.rig)
    for number in range(0, 900, stride):
        monitor.update(drive.sets[number % len(drive.sets)], number * 100_000_000)
        assert not monitor.findings()
