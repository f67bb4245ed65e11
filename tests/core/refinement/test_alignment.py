# SPDX-License-Identifier: Apache-2.0
"""Motion by alignment against exact truth, and when it must not be used."""

from dataclasses import replace

import numpy as np
import pytest
from solid_world import Rectangle, pose, street
from surround_drive import Drive, Way, ring, straight

from cvcdepth_core.refinement.alignment import AlignedMotion, AlignedSet, align, exponential, logarithm
from cvcdepth_core.refinement.drive import DriveRefiner
from cvcdepth_core.refinement.visual_odometry import VisualOdometry
from cvcdepth_core.rig.poses import inverse

MOUNTS = ring(4, 75)
STREET = street()
BUMPS = np.exp(0.3 * np.sin(np.arange(160) / 12.0))[None, None].astype(np.float32)
TURNING = straight((5.0, 0.0, 0.0), yaw_rate=8.0)


def aligned(way: Way, surfaces: list[Rectangle] = STREET, delays=(), prior: float = 1.0, starts=()) -> AlignedMotion:
    """What alignment says of a tenth of a second of the way."""
    drive = Drive(surfaces, MOUNTS, way, delays)
    previous, current = (AlignedSet.of(drive.moment(time, prior), 160) for time in (0.0, 0.1))
    return align(previous, current, starts)


def misses(motion: AlignedMotion, way: Way) -> tuple[float, float]:
    """Error of the step from 0 to 0.1 s: as a share of its length, and in degrees."""
    truth = inverse(way(0.0)) @ way(0.1)
    error = logarithm(inverse(truth) @ motion.pose(0.1))
    length = max(float(np.linalg.norm(truth[:3, 3])), 1e-9)
    return float(np.linalg.norm(error[:3])) / length, float(np.degrees(np.linalg.norm(error[3:])))


@pytest.mark.parametrize("way", [straight((5.0, 0.0, 0.0)), TURNING, straight((2.0, 0.5, 0.0), yaw_rate=-15.0)])
def test_from_standstill_the_motion_is_found_to_a_hundredth_and_a_fiftieth_of_a_degree(way: Way):
    motion = aligned(way)
    length, degrees = misses(motion, way)
    assert motion.problem is None
    assert motion.cameras == 4
    assert length < 0.01
    assert degrees < 0.02


def test_from_half_of_the_motion_it_is_found_as_well():
    whole = logarithm(inverse(TURNING(0.0)) @ TURNING(0.1)) / 0.1
    length, degrees = misses(aligned(TURNING, starts=[whole / 2]), TURNING)
    assert length < 0.01
    assert degrees < 0.02


def test_cameras_that_fire_one_after_the_other_each_count_over_their_own_interval():
    length, degrees = misses(aligned(TURNING, delays=(0.0, 0.02, 0.05, 0.08)), TURNING)
    assert length < 0.01
    assert degrees < 0.02


def test_the_scale_is_that_of_the_depth():
    motion = aligned(straight((5.0, 0.0, 0.0)), prior=1.2)
    assert np.linalg.norm(motion.twist[:3]) == pytest.approx(1.2 * 5.0, rel=0.03)


def test_standing_still_is_found_to_be_standing_still():
    motion = aligned(straight())
    assert motion.problem is None
    assert np.abs(motion.twist).max() < 1e-3


def test_what_moves_by_itself_does_not_carry_the_motion_away():
    car = Rectangle(pose(x=7.0, z=-0.6), 1.2, 0.9, seed=40, wavelengths=(0.2, 1.5), velocity=(5.0, 0.0, 0.0))
    way = straight((5.0, 0.0, 0.0))
    length, degrees = misses(aligned(way, [*street(), car]), way)
    assert length < 0.02
    assert degrees < 0.05


def test_the_covariance_tells_the_size_of_the_error():
    motion = aligned(TURNING)
    truth = logarithm(inverse(TURNING(0.0)) @ TURNING(0.1)) / 0.1
    deviations = np.sqrt(np.diag(motion.covariance))
    assert (np.abs(motion.twist - truth) < 12 * deviations).all()
    assert (deviations[:3] < 0.1).all()


def test_without_texture_it_says_how_many_cameras_could_help():
    blank = [replace(surface, contrast=0.0) for surface in street()]
    motion = aligned(TURNING, blank)
    assert motion.problem == "only 0 cameras see enough texture with known depth, 3 are needed"


def test_pictures_of_another_place_are_named_as_such():
    drive, elsewhere = (Drive(street(seed), MOUNTS, TURNING) for seed in (1, 50))
    motion = align(AlignedSet.of(elsewhere.moment(0.0), 160), AlignedSet.of(drive.moment(0.1), 160))
    assert motion.problem is not None
    assert "the pictures do not agree: correlation 0." in motion.problem


@pytest.mark.parametrize(
    "motion", [[0.5, -0.1, 0.02, 0.01, -0.02, 0.3], [1.0, 0, 0, 0, 0, 0], [0, 0, 0, 0.7, -1.9, 1.1]]
)
def test_logarithm_undoes_exponential(motion: list[float]):
    np.testing.assert_allclose(logarithm(exponential(np.array(motion))), motion, atol=1e-9)


def tracked(drive: Drive, times: list[float], prior: float = 1.0) -> list[np.ndarray | None]:
    """The poses that visual odometry gives at each set."""
    odometry, found = VisualOdometry(), []
    for time in times:
        moment = drive.moment(time, prior)
        odometry.track(moment)
        found.append(odometry.base_poses())
        odometry.keep(moment.depth)
    return found


def test_odometry_of_a_curve_ends_where_the_vehicle_is():
    delays = (0.0, 0.02, 0.05, 0.08)
    way: Way = lambda time: pose(5.0 * time, 0.4 * time**2, yaw=8.0 * time)  # noqa: E731
    drive = Drive(street(), MOUNTS, way, delays)
    times = [0.1 * number for number in range(6)]
    found = tracked(drive, times)
    assert found[0] is None  # nothing is known of the first set's motion
    start = found[1][0] @ inverse(way(times[1]))
    for delay, placed in zip(delays, found[-1], strict=True):
        error = inverse(start @ way(times[-1] + delay)) @ placed
        assert np.linalg.norm(error[:3, 3]) < 0.02 * 2.0
        assert np.degrees(np.linalg.norm(logarithm(error)[3:])) < 0.1


def test_after_a_gap_odometry_begins_anew():
    drive = Drive(street(), MOUNTS, straight((1.0, 0.0, 0.0)))
    found = tracked(drive, [0.0, 0.1, 1.6, 1.7])
    assert [placed is None for placed in found] == [True, False, True, False]
    np.testing.assert_allclose(found[3].mean(0)[:3, 3], found[1].mean(0)[:3, 3], atol=0.02)


def test_a_dead_camera_does_not_stop_odometry():
    drive = Drive(street(), MOUNTS, TURNING)
    odometry = VisualOdometry()
    for time in (0.0, 0.1):
        moment = drive.moment(time)
        moment.depth[3], moment.pictures[3], moment.present[3], moment.times_ns[3] = np.nan, 0, False, 0
        motion = odometry.track(moment)
        odometry.keep(moment.depth)
    assert motion.cameras == 3
    assert misses(motion, TURNING)[0] < 0.02


def test_without_odometry_depth_becomes_as_good_as_the_scale_that_it_began_with():
    drive = Drive(STREET, MOUNTS, TURNING)
    refiner = DriveRefiner([])
    for number in range(5):
        moment = replace(drive.moment(0.1 * number), world_T_base=None)
        bent = moment.with_depth(moment.depth * BUMPS)
        refined = refiner.refine(bent)
    truth = moment.depth
    before, after = (np.nanmedian(np.abs(found - truth) / truth) for found in (bent.depth, refined.depth.depth))
    assert after < 0.5 * before
    assert refined.source == "alignment"
    assert misses(refined.visual.aligned, TURNING)[0] < 0.15
    refiner.reset()
    assert not refiner.refine(moment).depth.confidence.any()
