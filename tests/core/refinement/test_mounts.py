# SPDX-License-Identifier: Apache-2.0
"""Turned mounts are found from overlaps, and refused where overlaps do not tell."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from solid_world import street
from surround_drive import Drive, looking, ring, straight

from cvcdepth_core.errors import RigError
from cvcdepth_core.refinement.mounts import MountSearch, PairTurn, RefinedMounts, consistent_mounts
from cvcdepth_core.rendering.projection import axis_angle_to_rotation

MOUNTS = ring(4, 50)
PAIRS = [(0, 1), (1, 0), (1, 2), (2, 1), (2, 3), (3, 2)]
TOLD = np.eye(3) * 1e4


def turned(base_T_camera: np.ndarray, camera: int, degrees: list[float]) -> np.ndarray:
    """A rig file that has one camera wrong: turned against where it really looks."""
    given = base_T_camera.copy()
    given[camera, :3, :3] = given[camera, :3, :3] @ rotation(degrees).T
    return given


def rotation(degrees: list[float]) -> np.ndarray:
    return axis_angle_to_rotation(torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))).numpy()


def searched(given: np.ndarray, mounts: np.ndarray = MOUNTS, pairs=PAIRS, surfaces=None) -> RefinedMounts:
    """What is found on a drive through the street, with the true depth and a rig file that says `given`."""
    drive = Drive(street() if surfaces is None else surfaces, mounts, straight((5.0, 0.0, 0.0)))
    search = MountSearch(pairs, anchor=0)
    for time in (0.0, 0.3, 0.6):
        moment = replace(drive.moment(time), base_T_camera=given)
        search.add(moment, moment.depth)
    return search.result()


@pytest.mark.parametrize(("camera", "degrees"), [(1, [0.0, 0.5, 0.0]), (3, [0.5, 0.0, 0.0]), (2, [-0.3, 0.3, 0.25])])
def test_a_mount_that_is_turned_by_half_a_degree_is_found_to_a_twentieth(camera: int, degrees: list[float]):
    found = searched(turned(MOUNTS, camera, degrees))
    want = np.zeros((4, 3))
    want[camera] = degrees
    np.testing.assert_allclose(found.turns, want, atol=0.05)
    np.testing.assert_allclose(found.base_T_camera[:, :3, 3], MOUNTS[:, :3, 3])
    error = found.base_T_camera[camera, :3, :3].T @ MOUNTS[camera, :3, :3]
    assert np.degrees(np.arccos((np.trace(error) - 1) / 2)) < 0.05


def test_a_right_rig_is_left_as_it_is_and_scores_do_not_rise():
    found = searched(MOUNTS)
    assert np.abs(found.turns).max() < 0.03
    assert all(pair.problem is None and pair.after < pair.before + 0.01 for pair in found.pairs)


def test_scores_before_and_after_tell_of_the_improvement():
    found = searched(turned(MOUNTS, 1, [0.0, 0.5, 0.0]))
    touched = [pair for pair in found.pairs if 1 in pair[:2]]
    assert len(touched) == 4
    assert all(pair.after > pair.before + 0.05 for pair in touched)


def test_without_texture_every_pair_is_refused_by_name_and_every_mount_kept():
    blank = [replace(surface, contrast=0.0) for surface in street()]
    found = searched(turned(MOUNTS, 1, [0.0, 0.5, 0.0]), surfaces=blank)
    assert all(
        pair.problem == "0 textured patches of known depth in the overlap, 100 are needed" for pair in found.pairs
    )
    assert np.isnan(found.turns[1:]).all()
    np.testing.assert_array_equal(found.base_T_camera, turned(MOUNTS, 1, [0.0, 0.5, 0.0]))


def test_without_overlap_a_camera_keeps_its_mount():
    mounts = np.stack([looking(), looking(yaw=90), looking(yaw=40)])
    found = searched(mounts, mounts, [(0, 1), (1, 0), (0, 2), (2, 0)])
    assert np.isnan(found.turns[1]).all()
    assert not np.isnan(found.turns[2]).any()
    np.testing.assert_array_equal(found.base_T_camera[1], mounts[1])


def test_no_set_at_all_is_an_error():
    with pytest.raises(RigError, match="no set was added"):
        MountSearch(PAIRS, anchor=0).result()


def pair(camera: int, neighbour: int, turn: list[float], information: np.ndarray = TOLD) -> PairTurn:
    return PairTurn(camera, neighbour, np.array(turn), information, 500, 0.4, 0.7, None)


def test_turns_of_a_closed_ring_are_made_consistent():
    mounts = np.repeat(np.eye(4)[None], 3, axis=0)
    pairs = [pair(0, 1, [0, -0.2, 0]), pair(1, 2, [0, -0.2, 0]), pair(2, 0, [0, 0.31, 0])]
    found = consistent_mounts(mounts, 0, pairs)
    np.testing.assert_allclose(found.turns[:, 1], [0.0, 0.17, 0.34], atol=0.001)


def test_a_pair_that_contradicts_the_others_is_left_out_and_named():
    mounts = np.repeat(np.eye(4)[None], 3, axis=0)
    good = [pair(0, 1, [0, -0.2, 0]), pair(1, 0, [0, 0.2, 0]), pair(1, 2, [0, -0.1, 0]), pair(2, 1, [0, 0.1, 0])]
    bad = pair(2, 0, [0, 1.5, 0], TOLD / 4)
    found = consistent_mounts(mounts, 0, [*good, bad])
    assert [p.problem is None for p in found.pairs] == [True] * 4 + [False]
    assert "contradicts the other pairs" in found.pairs[-1].problem
    np.testing.assert_allclose(found.turns[:, 1], [0.0, 0.2, 0.3], atol=0.001)
