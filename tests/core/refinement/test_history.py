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


def grid_at(*places: np.ndarray, placed: bool = True) -> GridSet:
    cameras = len(places)
    return GridSet(
        grey=torch.zeros(cameras, 6, 8),
        depth=torch.ones(cameras, 4, 6),
        intrinsics=np.repeat(np.eye(3)[None], cameras, 0),
        base_T_camera=np.repeat(FORWARD[None], cameras, 0),
        world_T_camera=np.stack([place @ FORWARD for place in places]),
        placed=placed,
        reduction=1,
    )


def go_on(history: History, grid: GridSet, seconds: float, present: np.ndarray = HERE) -> None:
    history.advance(grid, present, round(seconds * SECOND))
    history.add(grid, present, round(seconds * SECOND))


def driven(steps: list[float], seconds: float = 0.1) -> tuple[History, float]:
    """A history after steps of so many metres, and where the vehicle is."""
    history, x = History(), 0.0
    for number, step in enumerate(steps):
        x += step
        go_on(history, grid_at(pose(x=x)), number * seconds)
    return history, x


def distances(history: History, x: float, wanted: tuple[float, ...] = (0.3, 1.2, 4.0)) -> list[float]:
    """How far away the chosen pictures were taken."""
    found = history.sources(0, pose(x=x) @ FORWARD, wanted)
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
        go_on(history, grid_at(pose(x=0.5 * number), pose(x=0.5 * number)), 0.1 * number, present)
    found = [history.sources(camera, pose(x=1.5) @ FORWARD, (0.3,)) for camera in (0, 1)]
    assert [views[0].world_T_camera[0, 3] for views in found] == [1.0, 0.5]


def test_memory_stays_the_same_over_a_thousand_sets():
    history, x = History(), 0.0
    sizes = []
    for number in range(1000):
        x += 0.05 + 0.4 * (number % 50 > 25)
        go_on(history, grid_at(pose(x=x)), 0.1 * number)
        sizes.append(len(history))
    assert max(sizes[100:]) == max(sizes[-100:]) <= 61


@pytest.mark.parametrize(
    ("seconds", "x", "follows"),
    [(0.1, 0.5, True), (0.1, 3.0, True), (-0.1, 0.5, True), (-0.3, 0.5, False), (0.1, 30.0, False), (2.0, 5.0, True)],
)
def test_only_a_later_set_from_where_a_vehicle_can_be_follows(seconds: float, x: float, follows: bool):
    history = History()
    go_on(history, grid_at(pose()), 5.0)
    history.advance(grid_at(pose(x=x)), HERE, round((5 + seconds) * SECOND))
    assert len(history) == follows


def test_after_a_long_gap_nothing_is_compared_with():
    history, x = driven([0.5] * 8)
    history.advance(grid_at(pose(x=x)), HERE, 60 * SECOND)
    assert distances(history, x, (0.3,)) == []


def test_other_cameras_do_not_follow_and_a_dead_one_need_not_be_placed():
    history = History()
    go_on(history, grid_at(pose(), pose()), 0.0, np.array([True, True]))
    history.advance(grid_at(pose(x=0.5), pose(x=900.0)), np.array([True, False]), SECOND // 10)
    assert len(history) == 1
    history.advance(grid_at(pose()), HERE, SECOND // 5)
    assert len(history) == 0


def test_a_set_of_unknown_place_is_no_jump():
    history = History()
    go_on(history, grid_at(pose(x=5000.0)), 0.0)
    history.advance(grid_at(pose(), placed=False), HERE, SECOND // 10)
    assert len(history) == 1
