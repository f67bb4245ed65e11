# SPDX-License-Identifier: Apache-2.0
"""The ground that is found in a cloud, and when it is not."""

import numpy as np
import pytest

from cvcdepth_core.obstacles.ground import fit_ground


def ground(slope_x=0.0, slope_y=0.0, height=0.0, noise=0.03, reach=12.0, seed=0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-reach, reach, (6000, 2))
    z = height + slope_x * xy[:, 0] + slope_y * xy[:, 1] + rng.normal(0, noise, len(xy))
    return np.column_stack([xy, z]).astype(np.float32)


def box(x, y, length=4.0, width=1.8, height=1.5, count=600, seed=1):
    rng = np.random.default_rng(seed)
    corner = rng.random((count, 3)) * (length, width, height)
    return (corner + np.array([x, y, 0.0])).astype(np.float32)


def cars():
    return np.concatenate([box(x, y, seed=i) for i, (x, y) in enumerate([(3, 3), (-6, 3), (5, -5), (-2, -5)])])


@pytest.mark.parametrize(("slope_x", "slope_y", "height"), [(0, 0, 0), (0.08, 0, -0.2), (-0.05, 0.06, 0.4)])
def test_a_sloping_ground_between_cars_is_found(slope_x, slope_y, height):
    plane = fit_ground(np.concatenate([ground(slope_x, slope_y, height), cars()]), 0.0)
    assert plane.is_fitted
    assert plane.slope_x == pytest.approx(slope_x, abs=0.01)
    assert plane.slope_y == pytest.approx(slope_y, abs=0.01)
    assert plane.height == pytest.approx(height, abs=0.05)


def test_heights_are_above_the_plane():
    plane = fit_ground(ground(0.1, 0.0, -0.4), -0.4)
    np.testing.assert_allclose(plane.heights(np.array([[10.0, 0, 1.6], [0, 5, -0.4]], np.float32)), [1, 0], atol=0.06)


def test_of_two_levels_the_one_that_most_of_the_cloud_shows_is_the_ground():
    road = ground(height=-0.4)
    pavement = road[road[:, 1] > 6] + np.array([0, 0, 0.2], np.float32)
    plane = fit_ground(np.concatenate([road[road[:, 1] <= 6], pavement]), -0.4)
    assert plane.height == pytest.approx(-0.4, abs=0.06)


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (np.zeros((0, 3), np.float32), "an empty cloud"),
        (ground(reach=1.5), "a few squares around the vehicle"),
        (ground(height=-3.0), "far below where the rig has it: another storey"),
        (ground(slope_x=0.4), "a ramp steeper than any vehicle stands on"),
        (
            np.random.default_rng(0).uniform((-12, -12, -2), (12, 12, 3), (6000, 3)).astype(np.float32),
            "bushes all around",
        ),
    ],
)
def test_without_ground_in_view_it_is_where_the_rig_has_it(points, why):
    plane = fit_ground(points, 0.1)
    assert plane == (0.1, 0.0, 0.0, False), why
    assert "as the rig says" in plane.describe()


def test_the_same_cloud_gives_the_same_plane():
    points = np.concatenate([ground(0.03), cars()])
    assert fit_ground(points, 0.0) == fit_ground(points.copy(), 0.0)
