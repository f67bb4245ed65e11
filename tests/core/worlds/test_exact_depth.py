# SPDX-License-Identifier: Apache-2.0
"""Depth, objects and normals of simple shapes against closed forms, for every camera model."""

import numpy as np
import pytest
from simple_worlds import FORWARD, LENSES, Standing, simple_world, textured

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.worlds.rendering.lenses import Lens
from cvcdepth_core.worlds.rendering.renderer import Renderer
from cvcdepth_core.worlds.shapes.meshes import box, flat_mesh, sphere
from cvcdepth_core.worlds.surfaces.materials import MaterialTable
from cvcdepth_core.worlds.world import Mover

pytest.importorskip("embreex", reason="worlds need embreex")

TABLE = MaterialTable()
PLAIN = textured(TABLE)
PRECISION = 1e-5


def camera_at(height: float, pitch: float = 0.0) -> np.ndarray:
    c, s = np.cos(pitch), np.sin(pitch)
    base_T_camera = FORWARD.copy()
    base_T_camera[:3, :3] = FORWARD[:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    base_T_camera[:3, 3] = 0.3, -0.2, height
    return base_T_camera


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_the_depth_of_planes_is_exact(lens: Calibration):
    ground = flat_mesh([(-500, -500, 0), (500, -500, 0), (500, 500, 0), (-500, 500, 0)], [(0, 1, 2), (0, 2, 3)], PLAIN)
    wall = flat_mesh([(30, -90, -5), (30, 90, -5), (30, 90, 60), (30, -90, 60)], [(0, 1, 2), (0, 2, 3)], PLAIN)
    camera, mount = Lens("front", lens), camera_at(1.6, pitch=-0.1)
    truth = Renderer(simple_world([ground, wall], TABLE), Standing()).truth(camera, mount, 0.0)
    rays = np.moveaxis(camera.centre_rays, 0, -1)
    ways = rays @ mount[:3, :3].T
    with np.errstate(divide="ignore"):
        to_ground = np.where(ways[..., 2] < 0, -mount[2, 3] / ways[..., 2], np.inf)
        to_wall = np.where(ways[..., 0] > 0, (30 - mount[0, 3]) / ways[..., 0], np.inf)
    wanted = np.minimum(to_ground, to_wall) * rays[..., 2]
    assert np.abs(truth.depth / wanted - 1).max() < PRECISION
    assert (truth.objects == np.where(to_ground < to_wall, 2, 3)).mean() > 0.999
    assert np.allclose(truth.normals[truth.objects == 2], (0, 0, 1), atol=1e-6)
    assert np.allclose(truth.normals[truth.objects == 3], (-1, 0, 0), atol=1e-6)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_the_depth_of_boxes_is_exact_and_there_is_sky_beside_them(lens: Calibration):
    size, middle = np.array([2.0, 3.0, 1.5]), np.array([9.0, 1.0, 1.45])
    mesh = box(*size, PLAIN).moved(9.0, 1.0, 0.7)
    camera, mount = Lens("front", lens), camera_at(1.9)
    truth = Renderer(simple_world([mesh], TABLE), Standing()).truth(camera, mount, 0.0)
    rays = np.moveaxis(camera.centre_rays, 0, -1)
    ways = rays @ mount[:3, :3].T
    with np.errstate(divide="ignore"):
        bounds = np.stack([(middle + sign * size / 2 - mount[:3, 3]) / ways for sign in (-1, 1)])
    near, far = bounds.min(axis=0).max(axis=-1), bounds.max(axis=0).min(axis=-1)
    wanted = np.where(near < far, near * rays[..., 2], np.inf)
    inside = np.isfinite(wanted) & np.isfinite(truth.depth)
    assert inside.sum() > 20
    assert (np.isfinite(wanted) == np.isfinite(truth.depth)).mean() > 0.999
    assert np.abs(truth.depth[inside] / wanted[inside] - 1).max() < PRECISION
    assert (truth.objects[np.isinf(truth.depth)] == 0).all()
    assert (truth.normals[np.isinf(truth.depth)] == 0).all()


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_the_depth_of_spheres_is_exact_up_to_their_facets(lens: Calibration):
    centre, radius = np.array([20.0, 0.5, 1.6]), 4.0
    # 327 680 facets: their middles lie 2e-5 radii below the sphere.
    ball = sphere(radius, PLAIN, 7).moved(*centre)
    camera, mount = Lens("front", lens), camera_at(1.6)
    truth = Renderer(simple_world([ball], TABLE), Standing()).truth(camera, mount, 0.0)
    rays = np.moveaxis(camera.centre_rays, 0, -1)
    ways = rays @ mount[:3, :3].T
    along = ways @ (centre - mount[:3, 3])
    rest = along**2 - ((centre - mount[:3, 3]) ** 2).sum() + radius**2
    clear = rest > 4.0  # not at the outline, where facets are seen from the side
    wanted = (along - np.sqrt(np.maximum(rest, 0))) * rays[..., 2]
    assert clear.sum() > 50
    assert np.abs(truth.depth[clear] / wanted[clear] - 1).max() < PRECISION
    assert np.isinf(truth.depth[rest < -4.0]).all()


def test_movers_are_where_they_are_at_the_moment_and_are_told_from_what_stands():
    mover = Mover(3, box(1.0, 2.0, 2.0, PLAIN), Standing(speed=2.0, start=(5.0, 0.0, 0.0)))
    parked = Mover(4, box(1.0, 2.0, 2.0, PLAIN), Standing(start=(8.0, 3.0, 0.0)))
    wall = flat_mesh([(30, -90, -5), (30, 90, -5), (30, 90, 60), (30, -90, 60)], [(0, 1, 2), (0, 2, 3)], PLAIN)
    renderer = Renderer(simple_world([wall], TABLE, [mover, parked]), Standing())
    camera = Lens("front", LENSES["no distortion"])
    for time in (0.0, 1.25, 0.5):
        truth = renderer.truth(camera, camera_at(1.0), time)
        on_mover = truth.objects == 3
        assert on_mover.sum() > 10
        assert truth.depth[on_mover].min() == pytest.approx(5.0 + 2.0 * time - 0.5 - 0.3, rel=1e-6)
        assert (truth.moving == on_mover).all()
        assert (truth.objects == 4).any()


def test_the_own_body_is_an_object_of_its_own_and_moves_with_the_camera():
    wall = flat_mesh([(60, -90, -50), (60, 90, -50), (60, 90, 60), (60, -90, 60)], [(0, 1, 2), (0, 2, 3)], PLAIN)
    bonnet = box(1.0, 1.4, 0.9, PLAIN).moved(1.5)
    renderer = Renderer(simple_world([wall], TABLE), Standing(speed=3.0), bonnet)
    camera = Lens("front", LENSES["no distortion"])
    first, later = (renderer.truth(camera, camera_at(1.3), time) for time in (0.0, 2.0))
    own = first.objects == 1
    assert own.any()
    assert (own == (later.objects == 1)).all()
    assert np.abs(first.depth[own] - later.depth[own]).max() < 1e-5
    assert later.depth[~own] == pytest.approx(first.depth[~own] - 6.0, rel=1e-6)


def test_rows_of_a_rolling_shutter_see_the_world_at_their_own_times():
    wall = flat_mesh([(40, -90, -50), (40, 90, -50), (40, 90, 60), (40, -90, 60)], [(0, 1, 2), (0, 2, 3)], PLAIN)
    renderer = Renderer(simple_world([wall], TABLE), Standing(speed=10.0))
    camera = Lens("front", LENSES["no distortion"])
    truth = renderer.truth(camera, camera_at(1.6), 1.0, readout=0.05)
    times = 1.0 + ((np.arange(camera.height) + 0.5) / camera.height - 0.5) * 0.05
    wanted = np.broadcast_to(40 - 0.3 - 10.0 * times[:, None], truth.depth.shape)
    assert truth.depth == pytest.approx(wanted, rel=1e-6)


def test_rays_of_distorted_pixels_are_those_that_opencv_projects_there():
    import cv2

    for calibration in LENSES.values():
        rays = Lens("front", calibration).through(np.array([[0.0, 0.0], [63.0, 39.0], [31.2, 19.4], [10.0, 33.0]]))
        fisheye = calibration.distortion_model == "equidistant"
        project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
        found, _ = project(
            rays[:, None] / rays[:, None, 2:],
            np.zeros(3),
            np.zeros(3),
            calibration.raw_intrinsics,
            calibration.distortion,
        )
        assert found[:, 0] == pytest.approx(np.array([[0.0, 0.0], [63.0, 39.0], [31.2, 19.4], [10.0, 33.0]]), abs=1e-4)


def test_a_lens_that_cannot_be_inverted_at_the_border_is_named_with_the_pixel():
    folded = Calibration(width=640, height=400, d=(-0.6, 0.05, 0, 0, 0), k=(300, 0, 319.5, 0, 300, 199.5, 0, 0, 1))
    with pytest.raises(RigError, match=r"camera left: plumb_bob with d = \[-0\.6, 0\.05.*at pixel \(.*of 640x400"):
        Lens("left", folded)


def test_a_rectified_cameras_rays_are_those_of_its_projection_matrix():
    calibration = Calibration(
        width=64, height=40, d=(-0.3, 0.1, 0, 0, 0), k=(40, 0, 31, 0, 41, 19, 0, 0, 1),
        p=(50, 0, 30, 0, 0, 50, 20, 0, 0, 0, 1, 0),
    )  # fmt: skip
    ray = Lens("front", calibration, rectified=True).through(np.array([[55.0, 30.0]]))[0]
    assert ray / ray[2] == pytest.approx([0.5, 0.2, 1.0])
