# SPDX-License-Identifier: Apache-2.0
"""Pictures of one world agree with each other where true depth and motion say that they show the same."""

import cv2
import numpy as np
import pytest

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.worlds.building import build_world
from cvcdepth_core.worlds.generation.random_world import random_world
from cvcdepth_core.worlds.rendering.lenses import Lens
from cvcdepth_core.worlds.rendering.renderer import Renderer, View

pytest.importorskip("embreex", reason="worlds need embreex")

LENS = Calibration(width=160, height=96, k=(90, 0, 79.5, 0, 90, 47.5, 0, 0, 1))
K = LENS.raw_intrinsics
MEDIAN_BOUND = 0.015
"""Of the difference of pictures in [0, 1], over static pixels that both show."""


def looking(yaw: float, x: float, y: float) -> np.ndarray:
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    pose = np.eye(4)
    pose[:3, :3] = [[s, 0, c], [-c, 0, s], [0, -1, 0]]
    pose[:3, 3] = x, y, 1.6
    return pose


@pytest.fixture(scope="module")
def drive():
    world, way, _ = build_world(random_world(12, "suburb", 2.0))
    return Renderer(world, way), way


def shown(view: View) -> np.ndarray:
    """A picture in [0, 1] of fixed exposure."""
    return (1 - np.exp(-view.light)) ** (1 / 2.2)


def warped_error(first: View, second: View, second_T_first: np.ndarray) -> np.ndarray:
    """Differences of the pixels of `first` whose places `second` shows too, standing still."""
    v, u = np.mgrid[: LENS.height, : LENS.width]
    depth = first.truth.depth
    known = np.isfinite(depth) & ~first.truth.moving
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    points = np.where(known, depth, 1.0)[..., None] * rays @ second_T_first[:3, :3].T + second_T_first[:3, 3]
    z = np.maximum(points[..., 2], 1e-3)
    x, y = points[..., 0] / z * K[0, 0] + K[0, 2], points[..., 1] / z * K[1, 1] + K[1, 2]
    inside = known & (points[..., 2] > 0.1) & (x > 0) & (y > 0) & (x < LENS.width - 1) & (y < LENS.height - 1)
    maps = x.astype(np.float32), y.astype(np.float32)
    seen = cv2.remap(np.where(np.isfinite(second.truth.depth), second.truth.depth, 1e6), *maps, cv2.INTER_NEAREST)
    visible = (
        inside
        & (np.abs(seen / z - 1) < 0.03)
        & ~cv2.remap(second.truth.moving.astype(np.uint8), *maps, cv2.INTER_NEAREST).astype(bool)
    )
    difference = np.abs(cv2.remap(shown(second), *maps, cv2.INTER_LINEAR) - shown(first)).mean(axis=-1)
    return difference[visible]


def test_the_next_frame_shows_the_same_where_truth_says_so(drive):
    renderer, way = drive
    lens, mount = Lens("front", LENS), looking(0, 1.2, 0.0)
    first, second = (renderer.view(lens, mount, time) for time in (0.5, 0.6))
    second_T_first = inverse(way.pose(0.6) @ mount) @ way.pose(0.5) @ mount
    errors = warped_error(first, second, second_T_first)
    assert np.linalg.norm(second_T_first[:3, 3]) > 0.2
    assert len(errors) > 3000
    assert np.median(errors) < MEDIAN_BOUND
    # A motion that is 30 % wrong does not fit.
    wrong = second_T_first.copy()
    wrong[:3, 3] *= 0.7
    assert np.median(warped_error(first, second, wrong)) > 1.1 * np.median(errors)


def test_a_neighbour_shows_the_same_where_truth_says_so(drive):
    renderer, _ = drive
    lens = Lens("front", LENS)
    mounts = looking(0, 1.2, 0.3), looking(25, 1.0, 0.6)
    first, second = (renderer.view(lens, mount, 0.5) for mount in mounts)
    errors = warped_error(first, second, inverse(mounts[1]) @ mounts[0])
    assert len(errors) > 2000
    assert np.median(errors) < MEDIAN_BOUND
