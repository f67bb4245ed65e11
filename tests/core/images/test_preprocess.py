# SPDX-License-Identifier: Apache-2.0
"""Pictures come to the network straight, where their intrinsics say, without aliasing: shown with rendered scenes."""

import math
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from repository import ROOT

from cvcdepth_core.errors import ImageError, RigError
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_core.images.surround import SurroundPreprocessor, self_occlusion_mask, to_tensor
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.rig import Camera, Rig

WIDTH, HEIGHT = 960, 600
NO_TURN = np.zeros(3)

LENSES: dict[str, dict[str, object]] = {
    # Barrel distortion that moves the corners by more than 100 pixels.
    "plumb_bob": {"k": (560.0, 0, 487.3, 0, 555.0, 291.8, 0, 0, 1), "d": (-0.3, 0.11, 0.001, -0.0015, -0.012)},
    # Coefficients of the kind that factory calibrations of 120 degree automotive cameras carry.
    "rational_polynomial": {
        "k": (600.0, 0, 471.6, 0, 602.0, 305.2, 0, 0, 1),
        "d": (5.1, 1.8, 0.0003, -0.0004, 0.05, 5.5, 3.3, 0.42),
    },
    # A fisheye of 180 degrees.
    "equidistant": {"k": (305.0, 0, 484.1, 0, 304.0, 296.4, 0, 0, 1), "d": (0.06, -0.02, 0.004, -0.0006)},
}
MODELS = sorted(LENSES)


def _calibration(model: str, **changed: object) -> Calibration:
    return Calibration.model_validate(
        {"width": WIDTH, "height": HEIGHT, "distortion_model": model} | LENSES[model] | changed
    )


def _project(calibration: Calibration, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Raw sensor pixels [n, 2] of points [n, 3] in the raw camera, by OpenCV."""
    K, shaped = np.array(calibration.k).reshape(3, 3), points[:, None]
    if calibration.distortion_model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(shaped, NO_TURN, NO_TURN, K, calibration.distortion)
    else:
        pixels, _ = cv2.projectPoints(shaped, NO_TURN, NO_TURN, K, calibration.distortion)
    found: NDArray[np.float64] = pixels[:, 0]
    return found


def _rays(calibration: Calibration, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rays [n, 3] (z = 1) that the raw sensor pixels [n, 2] see, by OpenCV, checked by projecting them again."""
    K, shaped = np.array(calibration.k).reshape(3, 3), np.ascontiguousarray(pixels[:, None])
    undistort = cv2.fisheye.undistortPoints if calibration.distortion_model == "equidistant" else cv2.undistortPoints
    flat = undistort(shaped, K, calibration.distortion)[:, 0]
    for _ in range(60):  # cv2.undistortPoints makes five rounds, which leave pixels at the edge of a strong lens.
        rays = np.column_stack([flat, np.ones(len(flat))])
        error = (_project(calibration, rays) - pixels) * (np.hypot(*flat.T) < 3.0)[:, None]
        if np.abs(error).max() < 0.005:
            return rays
        flat = flat - 1.5 * error / [K[0, 0], K[1, 1]]  # Longer steps, as the lens compresses the edge.
    raise AssertionError("the lens of this test folds: choose other coefficients")


# The board: 13 x 9 squares of 0.2 m, turned a little about all axes and as near as the lens shows it whole.
BOARD_CORNERS = (12, 8)
BOARD_SQUARE = 0.2
BOARD_TURN, _ = cv2.Rodrigues(np.array([0.12, -0.15, 0.05]))
BOARD_DISTANCE = {"plumb_bob": 2.0, "rational_polynomial": 2.2, "equidistant": 1.25}


def _board_centre(model: str) -> NDArray[np.float64]:
    return np.array([0.02, -0.01, BOARD_DISTANCE[model]])


def _board_points(model: str) -> NDArray[np.float64]:
    """Inner corners [96, 3] of the board in the camera, row by row."""
    columns, rows = BOARD_CORNERS
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    flat = BOARD_SQUARE * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return flat @ BOARD_TURN.T + _board_centre(model)


def _board_brightness(model: str, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Brightness [n] in [0, 1] of the board where the rays meet its plane; soft edges stand in for a lens's blur."""
    centre, normal = _board_centre(model), BOARD_TURN[:, 2]
    distance = (centre @ normal) / (rays @ normal)
    x, y, _ = ((rays * distance[:, None] - centre) @ BOARD_TURN / BOARD_SQUARE).T
    columns, rows = BOARD_CORNERS
    # Square waves with soft edges, which change sign exactly at the inner corners.
    wave_x, wave_y = (
        np.clip(12.0 * np.sin(np.pi * (along + (count - 1) / 2)), -1.0, 1.0)
        for along, count in ((x, columns), (y, rows))
    )
    board = 0.5 + 0.5 * wave_x * wave_y
    outside = (np.abs(x) > (columns + 1) / 2) | (np.abs(y) > (rows + 1) / 2) | (distance <= 0)
    return np.where(outside, 1.0, board)


@lru_cache
def _board_picture(model: str) -> NDArray[np.uint8]:
    """What the sensor sees of the board; its edges are softer than a pixel, so one ray for each is enough."""
    u, v = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    rays = _rays(_calibration(model), np.column_stack([u.ravel(), v.ravel()]))
    return np.round(20 + 215 * _board_brightness(model, rays)).astype(np.uint8).reshape(HEIGHT, WIDTH)


def _wider_projection(model: str) -> tuple[float, ...]:
    """Return a P that shows more than K does, as camera_calibration's alpha makes it."""
    calibration = _calibration(model)
    K, size = np.array(calibration.k).reshape(3, 3), (WIDTH, HEIGHT)
    if model == "equidistant":
        new = K * [[0.85], [0.9], [1.0]]
    else:
        new, _ = cv2.getOptimalNewCameraMatrix(K, calibration.distortion, size, 0.5)
    return tuple(np.hstack([new, np.zeros((3, 1))]).ravel().tolist())


def _sent(picture: NDArray[np.uint8], calibration: Calibration) -> NDArray[np.uint8]:
    """What the driver sends of the sensor's picture: the region of interest, binned."""
    x, y, (width, height) = calibration.roi.x_offset, calibration.roi.y_offset, calibration.image_size
    bx, by = calibration.binning_x, calibration.binning_y
    region = picture[y : y + height * by, x : x + width * bx].astype(np.float64)
    return np.round(region.reshape(height, by, width, bx).mean(axis=(1, 3))).astype(np.uint8)


TURN, _ = cv2.Rodrigues(np.array([0.02, 0.04, -0.03]))
LARGE_TURN, _ = cv2.Rodrigues(np.array([0.1, 0.2, -0.1]))
SETTINGS: dict[str, tuple[dict[str, object], tuple[int, int]]] = {
    "full size": ({}, (600, 960)),
    "a ratio that is not whole": ({}, (352, 640)),
    "other proportions": ({}, (384, 512)),
    "binning": ({"binning_x": 2, "binning_y": 2}, (300, 480)),
    "a region of interest": ({"roi": {"x_offset": 35, "y_offset": 21, "width": 900, "height": 560}}, (352, 640)),
    "both": (
        {"roi": {"x_offset": 35, "y_offset": 21, "width": 900, "height": 560}, "binning_x": 2, "binning_y": 1},
        (352, 450),
    ),
    "a rectifying rotation": ({"r": tuple(TURN.ravel().tolist())}, (480, 768)),
}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("setting", [*SETTINGS, "P other than K"])
def test_a_distorted_checkerboard_comes_back_straight_and_where_the_intrinsics_say(model: str, setting: str):
    changed, (height, width) = SETTINGS.get(setting, ({"p": _wider_projection(model)}, (352, 640)))
    calibration = _calibration(model, **changed)
    rectifier = Rectifier(calibration, height, width)
    picture = rectifier(_sent(_board_picture(model), calibration), "front")
    found, corners = cv2.findChessboardCornersSB(picture, BOARD_CORNERS)
    assert found
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    refined = cv2.cornerSubPix(picture, corners.reshape(-1, 1, 2).copy(), (4, 4), (-1, -1), stop)
    grid = _in_board_order(refined.astype(np.float64))
    assert max(_line_residuals(grid)) < 0.25
    projected = _board_points(model) @ calibration.rotation.T @ rectifier.intrinsics.T
    expected = projected[:, :2] / projected[:, 2:]
    assert np.abs(grid.reshape(-1, 2) - expected).max() < 0.25
    assert rectifier.visible[np.round(expected[:, 1]).astype(int), np.round(expected[:, 0]).astype(int)].all()


def _in_board_order(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners [8, 12, 2] from the top left; the detector may begin at the opposite end."""
    columns, rows = BOARD_CORNERS
    grid = corners.reshape(rows, columns, 2)
    return grid if grid[0, 0, 0] < grid[0, -1, 0] else grid[::-1, ::-1]


def _line_residuals(grid: NDArray[np.float64]) -> list[float]:
    """Largest distance of a corner from the straight line through its row or column, for each."""
    residuals = []
    for line in [*grid, *grid.swapaxes(0, 1)]:
        centred = line - line.mean(axis=0)
        normal = np.linalg.svd(centred)[2][1]
        residuals.append(float(np.abs(centred @ normal).max()))
    return residuals


@pytest.mark.parametrize("model", MODELS)
def test_the_rendered_checkerboard_is_bent_before_it_is_rectified(model: str):
    pixels = _project(_calibration(model), _board_points(model)).reshape(BOARD_CORNERS[1], BOARD_CORNERS[0], 2)
    assert max(_line_residuals(pixels)) > 5.0


# Points [n, 3] in front of the camera, spread over its view.
POINTS = np.array([[x, y, 4.0] for x in (-2.3, -1.1, 0.13, 1.2, 2.4) for y in (-1.3, 0.07, 1.4)])


def _picture_of_blobs(pixels: NDArray[np.float64], size: tuple[int, int], sigma: float = 3.0) -> NDArray[np.uint8]:
    """Black picture (width, height) with a soft white blob at each pixel position [n, 2]."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    blobs = (np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2)) for x, y in pixels)
    return np.round(250.0 * np.minimum(sum(blobs), 1.0)).astype(np.uint8)


def _blob_centres(picture: NDArray[np.uint8], near: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Centre of brightness [n, 2] of the blob near each position."""
    centres = []
    for x, y in np.round(near).astype(int):
        window = picture[y - reach : y + reach + 1, x - reach : x + reach + 1].astype(np.float64)
        v, u = np.mgrid[y - reach : y + reach + 1, x - reach : x + reach + 1]
        centres.append([(u * window).sum() / window.sum(), (v * window).sum() / window.sum()])
    return np.array(centres)


@pytest.mark.parametrize("downscale", [1.0, 2.5, 3.0])
@pytest.mark.parametrize("model", [*MODELS, "none"])
def test_known_points_appear_where_the_intrinsics_project_them(model: str, downscale: float):
    no_distortion = {"d": (), "k": (560.0, 0, 487.3, 0, 555.0, 291.8, 0, 0, 1)}
    calibration = _calibration(model) if model != "none" else _calibration("plumb_bob", **no_distortion)
    rectifier = Rectifier(calibration, round(HEIGHT / downscale), round(WIDTH / downscale))
    picture = rectifier(_picture_of_blobs(_project(calibration, POINTS), (WIDTH, HEIGHT)), "front")
    projected = POINTS @ rectifier.intrinsics.T
    expected = projected[:, :2] / projected[:, 2:]
    # Along a blob the lens's magnification changes, which moves its centre a little: not the rectifier's doing.
    tolerance = 0.05 if model == "none" else 0.1
    found = _blob_centres(picture, expected, reach=math.ceil(24 / downscale))
    assert np.abs(found - expected).max() < tolerance


@pytest.mark.parametrize("downscale", [1.0, 2.5, 3.0])
def test_rectified_topics_are_read_with_p_and_without_d(downscale: float):
    P = (470.0, 0, 500.2, 0, 0, 480.0, 280.4, 0, 0, 0, 1, 0)
    calibration = _calibration("plumb_bob", p=P, r=tuple(TURN.ravel().tolist()))
    rectifier = Rectifier(calibration, round(HEIGHT / downscale), round(WIDTH / downscale), rectified=True)
    homogeneous = np.column_stack([POINTS, np.ones(len(POINTS))]) @ np.array(P).reshape(3, 4).T
    picture = rectifier(_picture_of_blobs(homogeneous[:, :2] / homogeneous[:, 2:], (WIDTH, HEIGHT)), "front")
    projected = POINTS @ rectifier.intrinsics.T
    expected = projected[:, :2] / projected[:, 2:]
    found = _blob_centres(picture, expected, reach=math.ceil(24 / downscale))
    assert np.abs(found - expected).max() < 0.05
    assert rectifier.visible.all()


def _plain(width: int, height: int) -> Calibration:
    return Calibration(width=width, height=height, k=(0.6 * width, 0, width / 2, 0, 0.6 * width, height / 2, 0, 0, 1))


def _striped(period: float, width: int, height: int) -> NDArray[np.uint8]:
    wave = np.cos(2 * np.pi * (np.arange(width) + 0.5) / period)
    return np.repeat(np.round(127.5 + 127.5 * wave).astype(np.uint8)[None], height, axis=0)


@pytest.mark.parametrize(("period", "downscale"), [(2, 2), (2, 4), (3, 3), (4, 4), (1.5, 3), (2.5, 2.5)])
def test_stripes_as_fine_as_a_network_pixel_turn_grey(period: float, downscale: float):
    picture = _striped(period, 960, 120)
    rectified = Rectifier(_plain(960, 120), round(120 / downscale), round(960 / downscale))(picture, "front")
    inner = rectified[:, 2:-2].astype(float)
    assert np.abs(inner - inner.mean()).max() <= 3
    assert inner.mean() == pytest.approx(picture.mean(), abs=2)


@pytest.mark.parametrize("size", [(320, 320), (384, 384), (352, 352), (192, 192), (160, 160)])
def test_a_zone_plate_aliases_no_more_than_with_area_averaging(size: tuple[int, int]):
    radius_squared = np.square(np.arange(960) - 479.5)
    rings = np.cos(np.pi / 960 * (radius_squared[:, None] + radius_squared))
    picture = np.round(127.5 + 127.5 * rings).astype(np.uint8)
    found = Rectifier(_plain(960, 960), *size)(picture, "front").astype(float)
    area = cv2.resize(picture, size[::-1], interpolation=cv2.INTER_AREA).astype(float)
    nearest = cv2.resize(picture, size[::-1], interpolation=cv2.INTER_LINEAR).astype(float)
    # At the edge of the plate the rings are as fine as the picture's pixels: what is left there is aliasing.
    edge = np.s_[: size[0] // 5, :]
    assert found[edge].std() <= 1.1 * area[edge].std()
    assert found[edge].std() < 0.5 * nearest[edge].std()


def _psnr(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    return 10 * math.log10(255.0**2 / float(np.mean((a.astype(float) - b) ** 2)))


@pytest.fixture(scope="module")
def street() -> NDArray[np.uint8]:
    """A real picture, 960 x 540, from the sample recording."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    sample = ROOT / "samples" / "pandaset_002_excerpt"
    with AnyReader([sample], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as recording:
        connections = [c for c in recording.connections if c.topic == "/camera/front_left/image_raw/compressed"]
        connection, _, raw = next(recording.messages(connections))
        message = recording.deserialize(raw, connection.msgtype)
    picture: NDArray[np.uint8] = cv2.imdecode(message.data, cv2.IMREAD_COLOR)
    return picture


@pytest.mark.parametrize("size", [(180, 320), (270, 480), (135, 240)])
def test_without_distortion_a_whole_ratio_is_area_averaging(street: NDArray[np.uint8], size: tuple[int, int]):
    found = Rectifier(_plain(960, 540), *size)(street, "front")
    area = cv2.resize(street, size[::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(found.astype(int) - area).max() <= 1


@pytest.mark.parametrize(("size", "reduction"), [((192, 320), 1), ((135, 240), 2), ((96, 160), 2), ((64, 96), 4)])
def test_a_much_finer_picture_is_reduced_first_by_the_decoder_or_here(
    street: NDArray[np.uint8], size: tuple[int, int], reduction: int
):
    rectifier = Rectifier(_plain(960, 540), *size)
    assert rectifier.reduction == reduction
    area = cv2.resize(street, size[::-1], interpolation=cv2.INTER_AREA)
    whole = rectifier(street, "front")
    assert _psnr(whole, area) > 40
    reduced = cv2.resize(street, (960 // reduction, 540 // reduction), interpolation=cv2.INTER_AREA)
    assert np.array_equal(rectifier(reduced, "front", rectifier.reduction), whole)


def test_a_reduced_picture_of_another_size_is_refused_by_name():
    rectifier = Rectifier(_plain(960, 540), 96, 160)
    with pytest.raises(ImageError, match=r"front: image of 960x540, but its camera_info says 960x540 / 2"):
        rectifier(np.zeros((540, 960, 3), np.uint8), "front", 2)
    with pytest.raises(ImageError, match=r"front: image of 480x270, but its camera_info says 960x540"):
        rectifier(np.zeros((270, 480, 3), np.uint8), "front")


def test_without_distortion_at_full_size_nothing_changes(street: NDArray[np.uint8]):
    assert np.array_equal(Rectifier(_plain(960, 540), 540, 960)(street, "front"), street)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("size", [(180, 320), (192, 320), (224, 416), (352, 640), (96, 160), (128, 224)])
def test_one_resampling_is_as_good_as_rectifying_at_full_size_first(
    street: NDArray[np.uint8], model: str, size: tuple[int, int]
):
    calibration = _calibration(model, height=540)
    K, D = calibration.raw_intrinsics, calibration.distortion
    build = cv2.fisheye.initUndistortRectifyMap if model == "equidistant" else cv2.initUndistortRectifyMap
    maps = build(K, D, np.eye(3), K, (960, 540), cv2.CV_32FC1)
    # Cubic, since the reference must not blur twice.
    straight = cv2.remap(street, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    reference = cv2.resize(straight, size[::-1], interpolation=cv2.INTER_AREA)
    rectifier = Rectifier(calibration, *size)
    least = 46 if rectifier.reduction == 1 else 43
    assert _psnr(rectifier(street, "front")[rectifier.visible], reference[rectifier.visible]) > least


@pytest.mark.parametrize("model", MODELS)
def test_visible_is_false_exactly_outside_the_raw_picture(model: str):
    zoomed_out = (260.0, 0, 480.0, 0, 0, 260.0, 300.0, 0, 0, 0, 1, 0)
    calibration = _calibration(model, p=zoomed_out, r=tuple(LARGE_TURN.ravel().tolist()))
    rectifier = Rectifier(calibration, 300, 480)
    u, v = np.meshgrid(np.arange(480), np.arange(300))
    rectified_rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ np.linalg.inv(rectifier.intrinsics).T
    rays = rectified_rays @ calibration.rotation  # the transpose's, from the rectified camera to the raw one
    x, y = _project(calibration, rays).T
    margin = np.minimum.reduce([x + 0.5, WIDTH - 0.5 - x, y + 0.5, HEIGHT - 0.5 - y]).reshape(300, 480)
    # A network pixel covers about two raw ones and is visible when all of it is.
    reach = 2.0 * 560 / 260
    unfolded = (np.hypot(*rays[:, :2].T) / rays[:, 2]).reshape(300, 480) < _folding_radius(calibration)
    assert rectifier.visible[(margin > reach) & unfolded].all()
    assert not rectifier.visible[(margin < -0.1) | ~unfolded].any()
    assert 0.2 < rectifier.visible.mean() < 0.95 or model == "equidistant"


def _folding_radius(calibration: Calibration) -> float:
    radii = np.linspace(0.0, 5.0, 5001)
    points = np.column_stack([radii, np.zeros_like(radii), np.ones_like(radii)])
    shrinks = np.diff(_project(calibration, points)[:, 0]) <= 0
    return float(radii[np.argmax(shrinks)]) if shrinks.any() else math.inf


def test_a_picture_that_the_lens_model_would_show_twice_is_not_visible_the_second_time():
    zoomed_out = (250.0, 0, 480.0, 0, 0, 250.0, 300.0, 0, 0, 0, 1, 0)
    calibration = Calibration(
        width=WIDTH, height=HEIGHT, k=(560.0, 0, 480, 0, 560, 300, 0, 0, 1), d=(-0.3, 0, 0, 0), p=zoomed_out
    )
    rectifier = Rectifier(calibration, HEIGHT, WIDTH)
    # r (1 - 0.3 r^2) turns back at r = 1 / sqrt(0.9) = 1.054, that is 263.5 pixels from the centre; on the row through
    # the centre it comes back into the picture further out.
    last = 480 + 263
    assert rectifier.visible[300, 480 : last - 1].all()
    assert not rectifier.visible[300, last + 2 :].any()


def test_a_picture_of_another_size_than_camera_info_says_is_refused_by_name():
    rectifier = Rectifier(_plain(960, 540), 180, 320)
    with pytest.raises(ImageError, match="camera rear: image of 1920x1080, but its camera_info says 960x540"):
        rectifier(np.zeros((1080, 1920, 3), np.uint8), "rear")


def _rig(mask: Path | None, rectified: bool = False) -> Rig:
    cameras = tuple(Camera(name, _plain(96, 64), np.eye(4), rectified, mask) for name in ("front", "rear"))
    return Rig(cameras, "base_link", "front", {})


def _write_mask(path: Path, hidden_rows: int, size: tuple[int, int] = (96, 64)) -> Path:
    mask = np.full(size[::-1], 255, np.uint8)
    mask[size[1] - hidden_rows :] = 0
    path.write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    return path


def test_masks_are_resized_like_the_picture_and_stay_soft(tmp_path: Path):
    camera = _rig(_write_mask(tmp_path / "mask.png", hidden_rows=13)).cameras[0]
    mask = self_occlusion_mask(camera, Rectifier(camera.calibration, 32, 48))
    assert mask.shape == (32, 48)
    assert mask.dtype == np.float32
    # 13 raw rows are six and a half of the network's.
    assert mask[:25].min() == 1.0
    assert mask[25] == pytest.approx(np.full(48, 0.5), abs=0.01)
    assert mask[26:].max() == 0.0


def test_without_a_mask_everything_is_valid():
    camera = _rig(None).cameras[0]
    assert np.array_equal(self_occlusion_mask(camera, Rectifier(camera.calibration, 32, 48)), np.ones((32, 48)))


def test_what_the_vehicle_hides_is_not_valid(tmp_path: Path):
    preprocessor = SurroundPreprocessor(_rig(_write_mask(tmp_path / "mask.png", hidden_rows=16)), 32, 48)
    assert preprocessor.valid.shape == (2, 32, 48)
    assert preprocessor.valid[:, :24].all()
    assert not preprocessor.valid[:, 24:].any()


@pytest.mark.parametrize(
    ("content", "found"),
    [(b"not an image", "is not an image"), (b"", "cannot be read|is not an image"), (None, "cannot be read")],
)
def test_a_mask_that_cannot_be_read_is_refused_with_file_and_camera(tmp_path: Path, content: bytes | None, found: str):
    path = tmp_path / "mask.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RigError, match=f"camera front: mask .*mask.png ({found})") as error:
        SurroundPreprocessor(_rig(path), 32, 48)
    assert "\n" not in str(error.value).strip()


def test_a_mask_of_another_size_is_refused_with_file_and_camera(tmp_path: Path):
    path = _write_mask(tmp_path / "mask.png", hidden_rows=2, size=(48, 32))
    with pytest.raises(RigError, match=r"mask .*mask\.png: camera front: image of 48x32, .* says 96x64"):
        SurroundPreprocessor(_rig(path), 32, 48)


def test_a_rigs_pictures_become_one_tensor_between_0_and_1():
    preprocessor = SurroundPreprocessor(_rig(None), 32, 48)
    pictures = [np.full((64, 96, 3), colour, np.uint8) for colour in [(255, 0, 51), (0, 102, 255)]]
    tensor = to_tensor([preprocessor.rectify(i, picture) for i, picture in enumerate(pictures)])
    assert tensor.shape == (2, 3, 32, 48)
    assert tensor.dtype == torch.float32
    assert tensor.is_contiguous()
    assert tensor[:, :, 16, 24].tolist() == [pytest.approx([1.0, 0.0, 0.2]), pytest.approx([0.0, 0.4, 1.0])]
    assert preprocessor.intrinsics.shape == (2, 3, 3)
    with pytest.raises(ImageError, match="camera rear"):
        preprocessor.rectify(1, pictures[0][:10])
