# SPDX-License-Identifier: Apache-2.0
"""Which earlier pictures are kept, and which of them a camera is compared with."""

import numpy as np
import pytest
import torch
from solid_world import FORWARD, pose

from cvcdepth_core.refinement.history import History
from cvcdepth_core.refinement.moments import GridSet

SECOND = 10**9
HERE = np.ones(1, bool)


def grid_at(*places: np.ndarray) -> GridSet:
    cameras = len(places)
    return GridSet(
        grey=torch.zeros(cameras, 6, 8),
        depth=torch.ones(cameras, 4, 6),
        intrinsics=np.repeat(np.eye(3)[None], cameras, 0),
        world_T_camera=np.stack([place @ FORWARD for place in places]),
        reduction=1,
    )


def driven(steps: list[float], seconds: float = 0.1) -> tuple[History, float]:
    """A history after steps of so many metres, and where the vehicle is."""
    history, x = History(), 0.0
    for number, step in enumerate(steps):
        x += step
        history.add(grid_at(pose(x=x)), HERE, round(number * seconds * SECOND))
    return history, x


def distances(history: History, x: float, wanted: tuple[float, ...] = (0.3, 1.2, 4.0)) -> list[float]:
    """How far away the chosen pictures were taken."""
    found = history.sources(0, grid_at(pose(x=x)).world_T_camera, wanted)
    return [round(x - float(view.world_T_camera[0, 3]), 6) for view in found]


def test_the_newest_picture_from_at_least_each_distance_is_taken():
    history, x = driven([0.5] * 10)
    assert distances(history, x + 0.5) == [0.5, 1.5, 4.0]


def test_a_picture_that_serves_two_distances_is_taken_once():
    history, x = driven([1.5] * 4)
    assert distances(history, x + 1.5) == [1.5, 4.5]


def test_slow_sets_are_kept_every_ten_centimetres():
    history, _ = driven([0.03] * 25)
    assert len(history) == 7  # at 0, 0.12, 0.24 ...


def test_what_lies_farther_back_than_six_metres_or_three_seconds_is_forgotten():
    fast, x = driven([1.0] * 20)
    assert len(fast) == 7
    assert distances(fast, x, (5.9,)) == [6.0]
    slow, _ = driven([0.2] * 20, seconds=0.5)
    assert len(slow) == 7


def test_after_three_seconds_of_standing_only_here_is_known():
    history, x = driven([0.5] * 8 + [0.0] * 40)
    assert len(history) == 1
    assert distances(history, x) == []


def test_a_camera_without_a_picture_goes_by_its_older_ones():
    history = History()
    both, front = np.array([True, True]), np.array([True, False])
    for number, present in enumerate([both, both, front]):
        history.add(grid_at(pose(x=0.5 * number), pose(x=0.5 * number)), present, number * SECOND // 10)
    now = grid_at(pose(x=1.5), pose(x=1.5)).world_T_camera
    assert [history.sources(camera, now, (0.3,))[0].world_T_camera[0, 3] for camera in (0, 1)] == [1.0, 0.5]


def test_memory_stays_the_same_over_a_thousand_sets():
    history, x = History(), 0.0
    sizes = []
    for number in range(1000):
        x += 0.05 + 0.4 * (number % 50 > 25)
        history.add(grid_at(pose(x=x)), HERE, number * SECOND // 10)
        sizes.append(len(history))
    assert max(sizes[100:]) == max(sizes[-100:]) <= 61


@pytest.mark.parametrize(
    ("seconds", "x", "fits"),
    [(0.1, 0.5, True), (0.1, 3.0, True), (-0.1, 0.5, False), (0.0, 0.5, False), (0.1, 30.0, False), (1.0, 30.0, True)],
)
def test_only_a_later_set_from_where_a_vehicle_can_be_follows(seconds: float, x: float, fits: bool):
    history = History()
    history.add(grid_at(pose()), HERE, 5 * SECOND)
    assert history.fits(grid_at(pose(x=x)), round((5 + seconds) * SECOND)) == fits


def test_other_cameras_or_another_grid_do_not_follow():
    history = History()
    history.add(grid_at(pose()), HERE, 0)
    assert not history.fits(grid_at(pose(), pose()), SECOND)
    history.clear()
    assert history.fits(grid_at(pose(), pose()), SECOND)
