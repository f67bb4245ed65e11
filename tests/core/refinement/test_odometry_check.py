# SPDX-License-Identifier: Apache-2.0
"""Odometry that disagrees with the pictures is named for what is wrong with it."""

from collections.abc import Callable

import numpy as np
import pytest
from solid_world import pose

from cvcdepth_core.refinement.odometry_check import ComparedMotion, OdometryCheck, recorded_twist

STEP = 0.1
RANDOM = np.random.default_rng(1)


def place(time: float) -> np.ndarray:
    """A drive with changes: a curve, slower and faster."""
    return pose(x=5.0 * time + 0.8 * np.sin(2.0 * time), y=0.3 * np.sin(time), yaw=8.0 * np.sin(1.5 * time))


def checked(odometry: Callable[[float], np.ndarray], steps: int = 40, noise: float = 0.02) -> str | None:
    """What is said when the odometry's pose at a time is as given, and the pictures tell the truth, nearly."""
    check = OdometryCheck()
    for number in range(steps):
        start, end = number * STEP, (number + 1) * STEP
        seen = recorded_twist(place(start), place(end), STEP) * (1 + RANDOM.normal(0, noise))
        recorded = recorded_twist(odometry(start), odometry(end), STEP)
        check.add(ComparedMotion((start + end) / 2, seen, recorded))
    return check.problem()


def scaled(factor: float) -> Callable[[float], np.ndarray]:
    def odometry(time: float) -> np.ndarray:
        found = place(time)
        found[:3, 3] *= factor
        return found

    return odometry


def test_right_odometry_has_no_problem():
    assert checked(place) is None
    assert checked(lambda time: pose(x=100.0, y=-40.0, yaw=70.0) @ place(time)) is None  # another origin is no problem


def test_the_pictures_scale_may_be_a_little_wrong():
    assert checked(scaled(1.12)) is None


@pytest.mark.parametrize("factor", [0.7, 1.6])
def test_a_wrong_wheel_scale_is_named_with_its_factor(factor: float):
    assert checked(scaled(factor)) == (
        f"odometry has another scale: it drives {factor:.2f} times as far as the pictures show"
    )


def test_odometry_that_stands_still_is_named():
    assert checked(lambda _: pose(x=3.0)).startswith("odometry stands still while the pictures move at 5.")


def test_a_jump_is_named_with_its_time():
    found = checked(lambda time: pose(x=30.0 * (time > 2.05)) @ place(time))
    assert found == "odometry jumps: its speed changes by 300 m/s within a step, at 2.05 s"


@pytest.mark.parametrize(("lag", "words"), [(0.3, "lags behind the pictures by 0.30 s"), (-0.2, "is ahead of")])
def test_a_lag_is_named_with_its_length(lag: float, words: str):
    assert words in checked(lambda time: place(time - lag))


def test_another_frame_is_named_by_its_axis():
    turned = pose(yaw=90.0)
    found = checked(lambda time: turned @ place(time) @ turned.T)
    assert found.startswith("odometry is in another frame: it drives along y")
    backwards = pose(yaw=180.0)
    assert "along -x" in checked(lambda time: backwards @ place(time) @ backwards.T)


def test_a_few_steps_tell_nothing():
    assert checked(scaled(0.5), steps=9) is None


def test_standing_together_is_no_problem():
    check = OdometryCheck()
    for number in range(30):
        check.add(ComparedMotion(0.1 * number, RANDOM.normal(0, 0.01, 6), np.zeros(6)))
    assert check.problem() is None
