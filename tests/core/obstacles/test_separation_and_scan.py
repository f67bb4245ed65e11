# SPDX-License-Identifier: Apache-2.0
"""Obstacles, ground, and the scan of the nearest obstacles; the scan beside a plain projection of the same points."""

import math

import numpy as np
import pytest

from cvcdepth_core.obstacles.scan import ScanLimits, scan_of
from cvcdepth_core.obstacles.separation import ObstacleLimits, separate


def scene(seed=0):
    """Ground that rises by 5 %, a car ahead, a branch above it, a pole behind."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-15, 15, (8000, 2))
    parts = [np.column_stack([xy, rng.normal(0, 0.02, len(xy))])]
    parts.append(rng.uniform((6, -1, 0.4), (8, 1, 1.5), (500, 3)))
    parts.append(rng.uniform((4, -1, 2.3), (5, 1, 3.0), (200, 3)))
    parts.append(rng.uniform((-9.05, -0.05, 0.4), (-9, 0.05, 1.8), (60, 3)))
    points = np.concatenate(parts)
    points[:, 2] += 0.05 * points[:, 0]
    return np.column_stack([points, np.zeros(len(points))]).astype(np.float32)


def test_what_stands_on_a_slope_is_an_obstacle_and_the_slope_is_none():
    cloud = separate(scene(), 0.0, ObstacleLimits())
    assert cloud.plane.is_fitted
    assert set(np.flatnonzero(cloud.is_obstacle)) == {*range(8000, 8500), *range(8700, 8760)}
    assert set(np.flatnonzero(cloud.is_ground)) == set(range(8000))


def test_nothing_beyond_the_range_is_told():
    cloud = separate(scene(), 0.0, ObstacleLimits(max_range=8.5))
    assert (np.hypot(*cloud.obstacles[:, :2].T) <= 8.5).all()
    assert (np.hypot(*cloud.ground[:, :2].T) <= 8.5).all()
    assert not cloud.is_obstacle[8700:].any()


def projected_plainly(points, beams, range_max):
    """As pointcloud_to_laserscan projects, point by point: the least distance of each bin of angles."""
    increment = 2 * math.pi / beams
    ranges = [math.inf] * beams
    for x, y in points[:, :2].tolist():
        distance, angle = math.hypot(x, y), math.atan2(y, x)
        index = int((angle + math.pi) / increment)
        if distance <= range_max and index < beams:
            ranges[index] = min(ranges[index], distance)
    return np.array(ranges)


@pytest.mark.parametrize("resolution", [0.5, 1.0, 3.0])
def test_the_scan_is_the_plain_projection_of_the_obstacles(resolution):
    cloud = separate(scene(), 0.0, ObstacleLimits())
    scan = scan_of(cloud, ScanLimits(resolution), 40.0)
    assert len(scan.ranges) == round(360 / resolution)
    expected = projected_plainly(cloud.obstacles, len(scan.ranges), 40.0)
    np.testing.assert_allclose(np.where(np.isnan(scan.ranges), np.inf, scan.ranges), expected, rtol=1e-5)
    ahead = np.argmin(np.abs(scan.angle_min + scan.increment * np.arange(len(scan.ranges))))
    assert scan.ranges[ahead] == pytest.approx(6.1, abs=0.15)
    assert scan.ranges[0] == pytest.approx(9.0, abs=0.1)


def test_directions_in_which_nothing_is_seen_are_unknown_and_not_free():
    points = scene()
    points = points[points[:, 1] >= -1.5]
    scan = scan_of(separate(points, 0.0, ObstacleLimits()), ScanLimits(1.0), 40.0)
    angles = np.degrees(scan.angle_min + scan.increment * np.arange(360))
    assert np.isnan(scan.ranges[(angles > -85) & (angles < -60)]).mean() < 1  # ground up to 1.5 m to the right is seen
    assert np.isinf(scan.ranges[(angles > 40) & (angles < 140)]).all()
    alone = scan_of(separate(points[8000:8500], 0.0, ObstacleLimits()), ScanLimits(1.0), 40.0)
    assert np.isnan(alone.ranges[(angles > 40) & (angles < 140)]).all()


def test_an_empty_cloud_makes_an_unknown_scan():
    scan = scan_of(separate(np.zeros((0, 4), np.float32), 0.0, ObstacleLimits()), ScanLimits(), 40.0)
    assert np.isnan(scan.ranges).all()
