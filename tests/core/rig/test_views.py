# SPDX-License-Identifier: Apache-2.0
"""Views of lenses: which pinhole camera a rig file's `view` makes, wide lenses split, and what is used of a lens."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.lens import angles_at, field_of_view, image_radii, largest_angle
from cvcdepth_core.rig.lens_use import lens_uses
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout, load_rig_layout, save_rig_layout
from cvcdepth_core.rig.view import View, network_part
from cvcdepth_core.rig.wide_lenses import lens_name, views_of, wide_lenses, with_views, without_views

D = (0.02, -0.004, 0.001, 0.0)


def fisheye(hfov: float, width: int = 640, height: int = 480, **changes: object) -> Calibration:
    """A lens of so many degrees, by its own polynomial."""
    half = math.radians(hfov / 2)
    f = width / 2 / (half * (1 + D[0] * half**2 + D[1] * half**4 + D[2] * half**6))
    k = (f, 0.0, (width - 1) / 2, 0.0, f, (height - 1) / 2, 0.0, 0.0, 1.0)
    return Calibration(width=width, height=height, distortion_model="equidistant", d=D, k=k, **changes)


def pose(yaw: float, pitch: float = 0.0) -> np.ndarray:
    """Of a camera that looks `yaw` degrees to the left and `pitch` down."""
    y, p = math.radians(yaw), math.radians(pitch)
    turn = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    tilt = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    base_T_camera = np.eye(4)
    base_T_camera[:3, :3] = turn @ tilt @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    base_T_camera[:3, 3] = math.cos(y), 0.5 * math.sin(y), 1.5
    return base_T_camera


def entry(name: str, yaw: float, calibration: Calibration, pitch: float = 0.0, **changes: object) -> CameraEntry:
    return CameraEntry(
        name=name,
        image_topic=f"/{name}/image_raw",
        camera_info_topic=f"/{name}/camera_info",
        frame_id=f"{name}_optical",
        calibration=calibration,
        base_T_camera=PoseEntry.from_matrix(pose(yaw, pitch)),
        **changes,
    )


def four(hfov: float, **changes: object) -> RigLayout:
    yaws = {"front": 0, "left": 90, "rear": 180, "right": -90}
    return RigLayout(cameras=tuple(entry(name, yaw, fisheye(hfov), **changes) for name, yaw in yaws.items()))


def angle_of(rig: Rig, name: str) -> float:
    K = next(camera for camera in rig.cameras if camera.name == name).calibration.rectified_intrinsics
    return math.degrees(2 * math.atan(320 / K[0, 0]))


@pytest.mark.parametrize("hfov", [60, 98, 170, 195])
def test_a_lens_sees_what_its_polynomial_says(hfov: float):
    assert field_of_view(fisheye(hfov)).horizontal == pytest.approx(hfov, abs=1e-6)


def test_angles_and_radii_are_inverse_also_behind_the_lens():
    angles = np.radians([0.0, 1e-7, 10, 60, 89, 95, 110])
    found = angles_at(fisheye(230), image_radii(fisheye(230), angles))
    np.testing.assert_allclose(found, angles, atol=1e-12)


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial"])
def test_radii_are_those_of_opencv(model: str):
    d = {"plumb_bob": (-0.3, 0.1, 0, 0, -0.02), "rational_polynomial": (0.3, 0.05, 0, 0, 0.001, 0.35, 0.06, 0.002)}
    calibration = Calibration(
        width=64, height=48, distortion_model=model, d=d[model], k=(50, 0, 32, 0, 50, 24, 0, 0, 1)
    )
    angles = np.radians([0.0, 5, 20, 40])
    points = np.stack([np.tan(angles), np.zeros(4), np.ones(4)], axis=1)[:, None]
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(d[model]))
    np.testing.assert_allclose(image_radii(calibration, angles), pixels[:, 0, 0], atol=1e-12)


def test_a_polynomial_that_turns_back_ends_the_lens():
    barrel = Calibration(width=640, height=480, d=(-0.4, 0, 0, 0), k=(200, 0, 319.5, 0, 200, 239.5, 0, 0, 1))
    turn = math.atan(math.sqrt(1 / 1.2))  # where r (1 - 0.4 r^2) is largest
    assert largest_angle(barrel) == pytest.approx(turn, abs=1e-3)
    assert field_of_view(barrel).horizontal == pytest.approx(2 * math.degrees(turn), abs=0.1)


def test_pictures_that_are_rectified_see_what_p_says():
    P = (320.0, 0, 319.5, 0, 0, 320, 239.5, 0, 0, 0, 1, 0)
    view = field_of_view(fisheye(170, p=P), rectified=True)
    assert view.horizontal == pytest.approx(90)
    assert view.left == pytest.approx(view.right)


@pytest.mark.parametrize(
    "changes",
    [{}, {"binning_x": 2, "binning_y": 2}, {"roi": {"x_offset": 32, "y_offset": 16, "width": 512, "height": 400}}],
    ids=["plain", "binned", "region"],
)
def test_a_view_is_centred_with_square_pixels_and_of_its_angle(changes: dict):
    seen, _ = View(hfov=90).seen_from(fisheye(150, **changes), pose(0))
    width, height = seen.image_size
    K = seen.rectified_intrinsics
    np.testing.assert_allclose(K, [[width / 2, 0, (width - 1) / 2], [0, width / 2, (height - 1) / 2], [0, 0, 1]])


def test_a_focal_length_is_in_pixels_of_the_images():
    seen, _ = View(focal_length=250.0).seen_from(fisheye(150, binning_x=2, binning_y=2), pose(0))
    assert seen.rectified_intrinsics[0, 0] == seen.rectified_intrinsics[1, 1] == 250.0


def test_a_turned_view_looks_to_the_left_and_keeps_the_horizon():
    calibration, tilted = fisheye(170), pose(30, pitch=20)
    seen, base_T_view = View(hfov=70, yaw=40).seen_from(calibration, tilted)
    np.testing.assert_allclose(base_T_view[:3, :3], pose(70, pitch=20)[:3, :3], atol=1e-12)
    np.testing.assert_array_equal(base_T_view[:3, 3], tilted[:3, 3])
    # A far point's ray, taken from the vehicle to the raw lens and by R to the view, is that of the view's own pose.
    ray = np.array([0.3, 0.9, -0.1])
    in_view = seen.rotation @ (tilted[:3, :3].T @ ray)
    np.testing.assert_allclose(in_view, base_T_view[:3, :3].T @ ray, atol=1e-12)


def test_the_view_of_rectified_pictures_begins_from_p():
    P = (400.0, 0, 300.5, 0, 0, 410, 200.5, 0, 0, 0, 1, 0)
    layout = RigLayout(cameras=(entry("front", 0, fisheye(170, p=P), rectified=True, view=View(hfov=60)),))
    (camera,) = layout.complete().cameras
    assert not camera.rectified
    assert camera.calibration.d == ()
    np.testing.assert_allclose(camera.calibration.raw_intrinsics, [[400, 0, 300.5], [0, 410, 200.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("hfov", "parts", "part"), [(98, 1, 98), (120, 1, 120), (130, 2, 75), (170, 3, 70), (245, 3, 95), (300, 3, 95)]
)
def test_a_lens_is_shown_by_as_few_views_as_can(hfov: float, parts: int, part: float):
    views = views_of(hfov)
    assert len(views) == parts
    assert [view.hfov for view in views] == [pytest.approx(part, abs=0.11)] * parts
    shown = views[0].yaw - views[-1].yaw + part
    assert shown == pytest.approx(min(hfov, 245), abs=0.2)
    steps = -np.diff([view.yaw for view in views])
    assert all(part - steps >= 19.9)  # neighbouring views overlap


def test_views_are_named_left_middle_and_right_and_are_neighbours():
    layout = with_views(four(170), {"front": 170.0})
    assert layout.names == ["front_l", "front_m", "front_r", "left", "rear", "right"]
    rig = layout.complete()
    assert {"front_m"} <= {*rig.neighbours["front_l"]} & {*rig.neighbours["front_r"]}
    places = [camera.base_T_camera[:3, 3] for camera in rig.cameras[:3]]
    np.testing.assert_array_equal(places[0], places[1])
    np.testing.assert_array_equal(places[0], places[2])
    yaws = [math.degrees(math.atan2(*camera.base_T_camera[[1, 0], 2])) for camera in rig.cameras[:3]]
    np.testing.assert_allclose(yaws, [50, 0, -50], atol=0.2)


def test_a_view_that_would_be_called_as_another_camera_is_refused_by_name():
    layout = four(170)
    renamed = layout.cameras[1].model_copy(update={"name": "front_l"})
    with pytest.raises(
        RigError, match=r"camera front: its lens would be shown by front_l, .*there is a camera front_l;"
    ):
        with_views(layout.model_copy(update={"cameras": (layout.cameras[0], renamed)}), {"front": 170.0})


def test_views_of_one_lens_are_one_lens():
    rig = with_views(four(170), {"front": 170.0}).complete()
    assert rig.lenses == [[0, 1, 2], [3], [4], [5]]


def test_anchor_and_given_neighbours_follow_a_split():
    layout = four(170)
    cameras = tuple(c.model_copy(update={"neighbours": ("front",)}) if c.name == "left" else c for c in layout.cameras)
    cameras = (cameras[0].model_copy(update={"neighbours": ("left",)}), *cameras[1:])
    layout = layout.model_copy(update={"cameras": cameras, "anchor": "front"})
    split = with_views(layout, {"front": 170.0})
    assert split.anchor == "front_m"
    neighbours = split.complete().neighbours
    assert neighbours["left"] == ["front_l", "front_m", "front_r"]
    assert neighbours["front_l"] == ["front_m", "front_r", "left"]
    RigLayout.model_validate(split.model_dump())
    assert without_views(split) == layout


def test_only_wide_lenses_without_a_chosen_view_are_wide():
    cameras = (
        entry("wide", 0, fisheye(170)),
        entry("narrow", 90, fisheye(110)),
        entry("chosen", 180, fisheye(170), view=View(hfov=90)),
        entry("flat", -90, fisheye(170), rectified=True),
    )
    layout = RigLayout(cameras=cameras)
    assert wide_lenses(layout, {entry.name: entry.calibration for entry in cameras}) == {"wide": pytest.approx(170)}


@pytest.mark.parametrize(
    ("names", "lens"),
    [
        (["front"], "front"),
        (["front_r", "front_m", "front_l"], "front"),
        (["a_l", "a_r"], "a"),
        (["a_l", "b_r"], "a_l"),
        (["near", "far"], "near"),
        (["side_l"], "side_l"),
    ],
)
def test_views_of_one_lens_have_a_name_together(names: list[str], lens: str):
    assert lens_name(names) == lens


def test_a_rig_file_keeps_its_views(tmp_path: Path):
    layout = with_views(four(170), {"front": 170.0, "rear": 100.0}).model_copy(update={"aspect": "pad"})
    save_rig_layout(tmp_path / "rig.yaml", layout)
    assert load_rig_layout(tmp_path / "rig.yaml") == layout


BAD_VIEWS = {
    "too wide for a pinhole": ("{hfov: 150}", "view.hfov: .*less than or equal to 120, found 150"),
    "neither angle nor length": ("{yaw: 20}", "give hfov or focal_length"),
    "both": ("{hfov: 90, focal_length: 300}", "give hfov or focal_length"),
    "another field": ("{fov: 90}", "view.fov: .*found 90"),
    "no number": ("{hfov: wide}", "view.hfov: .*found 'wide'"),
}


@pytest.mark.parametrize(("text", "message"), BAD_VIEWS.values(), ids=BAD_VIEWS)
def test_an_impossible_view_is_refused_by_field_and_value(text: str, message: str, tmp_path: Path):
    (tmp_path / "rig.yaml").write_text(
        f"cameras: [{{name: a, image_topic: /a/image, camera_info_topic: /a/camera_info, view: {text}}}]"
    )
    with pytest.raises(RigError, match=rf"rig\.yaml: .*{message}"):
        load_rig_layout(tmp_path / "rig.yaml")


def test_cameras_of_one_image_topic_need_views_of_one_lens():
    (first, *_), (second, *_) = four(170).cameras, four(170).cameras
    for changes, message in (
        ({}, "image_topic: /front/image_raw is that of front and b; views of one lens have a view each"),
        ({"view": View(hfov=90)}, "view: those of front and b, of one image_topic, are the same"),
        ({"view": View(hfov=90, yaw=30), "stamp_offset": 0.1}, "stamp_offset: differs between front and b"),
        ({"view": View(hfov=90, yaw=30), "calibration": None}, "calibration: differs between front and b"),
    ):
        given = first.model_copy(update={"view": View(hfov=90)}) if "view" in changes else first
        with pytest.raises(ValueError, match=message):
            RigLayout(cameras=(given, second.model_copy(update={"name": "b", **changes})))


def test_what_is_lost_of_a_lens_is_told_with_the_overlap_that_it_costs():
    (front, *_) = uses = lens_uses(four(98))
    assert str(front) == "front: lens 98, used 82 degrees, overlap 0 of 8"
    assert all(use.is_wasted for use in uses)
    whole = lens_uses(with_views(four(98), dict.fromkeys(("front", "left", "rear", "right"), 98.0)))
    assert not any(use.is_wasted for use in whole)
    assert [round(use.overlap) for use in whole] == [8] * 4


def test_a_split_lens_is_used_whole():
    (front, *_) = lens_uses(with_views(four(170), {"front": 170.0}))
    assert front.cameras == ("front_l", "front_m", "front_r")
    assert front.used == pytest.approx(170, abs=0.2)
    assert not front.is_wasted
    assert front.overlap > 50  # 80 as directions on the horizon go, but its nearest view is 70 wide


SHAPES = {
    # image, network, part shown when cropped, when padded
    "16:9 into 5:3, as ever": ((1920, 1080), (640, 384), (0, 0, 1920, 1080), (0, 0, 1920, 1080)),
    "4:3 into 5:3": ((640, 480), (320, 192), (0, 48, 640, 384), (-80, 0, 800, 480)),
    "16:9 into 4:3": ((1600, 900), (640, 480), (0, -150, 1600, 1200), (0, -150, 1600, 1200)),
}


@pytest.mark.parametrize(("image", "network", "cropped", "padded"), SHAPES.values(), ids=SHAPES)
def test_pictures_keep_their_aspect(image: tuple, network: tuple, cropped: tuple, padded: tuple):
    K = (500.0, 0, image[0] / 2, 0, 500, image[1] / 2, 0, 0, 1)
    calibration = Calibration(width=image[0], height=image[1], k=K)
    for aspect, part in (("crop", cropped), ("pad", padded), ("stretch", (0, 0, *image))):
        np.testing.assert_allclose(network_part(calibration, network[1], network[0], aspect), part)


def test_pixels_that_are_not_square_become_square():
    calibration = Calibration(width=640, height=240, k=(400, 0, 320, 0, 200, 120, 0, 0, 1))  # rows binned by the sensor
    np.testing.assert_allclose(network_part(calibration, 192, 256, "crop"), (0, 0, 640, 240))
    np.testing.assert_allclose(network_part(calibration, 192, 320, "crop"), (0, 24, 640, 192))
