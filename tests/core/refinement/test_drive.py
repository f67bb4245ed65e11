# SPDX-License-Identifier: Apache-2.0
"""Along a drive: odometry that fits is used, the other is named and not used, and nothing is kept too long."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from solid_world import pose, street
from surround_drive import Drive, ring

from cvcdepth_core.refinement.drive import DriveRefiner, RefinedSet
from cvcdepth_core.refinement.moments import SurroundMoment

STEP = 0.1
BUMPS = np.exp(0.3 * np.sin(np.arange(160) / 12.0))[None, None].astype(np.float32)


def way(time: float) -> np.ndarray:
    """5 m/s, faster and slower, in a gentle bend."""
    return pose(x=5.0 * time + 0.4 * np.sin(3.0 * time), y=0.1 * np.sin(time), yaw=4.0 * np.sin(2.0 * time))


DRIVE = Drive(street(), ring(4, 75), way)


@pytest.fixture(scope="module")
def moments() -> list[SurroundMoment]:
    """Twenty sets, their depth bent."""
    found = [DRIVE.moment(STEP * number) for number in range(20)]
    return [moment.with_depth(moment.depth * BUMPS) for moment in found]


def driven(moments: list[SurroundMoment], odometry: Callable[[float], np.ndarray]) -> list[RefinedSet]:
    """What becomes of the sets when odometry says that the vehicle is where `odometry` has it."""
    refiner = DriveRefiner([])
    placed = [replace(m, world_T_base=np.stack([odometry(t / 1e9) for t in m.times_ns])) for m in moments]
    return [refiner.refine(moment) for moment in placed]


def scaled(factor: float) -> Callable[[float], np.ndarray]:
    def odometry(time: float) -> np.ndarray:
        found = way(time)
        found[:3, 3] *= factor
        return found

    return odometry


def test_odometry_that_fits_is_used_and_nothing_is_said_against_it(moments):
    found = driven(moments, way)
    assert {one.source for one in found} == {"odometry"}
    assert not any(one.odometry_problem for one in found)
    assert (found[-1].depth.earlier == 3).all()


@pytest.mark.parametrize(
    ("odometry", "problem"),
    [
        (scaled(0.0), "stands still"),
        (lambda time: way(time) @ pose(yaw=90.0), "another frame"),
        (scaled(2.5), "another scale"),
    ],
)
def test_odometry_that_the_pictures_contradict_is_named_and_not_used(moments, odometry, problem):
    found = driven(moments, odometry)
    assert problem in found[-1].odometry_problem
    assert found[-1].source == "alignment"


def test_odometry_of_a_scale_that_depth_may_have_wrong_itself_is_named_and_used(moments):
    found = driven(moments[:14], scaled(1.5))
    assert "another scale: it drives 1." in found[-1].odometry_problem  # bent depth moves it a little
    assert found[-1].source == "odometry"


def test_odometry_that_jumps_is_not_compared_across_the_jump(moments):
    def jumping(time: float) -> np.ndarray:
        found = way(time)
        found[0, 3] += 8.0 * (time > 1.45)
        return found

    found = driven(moments[:20], jumping)
    jump = next(one for one in found if one.odometry_problem)
    number = found.index(jump)
    assert "odometry jumps" in jump.odometry_problem
    assert number == 15
    assert (jump.depth.earlier == 0).all()
    assert (found[number + 1].depth.earlier == 0).all() or (found[number + 1].source == "odometry")


def test_odometry_that_is_late_once_leaves_the_set_to_the_neighbours_and_is_used_again(moments):
    refiner = DriveRefiner([(0, 1), (1, 0)])
    sources = [refiner.refine(m if n != 5 else replace(m, world_T_base=None)) for n, m in enumerate(moments[:8])]
    assert [one.source for one in sources[4:8]] == ["odometry", "unknown", "odometry", "odometry"]
    assert (sources[5].depth.earlier == 0).all()
    assert (sources[6].depth.earlier > 0).all()


def test_odometry_that_stays_away_is_replaced_by_what_the_pictures_tell(moments):
    refiner = DriveRefiner([])
    found = [refiner.refine(m if n < 3 else replace(m, world_T_base=None)) for n, m in enumerate(moments[:18])]
    assert found[2].source == "odometry"
    assert found[-1].source == "alignment"
    assert (found[-1].depth.earlier > 0).all()


def test_time_that_goes_back_forgets_everything(moments):
    refiner = DriveRefiner([])
    first = [refiner.refine(moment) for moment in moments[:4]]
    again = [refiner.refine(moment) for moment in moments[:4]]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.depth.depth, other.depth.depth)
        np.testing.assert_array_equal(one.depth.confidence, other.depth.confidence)


def test_the_same_sets_give_the_same_bits_after_a_reset(moments):
    refiner = DriveRefiner([], follows_always=True)
    first = [refiner.refine(moment) for moment in moments[:4]]
    refiner.reset()
    again = [refiner.refine(moment) for moment in moments[:4]]
    np.testing.assert_array_equal(first[-1].depth.depth, again[-1].depth.depth)
    np.testing.assert_array_equal(first[-1].visual.world_T_base, again[-1].visual.world_T_base)


def test_visual_odometry_goes_the_vehicles_way_and_grows_less_certain(moments):
    refiner = DriveRefiner([], follows_always=True)
    found = [refiner.refine(DRIVE.moment(STEP * number)).visual for number in range(8)]
    assert found[0] is None
    truth = np.linalg.inv(way(0.0)) @ way(STEP * 7)
    assert np.linalg.norm(found[7].world_T_base[:3, 3] - truth[:3, 3]) < 0.03 * np.linalg.norm(truth[:3, 3])
    assert np.trace(found[7].covariance) > np.trace(found[1].covariance) > 0


def test_night_leaves_the_prior_and_is_sure_of_nothing(moments):
    refiner = DriveRefiner([(0, 1), (1, 0)])
    for moment in moments[:4]:
        dark = replace(moment, pictures=np.full_like(moment.pictures, 3))
        found = refiner.refine(dark)
        np.testing.assert_array_equal(found.depth.depth, dark.depth)
        assert not found.depth.confidence.any()
