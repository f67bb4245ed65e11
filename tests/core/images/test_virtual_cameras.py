# SPDX-License-Identifier: Apache-2.0
"""Views of a fisheye's pictures are what a pinhole camera in their place sees, picture and depth, at all angles.

The world is a room with waves on its walls, whose picture and depth have a closed form for every ray.
"""

import math

import numpy as np
import pytest

from cvcdepth_core.estimator import SurroundDepthEstimator
from cvcdepth_core.images.rectifier import Rectifier, raw_pixels
from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.pinhole import pixel_rays
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout
from cvcdepth_core.rig.view import View
from cvcdepth_core.rig.wide_lenses import with_views
from cvcdepth_core.scoring.references import FixedDepth

D = (0.02, -0.004, 0.001, -0.0001)
HALF = math.radians(100)
WIDTH, HEIGHT = 800, 500
SIZE = (96, 160)  # of the network's pictures
WALLS = np.array([[-6.0, -5.0, -1.5], [9.0, 7.0, 4.0]])


def polynomial(angle: np.ndarray | float) -> np.ndarray | float:
    return angle * (1 + D[0] * angle**2 + D[1] * angle**4 + D[2] * angle**6 + D[3] * angle**8)


F = WIDTH / 2 / polynomial(HALF)
LENS = Calibration(
    width=WIDTH, height=HEIGHT, distortion_model="equidistant", d=D, k=(F, 0, 397.3, 0, F, 252.1, 0, 0, 1)
)


def mount(yaw: float, pitch: float) -> np.ndarray:
    y, p = math.radians(yaw), math.radians(pitch)
    turn = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    tilt = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ tilt @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, 3] = 0.5, -0.3, 0.2
    return pose


MOUNT = mount(20, 15)


def distances(ways: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Metres along the rays [..., 3] of unit length from a place in the room to its walls."""
    with np.errstate(divide="ignore"):
        ends = (WALLS[:, None, None] - place) / ways
    return np.where(ends > 0, ends, np.inf).min(axis=(0, -1))


def seen(ways: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Picture [h, w, 3]: waves on the walls in two channels, the distance in the third."""
    far = distances(ways, place)
    x, y, z = np.moveaxis(place + far[..., None] * ways, -1, 0)
    waves = 128 + 100 * np.stack([np.sin(1.3 * x + 0.9 * z), np.cos(1.1 * y - 0.8 * z)])
    return np.rint(np.moveaxis(np.concatenate([waves, [12 * far]]), 0, -1)).astype(np.uint8)


def fisheye_ways() -> np.ndarray:
    """Unit vectors through the pixels of the raw picture, in the vehicle's frame."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    x, y = (u - 397.3) / F, (v - 252.1) / F
    radius = np.hypot(x, y)
    table = np.linspace(0, math.pi * 0.75, 400_001)
    angle = np.interp(radius, polynomial(table), table)
    rays = np.stack([x * np.sin(angle) / radius, y * np.sin(angle) / radius, np.cos(angle)], axis=-1)
    return rays @ MOUNT[:3, :3].T


@pytest.fixture(scope="module")
def raw() -> np.ndarray:
    return seen(fisheye_ways(), MOUNT[:3, 3])


def layout_of(**changes: object) -> RigLayout:
    camera = CameraEntry(
        name="front", image_topic="/image", camera_info_topic="/camera_info", calibration=LENS,
        base_T_camera=PoseEntry.from_matrix(MOUNT),
    ).model_copy(update=changes)  # fmt: skip
    return RigLayout(cameras=(camera,))


def virtual_cameras() -> Rig:
    return with_views(layout_of(), {"front": 200.0}).complete()


def pinhole_ways(camera: Camera, intrinsics: np.ndarray, height: int, width: int) -> np.ndarray:
    rays = pixel_rays(intrinsics, height, width).astype(np.float64)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ camera.base_T_camera[:3, :3].T


@pytest.mark.parametrize("index", [0, 1, 2], ids=["left", "middle", "right"])
def test_a_view_shows_what_a_pinhole_camera_in_its_place_sees(raw: np.ndarray, index: int):
    rig = virtual_cameras()
    prepared, camera = SurroundPreprocessor(rig, *SIZE), rig.cameras[index]
    picture, shown = prepared.rectify(index, raw), prepared.valid[index]
    ways = pinhole_ways(camera, prepared.intrinsics[index], *SIZE)
    wanted = seen(ways, camera.base_T_camera[:3, 3]).astype(float)
    axis = MOUNT[:3, 2]
    assert (ways @ axis)[shown].min() < (-0.1 if index != 1 else 1)  # the outer ones see what lies behind the lens
    assert shown.mean() > 0.8
    assert np.median(abs(picture - wanted)[shown]) <= 1
    assert np.quantile(abs(picture - wanted)[shown], 0.99) <= 8  # at the edges of the room
    beside = np.roll(picture, 1, axis=1)
    assert abs(beside - wanted)[shown].mean() > 2 * abs(picture - wanted)[shown].mean()


def test_the_depth_of_a_view_is_that_along_its_own_axis(raw: np.ndarray):
    rig = virtual_cameras()
    prepared = SurroundPreprocessor(rig, *SIZE)
    for index, camera in enumerate(rig.cameras):
        metres = prepared.rectify(index, raw)[..., 2] / 12
        ways = pinhole_ways(camera, prepared.intrinsics[index], *SIZE)
        along = ways @ camera.base_T_camera[:3, 2]
        truth = distances(ways, camera.base_T_camera[:3, 3]) * along
        errors = abs(metres * along / truth - 1)[prepared.valid[index]]
        assert np.quantile(errors, 0.95) < 0.02


def test_what_the_lens_does_not_see_is_nan_in_depth(raw: np.ndarray):
    left, beyond, right = with_views(layout_of(), {"front": 200.0}).cameras
    beyond = beyond.model_copy(update={"view": View(hfov=110, yaw=80)})
    rig = RigLayout(cameras=(left, beyond, right)).complete()
    prepared = SurroundPreprocessor(rig, *SIZE)
    depth = (
        SurroundDepthEstimator(rig, FixedDepth(*_constant(rig)))
        .estimate([prepared.rectify(index, raw) for index in range(3)])
        .depth
    )
    for index, camera in enumerate(rig.cameras):
        ways = pinhole_ways(camera, prepared.intrinsics[index], *SIZE)
        in_raw = ways @ MOUNT[:3, :3]
        angle = np.arctan2(np.hypot(in_raw[..., 0], in_raw[..., 1]), in_raw[..., 2])
        scale = F * polynomial(angle) / np.hypot(in_raw[..., 0], in_raw[..., 1])
        u, v = 397.3 + scale * in_raw[..., 0], 252.1 + scale * in_raw[..., 1]
        outside = (u < -6) | (u > WIDTH + 5) | (v < -6) | (v > HEIGHT + 5)
        inside = (u > 6) & (u < WIDTH - 7) & (v > 6) & (v < HEIGHT - 7)
        assert np.isnan(depth[index][outside]).all()
        assert np.isfinite(depth[index][inside]).all()
        assert outside.any() == (index == 1)


def _constant(rig: Rig) -> tuple:
    intrinsics = SurroundPreprocessor(rig, *SIZE).intrinsics
    return np.full((3, *SIZE), 5.0, np.float32), intrinsics[:, 0, 0], "constant"


@pytest.mark.parametrize("yaw", [60.0, -60.0])
def test_a_pixel_of_the_raw_picture_is_found_in_a_turned_view_unless_it_lies_behind(yaw: float):
    layout = layout_of(view=View(hfov=70, yaw=yaw))
    (camera,) = layout.complete().cameras
    rectifier = Rectifier(camera.calibration, *SIZE)
    found = raw_pixels(camera.calibration, False, rectifier.intrinsics)
    ways = fisheye_ways() @ camera.base_T_camera[:3, :3]
    ahead = ways[..., 2] > 0.05
    wanted = (ways / ways[..., 2:])[ahead] @ rectifier.intrinsics.T
    np.testing.assert_allclose(found[ahead], wanted[:, :2], rtol=1e-3, atol=0.05)
    assert (found[ways[..., 2] < -1e-3] < -1e5).all()


def test_what_a_turned_view_of_a_pinhole_has_behind_it_is_not_shown_twice():
    plain = Calibration(width=200, height=100, k=(40, 0, 99.5, 0, 40, 49.5, 0, 0, 1))  # 136 degrees
    (camera,) = layout_of(calibration=plain, view=View(hfov=100, yaw=100)).complete().cameras
    rectifier = Rectifier(camera.calibration, *SIZE)
    rays = pixel_rays(rectifier.intrinsics, *SIZE) @ camera.calibration.rotation
    assert not rectifier.visible[rays[..., 2] <= 0].any()
    assert (rays[..., 2] <= 0).any()


ASPECTS = {"crop": 0.0, "pad": 0.2, "stretch": 0.0}


@pytest.mark.parametrize(("aspect", "empty"), ASPECTS.items(), ids=ASPECTS)
def test_a_picture_of_another_shape_keeps_its_pixels_square(aspect: str, empty: float):
    lens = Calibration(width=640, height=480, k=(400, 0, 319.5, 0, 400, 239.5, 0, 0, 1))
    layout = layout_of(calibration=lens).model_copy(update={"aspect": aspect})
    rig = layout.complete()
    prepared = SurroundPreprocessor(rig, *SIZE)
    fx, fy = prepared.intrinsics[0].diagonal()[:2]
    assert fx / fy == pytest.approx(1.25 if aspect == "stretch" else 1.0)
    assert 1 - prepared.valid.mean() == pytest.approx(empty, abs=0.02)
    ways = pixel_rays(lens.raw_intrinsics, 480, 640).astype(np.float64)
    ways = ways / np.linalg.norm(ways, axis=-1, keepdims=True) @ MOUNT[:3, :3].T
    picture = prepared.rectify(0, seen(ways, MOUNT[:3, 3])).astype(float)
    wanted = seen(pinhole_ways(rig.cameras[0], prepared.intrinsics[0], *SIZE), MOUNT[:3, 3])
    assert np.quantile(abs(picture - wanted)[prepared.valid[0]], 0.9) <= 2
