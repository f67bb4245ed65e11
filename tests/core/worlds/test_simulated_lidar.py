# SPDX-License-Identifier: Apache-2.0
"""Sweeps of the LiDAR: their points lie on the surfaces that cameras see, whatever moves."""

import numpy as np
import pytest
from simple_worlds import FORWARD, LENSES, Standing, simple_world, textured

from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.worlds.rendering.lenses import Lens
from cvcdepth_core.worlds.rendering.lidar import lidar_mount, sweep
from cvcdepth_core.worlds.rendering.renderer import Renderer
from cvcdepth_core.worlds.sensors import Lidar
from cvcdepth_core.worlds.shapes.meshes import box, flat_mesh
from cvcdepth_core.worlds.surfaces.materials import MaterialTable

pytest.importorskip("embreex", reason="worlds need embreex")

LIDAR = Lidar(beams=16, columns=720)
PERIOD = 0.1


def street() -> tuple[Renderer, Standing]:
    table = MaterialTable()
    plain = textured(table)
    ground = flat_mesh([(-300, -300, 0), (300, -300, 0), (300, 300, 0), (-300, 300, 0)], [(0, 1, 2), (0, 2, 3)], plain)
    houses = [box(12, 6, 9, plain).moved(5 + 14 * i, side * 9) for i in range(-3, 4) for side in (-1, 1)]
    way = Standing(speed=12.0, yaw_rate=0.3)
    return Renderer(simple_world([ground, *houses], table), way), way


def world_points(swept: np.ndarray, pose: np.ndarray) -> np.ndarray:
    lidar = pose @ lidar_mount(LIDAR)
    return swept @ lidar[:3, :3].T + lidar[:3, 3]


def test_points_of_a_deskewed_sweep_lie_where_they_were_in_the_world():
    renderer, way = street()
    swept = sweep(renderer.scene, LIDAR, way, 2.0, PERIOD, (0,))
    points = world_points(swept.points, way.pose(2.0))
    on_ground = np.abs(points[:, 2]) < 1e-4
    on_houses = np.abs(np.abs(points[:, 1]) - 6.0) < 1e-4
    assert on_ground.mean() > 0.2
    assert (on_ground | on_houses).mean() > 0.9  # the others are on the houses' ends and roofs


def test_points_of_a_sweep_that_is_not_deskewed_are_told_from_where_each_was_seen():
    renderer, way = street()
    lidar = LIDAR.model_copy(update={"deskewed": False})
    raw, straight = (sweep(renderer.scene, each, way, 2.0, PERIOD, (0,)) for each in (lidar, LIDAR))
    assert np.abs(raw.points - straight.points).max() > 0.3
    for index in (0, len(raw.points) // 3, len(raw.points) - 1):
        then, now = (way.pose(2.0 + seconds) @ lidar_mount(LIDAR) for seconds in (raw.seconds[index], 0.0))
        moved = (inverse(now) @ then @ np.r_[raw.points[index], 1.0])[:3]
        assert moved == pytest.approx(straight.points[index], abs=1e-9)


def test_points_agree_with_the_depth_images_of_a_camera():
    renderer, way = street()
    camera, time, mount = Lens("front", LENSES["no distortion"]), 2.03, FORWARD.copy()
    mount[:3, 3] = 0.9, 0.0, 1.6
    swept = sweep(renderer.scene, LIDAR, way, 2.0, PERIOD, (0,))
    points = (
        inverse(way.pose(time) @ mount) @ np.c_[world_points(swept.points, way.pose(2.0)), np.ones(len(swept.points))].T
    )[:3].T
    ahead = points[points[:, 2] > 1.0]
    K = LENSES["no distortion"].raw_intrinsics
    x, y = (ahead[:, i] / ahead[:, 2] * K[i, i] + K[i, 2] for i in (0, 1))
    inside = (x > 0) & (x < camera.width - 1) & (y > 0) & (y < camera.height - 1)
    x, y, z = x[inside], y[inside], ahead[inside, 2]
    truth = renderer.truth(camera, mount, time)
    errors = interpolated_inverse_depth(truth, x, y) * z - 1
    assert np.isfinite(errors).sum() > 150
    assert np.abs(errors[np.isfinite(errors)]).max() < 1e-4


def interpolated_inverse_depth(truth, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Inverse depth is even over the pixels of a plane; NaN where the four around a place are not of one."""
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = x - column, y - row
    corners = [(0, 0, (1 - u) * (1 - v)), (0, 1, u * (1 - v)), (1, 0, (1 - u) * v), (1, 1, u * v)]
    total = sum(weight / truth.depth[row + dy, column + dx] for dy, dx, weight in corners)
    same = np.ones(len(x), bool)
    for dy, dx, _ in corners:
        same &= truth.objects[row + dy, column + dx] == truth.objects[row, column]
        same &= (truth.normals[row + dy, column + dx] * truth.normals[row, column]).sum(axis=1) > 0.999
    return np.where(same, total, np.nan)


def test_measurements_are_lost_and_noisy_as_told_and_always_the_same():
    renderer, way = street()
    noisy = LIDAR.model_copy(update={"noise": 0.03, "lost": 0.2})
    exact, first, again = (sweep(renderer.scene, each, way, 2.0, PERIOD, (5,)) for each in (LIDAR, noisy, noisy))
    assert len(first.points) == pytest.approx(0.8 * len(exact.points), rel=0.03)
    assert (first.points == again.points).all()
    off = np.abs(world_points(first.points, way.pose(2.0))[:, 2])
    assert 0.001 < np.median(off[off < 0.05]) < 0.02


def test_the_own_vehicle_is_not_measured():
    table = MaterialTable()
    body = box(4.0, 1.7, 1.5, textured(table))
    ground = flat_mesh(
        [(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)], [(0, 1, 2), (0, 2, 3)], textured(table)
    )
    renderer = Renderer(simple_world([ground], table), Standing(), body)
    swept = sweep(renderer.scene, LIDAR.model_copy(update={"nearest": 0.2}), Standing(), 0.0, PERIOD, (0,))
    assert len(swept.points)
    assert np.abs(world_points(swept.points, np.eye(4))[:, 2]).max() < 1e-4
