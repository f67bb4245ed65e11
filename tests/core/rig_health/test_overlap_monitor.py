# SPDX-License-Identifier: Apache-2.0
"""The monitor on a ray-cast street: three cameras side by side, one of which is turned or blurred while driving."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from street_scene import HEIGHT, WIDTH, K, camera, cast, turned

from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.overlap_monitor import Finding, MonitorLimits, OverlapMonitor
from cvcdepth_core.surround_depth import SurroundDepth

CAMERAS = (camera("left", 0.5, 22.0), camera("middle", 0.0, 0.0), camera("right", -0.5, -22.0))
RIG = Rig(CAMERAS, "base_link", "middle", {})
NAMES = RIG.names
LIMITS = MonitorLimits(window=1.0, learning=2.0)
SETS = 8


def _turn(axis: int, degrees: float) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(math.radians(degrees) * np.eye(3)[axis])[0]
    return pose


def _drive(turn: dict[str, NDArray[np.float64]]) -> list[SurroundDepth]:
    """What the cameras see on eight places of the street, some of them mounted otherwise than the rig says."""
    sets = []
    for place in range(SETS):
        base = turned(0.0)
        base[0, 3] = 0.3 * place
        views = [cast(base @ c.base_T_camera @ turn.get(c.name, np.eye(4)), post=True) for c in CAMERAS]
        depth, pictures = map(np.stack, zip(*views, strict=True))
        sets.append(SurroundDepth(depth, pictures, np.stack([K] * 3), np.ones(3, bool)))
    return sets


HEALTHY = _drive({})


def _watch(changed: list[SurroundDepth], healthy_seconds: float = 4.0) -> tuple[OverlapMonitor, list[Finding], float]:
    """Feed ten sets a second, then the changed ones; give what is found, and seconds until then."""
    monitor = OverlapMonitor(RIG, LIMITS)
    for number in range(int(10 * healthy_seconds)):
        monitor.update(HEALTHY[number % SETS], number * 10**8)
        assert not monitor.findings()
    first = math.inf
    for number in range(40):
        monitor.update(changed[number % SETS], int(healthy_seconds * 10**9) + number * 10**8)
        first = min(first, number / 10) if monitor.findings() else first
    return monitor, list(monitor.findings()), first


def test_nothing_is_found_while_nothing_changes():
    monitor, found, _ = _watch(HEALTHY)
    assert not found
    assert max(state.misalignment for state in monitor.pairs().values()) < 0.35
    assert max(state.disagreement for state in monitor.pairs().values()) < 0.05


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("axis", [0, 1], ids=["pitch", "yaw"])
def test_a_camera_turned_by_a_degree_is_found_within_five_seconds(name: str, axis: int):
    _, found, seconds = _watch(_drive({name: _turn(axis, 1.0)}))
    assert seconds < 5
    assert any(name in finding.cameras for finding in found)


def test_the_camera_between_two_others_is_named_alone():
    _, found, _ = _watch(_drive({"middle": _turn(1, 1.0)}))
    misaligned = [finding for finding in found if finding.quantity == "misalignment"]
    assert misaligned[0].cameras in (("middle",), ("left", "middle"), ("middle", "right"))
    assert "middle" in str(misaligned[0])


@pytest.mark.parametrize("index", range(3))
def test_a_blurred_camera_is_found_and_named(index: int):
    blurred = [replace(s, pictures=s.pictures.copy()) for s in _with_grain(HEALTHY)]
    for surround in blurred:
        surround.pictures[index] = cv2.GaussianBlur(surround.pictures[index], (0, 0), 1.2)
    monitor = OverlapMonitor(RIG, LIMITS)
    for number in range(40):
        monitor.update(_with_grain(HEALTHY)[number % SETS], number * 10**8)
    for number in range(40, 80):
        monitor.update(blurred[number % SETS], number * 10**8)
    found = [finding for finding in monitor.findings() if finding.quantity == "sharpness"]
    assert [finding.cameras for finding in found] == [(NAMES[index],)]


def _with_grain(sets: list[SurroundDepth]) -> list[SurroundDepth]:
    """The street's waves have no fine structure to lose."""
    grain = np.random.default_rng(0).integers(-30, 30, (HEIGHT, WIDTH, 1))
    return [replace(s, pictures=np.clip(s.pictures.astype(int) + grain, 0, 255).astype(np.uint8)) for s in sets]


def test_a_dead_camera_is_not_judged():
    monitor = OverlapMonitor(RIG, LIMITS)
    for number in range(60):
        surround = HEALTHY[number % SETS]
        monitor.update(replace(surround, present=np.array([True, True, False])), number * 10**8)
    assert math.isnan(monitor.pairs()["middle", "right"].misalignment)
    assert not monitor.findings()


def test_what_is_not_measured_any_more_is_not_found_any_more():
    turned_right = _drive({"right": _turn(1, 1.0)})
    monitor, found, _ = _watch(turned_right)
    assert any("right" in finding.cameras for finding in found)
    for number in range(80, 140):
        gone = replace(turned_right[number % SETS], present=np.array([True, True, False]))
        monitor.update(gone, number * 10**8)
    assert not any("right" in finding.cameras for finding in monitor.findings())
    assert math.isnan(monitor.pairs()["middle", "right"].misalignment)


def test_one_bad_measurement_does_not_confirm_itself():
    step = 3 * 10**9  # so slowly that each measurement is the only one of its window, for longer than is confirmed
    monitor = OverlapMonitor(RIG, LIMITS)
    for number in range(40):
        monitor.update(HEALTHY[number % SETS], number * step)
    apart = [replace(s, depth=s.depth * np.float32([1.0, 1.0, 3.0])[:, None, None]) for s in HEALTHY]
    rounds = len(monitor._steps) // monitor._steps_per_update
    for number in range(40, 40 + rounds):
        monitor.update(apart[number % SETS], number * step)
        assert not monitor.findings()
    for number in range(40 + rounds, 40 + 3 * rounds):
        monitor.update(apart[number % SETS], number * step)
    assert monitor.findings()


def test_a_stamp_that_goes_back_begins_the_recent_seconds_anew():
    monitor, _, _ = _watch(HEALTHY)
    monitor.update(HEALTHY[0], 0)
    assert not monitor.findings()
