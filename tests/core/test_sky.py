# SPDX-License-Identifier: Apache-2.0
"""Which pixels are taken for sky: by the farthest depth, or by looks."""

import numpy as np
import pytest

from cvcdepth_core.sky import beyond_measure, elevations, sky_in_picture, sky_in_pictures
from cvcdepth_core.surround_depth import SurroundDepth, SurroundPictures

HEIGHT, WIDTH = 192, 320
INTRINSICS = np.array([[160.0, 0, 159.5], [0, 160.0, 95.5], [0, 0, 1]])
LEVEL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]])
"""Looks along the base frame's x, 1.6 m above its origin."""
FAR = np.full((HEIGHT, WIDTH), 30.0, np.float32)
BLUE, GREY_ROAD, WALL = (150, 180, 220), (90, 90, 92), (140, 70, 60)


def upward(pose=LEVEL):
    return elevations(INTRINSICS, pose, HEIGHT, WIDTH)


def street(sky=BLUE, horizon: int = 80):
    """Sky down to `horizon`, a textured row of houses to row 110, the road below."""
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:horizon] = sky
    rng = np.random.default_rng(0)
    picture[horizon:110] = np.clip(np.array(WALL) + rng.integers(-60, 60, (110 - horizon, WIDTH, 1)), 0, 255)
    picture[110:] = GREY_ROAD
    return picture


def test_depth_at_the_farthest_of_each_camera_is_sky():
    depth = np.array([[[10.0, 199.0]], [[399.0, 150.0]], [[np.nan, 0.5]]], np.float32)
    found = beyond_measure(depth, np.array([300.0, 600.0, 300.0]), max_depth=200.0, focal_scale=300.0)
    assert found.tolist() == [[[False, True]], [[True, False]], [[False, False]]]


def test_the_smooth_bright_part_above_the_houses_is_sky():
    found = sky_in_picture(street(), upward(), FAR)
    assert found[:76].all()
    assert not found[88:].any()


def test_pixels_look_up_above_the_horizon_whatever_the_mount():
    sines = upward()
    assert (sines[: sines.shape[0] // 2] > 0).all()
    assert (sines[sines.shape[0] // 2 :] < 0).all()
    sideways = LEVEL.copy()
    sideways[:3, :3] = LEVEL[:3, :3] @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert (upward(sideways)[:, 0] > 0).all() != (upward(sideways)[:, -1] > 0).all()


@pytest.mark.parametrize(
    ("picture", "why"),
    [
        (np.full((HEIGHT, WIDTH, 3), 200, np.uint8), "a white lorry that fills the picture goes on below the horizon"),
        (street(sky=(120, 80, 50)), "a brown facade is redder than any sky"),
        (street(sky=(8, 9, 14)), "at night the sky is no brighter than the road"),
        (street(horizon=0), "houses fill the picture to its upper edge"),
    ],
)
def test_in_doubt_there_is_no_sky(picture, why):
    assert not sky_in_picture(picture, upward(), FAR).any(), why


def test_pixels_without_depth_do_not_hide_the_sky_around_them():
    partly = FAR.copy()
    partly[:30, :100] = np.nan
    assert sky_in_picture(street(), upward(), partly)[:76].all()


def test_a_light_wall_that_the_network_sees_near_is_no_sky():
    near = np.where(np.arange(HEIGHT)[:, None] < 100, np.float32(6.0), FAR)
    assert not sky_in_picture(street(), upward(), near).any()


def test_only_present_cameras_and_valid_pixels_have_sky():
    valid = np.ones((2, HEIGHT, WIDTH), bool)
    valid[:, :, :10] = False
    surround = SurroundPictures(
        np.stack([street(), street()]),
        np.array([True, False]),
        np.stack([INTRINSICS] * 2),
        np.stack([LEVEL] * 2),
        valid,
    )
    found = sky_in_pictures(surround, np.stack([FAR] * 2))
    assert found[0, :70, 10:].all()
    assert not found[0, :, :10].any()
    assert not found[1].any()


def test_depth_images_show_the_sky_as_they_are_asked_and_clouds_take_none():
    depth = np.array([[[2.0, 30.0, np.nan, 40.0]]], np.float32)
    sky = np.array([[[False, True, True, False]]])
    sure = np.array([[[0.9, 0.1, 0.0, 0.1]]], np.float32)
    pictures = np.zeros((1, 1, 4, 3), np.uint8)
    surround = SurroundDepth(depth, pictures, INTRINSICS[None], np.array([True]), sure, sky)
    np.testing.assert_array_equal(surround.shown_depth(0, "far"), [[2, np.inf, np.nan, 40]])
    np.testing.assert_array_equal(surround.shown_depth(0, "nan"), [[2, np.nan, np.nan, 40]])
    np.testing.assert_array_equal(surround.shown_depth(0, "keep"), depth[0])
    np.testing.assert_array_equal(surround.shown_depth(0, "far", 0.5), [[2, np.inf, np.nan, np.nan]])
    np.testing.assert_array_equal(surround.sure_depth(0, 0.0), [[2, np.nan, np.nan, 40]])
    np.testing.assert_array_equal(surround.sure_depth(0, 0.5), [[2, np.nan, np.nan, np.nan]])
