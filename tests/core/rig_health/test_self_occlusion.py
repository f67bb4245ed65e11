# SPDX-License-Identifier: Apache-2.0
"""The vehicle's own body is found in its recordings, and nothing else is."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import SAMPLE

from cvcdepth_core.images.rectifier import Rectifier, raw_pixels
from cvcdepth_core.images.surround import self_occlusion_mask
from cvcdepth_core.rig.calibration import Calibration, calibration_from_fields
from cvcdepth_core.rig.rig import Camera
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout, load_rig_layout
from cvcdepth_core.rig.view import View
from cvcdepth_core.rig_health.own_body import MIN_PAIRS, SelfOcclusionFinder
from cvcdepth_ros.bag_replay import main


@pytest.fixture(scope="module")
def masked_rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    assert main(["rig", str(SAMPLE), "-o", str(path), "--masks"]) == 0
    return path


def test_the_back_cameras_own_roof_is_found_and_no_other_camera_sees_the_vehicle(masked_rig: Path):
    masks = {camera.name: camera.mask for camera in load_rig_layout(masked_rig).cameras}
    assert {name for name, mask in masks.items() if mask} == {"back"}
    mask = cv2.imread(str(masks["back"]), cv2.IMREAD_GRAYSCALE)
    height = len(mask)
    assert set(np.unique(mask)) == {0, 255}
    # The excerpt has nine pairs only, in which a reflection on the roof counts as moving.
    assert (mask[round(0.9 * height) :] == 0).mean() > 0.75, "the roof fills the image's lowest tenth"
    assert (mask[: round(0.7 * height)] == 255).all(), "the road above it is scene"


def test_masks_lie_beside_the_rig_file_and_move_with_it(masked_rig: Path):
    assert "mask: rig_masks/back.png" in masked_rig.read_text()


def scene_found(rig_file: Path, moving: np.ndarray, contrast: np.ndarray | float = 1.0) -> np.ndarray:
    """Feed noise of some `contrast`, redrawn where `moving` [H, W] of every camera, standing still elsewhere."""
    layout = load_rig_layout(rig_file)
    unmasked = tuple(camera.model_copy(update={"mask": None}) for camera in layout.cameras)
    finder = SelfOcclusionFinder(layout.model_copy(update={"cameras": unmasked}).complete())
    return scene_of(finder, moving, contrast)


def scene_of(finder: SelfOcclusionFinder, moving: np.ndarray, contrast: np.ndarray | float = 1.0) -> np.ndarray:
    cameras, height, width = finder.preprocessor.valid.shape
    random = np.random.default_rng(0)

    def textures() -> np.ndarray:
        coarse = random.integers(0, 255, (cameras, height // 4, width // 4, 3), dtype=np.uint8)
        full = np.stack([cv2.resize(picture, (width, height)) for picture in coarse]).astype(np.float64)
        return np.rint(100 + np.asarray(contrast)[..., None] * (full - 127)).astype(np.uint8)

    still = textures()
    for _ in range(MIN_PAIRS):
        earlier, later = (np.where(moving[None, ..., None], textures(), still) for _ in range(2))
        finder.add(list(earlier), list(later))
    return finder.scene()


def test_a_still_strip_that_reaches_the_border_is_the_vehicle(masked_rig: Path):
    moving = np.ones((216, 384), dtype=bool)
    moving[170:] = False
    scene = scene_found(masked_rig, moving)
    assert not scene[:, 180:].any()
    assert scene[:, :155].all()


def test_a_body_at_the_lower_border_of_what_a_fisheye_shows_is_the_vehicle():
    lens = Calibration(
        width=640, height=320, distortion_model="equidistant", d=(0.0,) * 4, k=(290, 0, 319.5, 0, 290, 159.5, 0, 0, 1)
    )
    pose = PoseEntry(translation=(1.0, 0.0, 1.5), rotation=(-0.5, 0.5, -0.5, 0.5))
    camera = CameraEntry(
        name="front", image_topic="/image", camera_info_topic="/info", calibration=lens, base_T_camera=pose,
        view=View(hfov=120),
    )  # fmt: skip
    finder = SelfOcclusionFinder(RigLayout(cameras=(camera,)).complete())
    (shown,) = finder.preprocessor.valid
    bottom = len(shown) - 1 - shown[::-1].argmax(axis=0)
    assert bottom[192] < len(shown) - 20, "the picture's lowest rows show nothing in the middle"
    rows, columns = np.mgrid[: shown.shape[0], : shown.shape[1]]
    body = (rows > bottom - 40) & (abs(columns - 192) < 60)
    (scene,) = scene_of(finder, ~body)
    assert (~scene)[body & shown].mean() > 0.7
    assert scene[~body & (rows < bottom - 50)].all()


def test_what_stands_still_inside_the_picture_drives_along_and_is_scene(masked_rig: Path):
    moving = np.ones((216, 384), dtype=bool)
    moving[130:170, 150:230] = False
    scene = scene_found(masked_rig, moving)
    assert scene.all()


def test_a_vehicle_ahead_and_the_smooth_lane_that_leads_to_it_are_scene(masked_rig: Path):
    """No camera sees its own vehicle: the lane's small change must not be taken for the sensors' noise."""
    moving = np.ones((216, 384), dtype=bool)
    moving[130:160, 150:230] = False
    contrast = np.full((216, 384), 0.6)
    contrast[150:, 130:250] = 0.03
    contrast[130:160, 150:230] = 0.6
    assert scene_found(masked_rig, moving, contrast).all()


def test_too_few_pairs_find_nothing(masked_rig: Path):
    finder = SelfOcclusionFinder(load_rig_layout(masked_rig).complete())
    pictures = [np.full((216, 384, 3), 100, dtype=np.uint8)] * 6
    for _ in range(MIN_PAIRS - 1):
        finder.add(pictures, pictures)
    assert finder.scene().all()


def distorted_camera(**changes: object) -> Camera:
    fields = {
        "width": 640,
        "height": 360,
        "d": (-0.3, 0.1, 0.001, -0.001, 0.0),
        "k": (400.0, 0.0, 320.0, 0.0, 400.0, 180.0, 0.0, 0.0, 1.0),
    }
    return Camera("left", calibration_from_fields("left", fields), np.eye(4), **changes)  # type: ignore[arg-type]


def test_raw_pixels_and_the_rectifier_are_inverse_for_a_distorted_camera():
    camera = distorted_camera()
    rectifier = Rectifier(camera.calibration, 360, 640)
    pixels = raw_pixels(camera.calibration, False, rectifier.intrinsics)
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (360, 640), dtype=np.uint8), (0, 0), 6)
    there_and_back = cv2.remap(rectifier(picture, "left"), pixels, None, cv2.INTER_LINEAR)
    inner = (slice(60, 300), slice(100, 540))
    assert np.abs(there_and_back[inner].astype(int) - picture[inner]).max() <= 2


def test_a_polygon_of_the_rig_file_masks_what_it_encloses_and_adds_to_the_png(tmp_path: Path):
    png = np.full((360, 640), 255, np.uint8)
    png[:40] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), png)
    camera = distorted_camera(mask=tmp_path / "mask.png", mask_polygons=(((0, 300), (639, 300), (639, 359), (0, 359)),))
    mask = self_occlusion_mask(camera, Rectifier(camera.calibration, 360, 640, rectified=True))
    assert (mask[:38] == 0).all()
    assert (mask[302:] == 0).all()
    assert (mask[42:298] == 1).all()


def test_polygons_travel_through_the_rig_file(masked_rig: Path):
    content = load_rig_layout(masked_rig).model_dump(mode="json")
    content["cameras"][0]["mask_polygons"] = [[[0, 0], [10, 0], [10, 10.5]]]
    layout = RigLayout.model_validate(content)
    assert layout.complete().cameras[0].mask_polygons == (((0, 0), (10, 0), (10, 10.5)),)
