# SPDX-License-Identifier: Apache-2.0
"""What earlier sets have shown too stays, wherever the vehicle has driven meanwhile."""

import numpy as np
import pytest

from cvcdepth_core.obstacles.persistence import Persistence

TENTH = 10**8


def place(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:2, 3] = x, y
    return pose


def seen_from(world: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points [M, 4] of the base frame at a place, of points [M, 3] of the world."""
    points = (world - pose[:3, 3]) @ pose[:3, :3]
    return np.column_stack([points, np.arange(len(points))]).astype(np.float32)


WORLD = np.random.default_rng(0).uniform((-15, -15, 0), (15, 15, 2), (400, 3))


@pytest.mark.parametrize("origin", [0.0, 4.8e6], ids=["near the world's origin", "in UTM coordinates"])
def test_what_stands_stays_while_the_vehicle_drives_and_turns_and_what_flickers_goes(origin):
    persistence = Persistence()
    world = WORLD + np.array([origin, origin / 10, 0])
    for i in range(4):
        pose = place(origin + 0.9 * i, origin / 10, 0.05 * i)
        ghost = world[:1] + np.array([[60.0 + 5 * i, 0, 0]])
        found = persistence.filtered(seen_from(np.concatenate([world, ghost]), pose), pose, i * TENTH, 1)
        kept = set(found[:, 3].astype(int).tolist())
        if i == 0:
            assert kept == set(range(401))  # nothing is known of earlier sets
        else:
            assert 400 not in kept
            assert len(kept) > 395


def test_all_of_so_many_sets_must_have_shown_it():
    persistence, pose = Persistence(), place(0)
    without = WORLD[1:]
    numbers = [len(persistence.filtered(seen_from(w, pose), pose, i * TENTH, 2)) for i, w in enumerate(
        (WORLD, without, WORLD, WORLD, WORLD)
    )]  # fmt: skip
    lone = np.linalg.norm(WORLD[1:] - WORLD[0], axis=1).min() > 1.0
    assert numbers[:2] == [400, 399]
    assert numbers[4] == 400
    assert not lone or numbers[2:4] == [399, 399]


@pytest.mark.parametrize("after", [10 * TENTH + 1, -TENTH, 0])
def test_after_a_pause_or_a_jump_back_all_points_stay(after):
    persistence, pose = Persistence(), place(0)
    persistence.filtered(seen_from(WORLD[:10], pose), pose, 0, 1)
    assert len(persistence.filtered(seen_from(WORLD, pose), pose, after, 1)) == 400


def test_while_the_motion_is_not_known_all_points_stay():
    persistence, pose = Persistence(), place(0)
    persistence.filtered(seen_from(WORLD[:10], pose), pose, 0, 1)
    assert len(persistence.filtered(seen_from(WORLD, pose), None, TENTH, 1)) == 400
    assert (
        len(persistence.filtered(seen_from(WORLD, pose), pose, 2 * TENTH, 1)) == 400
    )  # and what was before is forgotten
