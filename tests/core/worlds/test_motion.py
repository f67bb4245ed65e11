# SPDX-License-Identifier: Apache-2.0
"""Curves, speeds, and what a vehicle believes about its way."""

import itertools
import math

import numpy as np
import pytest
from simple_worlds import Standing, street_spec

from cvcdepth_core.rig.poses import check_rigid, inverse
from cvcdepth_core.worlds.description import Drive, Ground, Wave
from cvcdepth_core.worlds.odometry import told_motion
from cvcdepth_core.worlds.paths import Path, eased
from cvcdepth_core.worlds.sensors import Odometry
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.trajectories import SpeedProfile, vehicle_trajectory


def test_an_arc_ends_where_geometry_says():
    quarter = Path((1.0, 2.0, 0.0), [(10 * math.pi, 0.05, 0.05)])
    assert quarter.points(quarter.length) == pytest.approx((21.0, 22.0), abs=0.15)
    assert float(quarter.heading(quarter.length)) == pytest.approx(math.pi / 2, abs=0.01)


@pytest.mark.parametrize("left", [0.0, 3.0, -4.0])
def test_places_are_found_again_along_the_curve_and_beyond_its_ends(left: float):
    path = Path((1.0, 2.0, 0.3), eased([(50, 0.0), (40, 0.05), (30, -0.02)]))
    s = np.linspace(-20, path.length + 20, 60)
    found, beside = path.locate(path.points(s, left))
    assert found == pytest.approx(s, abs=1e-6)
    assert beside == pytest.approx(left, abs=1e-6)


def test_a_curve_beside_another_keeps_its_distance_and_runs_back_as_it_came():
    path = Path((0.0, 0.0, 0.0), eased([(50, 0.0), (40, 0.05), (30, -0.02)]))
    beside = path.offset(3.0)
    _, distance = path.locate(beside.points(np.linspace(0, beside.length, 80)))
    assert distance == pytest.approx(3.0, abs=0.01)
    back = path.reversed()
    assert back.points(back.length) == pytest.approx((0.0, 0.0), abs=0.02)
    assert back.points(20.0) == pytest.approx(path.points(path.length - 20.0), abs=0.02)


def test_distances_are_the_integral_of_speeds():
    profile = SpeedProfile(((1.0, 4.0), (3.0, 0.0), (4.0, 0.0), (6.0, -2.0)))
    times = np.linspace(-2.0, 9.0, 2001)
    speeds = np.array([profile.speed(time) for time in times])
    distances = np.array([profile.distance(time) for time in times])
    assert np.gradient(distances, times)[2:-2] == pytest.approx(speeds[2:-2], abs=0.03)
    assert profile.distance(0.0) == 0.0
    assert profile.distance(3.0) == pytest.approx(4.0 + 4.0)
    assert profile.distance(6.0) == pytest.approx(8.0 - 2.0)


def test_a_vehicle_follows_the_slope_and_nods_when_it_brakes():
    hill = Ground(waves=(Wave(height=1.0, wavelength=120.0),))
    drive = Drive(at=(20.0, -1.6), speeds=((0.0, 10.0), (2.0, 10.0), (4.0, 0.0)))
    spec = street_spec(ground=hill, drive=drive)
    way = vehicle_trajectory(Site(spec), drive, drive)
    site = Site(spec)
    for time in (0.5, 1.0, 1.5):
        pose = way.pose(time)
        check_rigid(pose, "base")
        assert pose[2, 3] == pytest.approx(site.terrain.at(*pose[:2, 3]), abs=0.03)
        gradient = site.terrain.at(pose[0, 3] + 1, pose[1, 3]) - site.terrain.at(pose[0, 3], pose[1, 3])
        assert pose[2, 0] == pytest.approx(gradient, abs=0.01)
    level = street_spec(ground=Ground(), drive=drive)
    flat = vehicle_trajectory(Site(level), drive, drive)
    nods = np.mean([flat.pose(time)[2, 0] for time in np.linspace(2.5, 3.5, 40)])
    assert nods == pytest.approx(-0.03, abs=0.01)  # m/s^2 times 0.006
    assert flat.pose(9.0)[0, 3] == flat.pose(8.0)[0, 3]


def test_a_vehicle_reverses_and_turns_off():
    drive = Drive(at=(20.0, -1.6), speeds=((0.0, 0.0), (1.0, -2.0)), bends=((30.0, 0.0), (15.0, 0.1), (50.0, 0.0)))
    way = vehicle_trajectory(Site(street_spec(drive=drive)), drive, drive)
    assert way.speed(3.0) == -2.0
    assert way.pose(3.0)[0, 3] < way.pose(0.0)[0, 3] - 3.0
    ahead = Drive(at=(20.0, -1.6), speeds=((0.0, 10.0),), bends=((5.0, 0.0), (15.0, 0.1), (50.0, 0.0)))
    turned = vehicle_trajectory(Site(street_spec(drive=ahead)), ahead, ahead).pose(4.0)
    assert math.atan2(turned[1, 0], turned[0, 0]) == pytest.approx(1.5, abs=0.03)


def test_odometry_without_errors_is_the_truth():
    way = Standing(speed=5.0, yaw_rate=0.2)
    for told in told_motion(way, Odometry(rate=20.0), -0.3, 1.0, (0,)):
        assert (told.odom_T_base == way.pose(told.seconds)).all()


def test_wheels_tell_another_scale_noise_and_latency():
    way = Standing(speed=5.0)
    last = told_motion(way, Odometry(scale=1.1), 0.0, 2.0, (0,))[-1]
    assert last.odom_T_base[0, 3] == pytest.approx(1.1 * 10.0)
    late = told_motion(way, Odometry(latency=0.1), 0.0, 2.0, (0,))[-1]
    assert late.odom_T_base[0, 3] == pytest.approx(9.5)
    noisy, again, other = (told_motion(way, Odometry(noise=0.1), 0.0, 2.0, (seed,)) for seed in (1, 1, 2))
    steps = [(inverse(a.odom_T_base) @ b.odom_T_base)[0, 3] for a, b in itertools.pairwise(noisy)]
    assert np.std(steps) / np.mean(steps) == pytest.approx(0.1, rel=0.3)
    assert (noisy[-1].odom_T_base == again[-1].odom_T_base).all()
    assert (noisy[-1].odom_T_base != other[-1].odom_T_base).any()
