# SPDX-License-Identifier: Apache-2.0
"""Pictures: colours say which depth, the map says where, the sheet shows every camera above its own depth."""

import numpy as np
import pytest

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.rig.calibration import Calibration, calibration_from_fields
from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_core.visualization import (
    ColouredPoints,
    DepthScale,
    SurroundPictures,
    TopDownView,
    contact_sheet,
    top_down,
    viewing_rows,
)

YAWS = {"front": 0, "front_left": 60, "left": 120, "back": 180, "right": 240, "front_right": 300}
HEIGHT, WIDTH = 24, 40


def calibration() -> Calibration:
    k = [100.0, 0, 100, 0, 100, 50, 0, 0, 1]
    p = [100.0, 0, 100, 0, 0, 100, 50, 0, 0, 0, 1, 0]
    fields = {"width": 200, "height": 100, "distortion_model": "plumb_bob", "d": [0.0] * 5, "k": k, "p": p}
    return calibration_from_fields("any", fields | {"r": [1.0, 0, 0, 0, 1, 0, 0, 0, 1]})


def looking(yaw: float) -> Pose:
    """An optical frame (REP 103) at the origin that looks to `yaw` degrees, counted from ahead to the left."""
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    pose = np.eye(4)
    pose[:3, :3] = np.array([[sin, 0, cos], [-cos, 0, sin], [0, -1, 0]])
    return pose


def rig_of(**yaws: float) -> Rig:
    cameras = tuple(Camera(name, calibration(), looking(yaw)) for name, yaw in yaws.items())
    return Rig(cameras, "base_link", cameras[0].name, {})


def points(*xyz: tuple[float, float, float], rgb: tuple[int, int, int] = (255, 0, 0)) -> ColouredPoints:
    return ColouredPoints(np.array(xyz, dtype=np.float32).reshape(-1, 3), np.full((len(xyz), 3), rgb, dtype=np.uint8))


def pictures_of(rig: Rig, depth: float = 10.0) -> SurroundPictures:
    """Each camera's picture is one grey: 10 times its index + 100; every depth is the same."""
    n = len(rig.names)
    greys = np.arange(n, dtype=np.uint8) * 10 + 100
    return SurroundPictures(
        pictures=np.broadcast_to(greys[:, None, None, None], (n, HEIGHT, WIDTH, 3)).copy(),
        depth=np.full((n, HEIGHT, WIDTH), depth, dtype=np.float32),
        cloud=points(),
        lidar=None,
        title="a title",
    )


# Colours


def test_unknown_depth_is_black_and_known_depth_never_is():
    depth = np.array([np.nan, 0.0, -1.0, 1e-6, 1.0, 20.0, 80.0, 1e6, np.inf], dtype=np.float32)
    black = (DepthScale().colours(depth) == 0).all(axis=-1)
    assert black.tolist() == [True, False, True, False, False, False, False, False, False]


def test_near_is_red_and_far_is_blue():
    near, far = DepthScale(2, 50).colours(np.array([2, 50], dtype=np.float32)).astype(int)
    assert near[0] > near[1] + near[2]
    assert far[2] > far[1]
    assert far[2] > far[0]


def test_depth_beyond_the_ends_has_the_ends_colours():
    scale = DepthScale(2, 50)
    colours = scale.colours(np.array([0.1, 2, 50, 1000], dtype=np.float32))
    np.testing.assert_array_equal(colours[0], colours[1])
    np.testing.assert_array_equal(colours[2], colours[3])
    assert (colours[1] != colours[2]).any()


def test_the_scale_is_logarithmic():
    """Equal factors are equal steps: what lies in the middle between the ends is their geometric mean."""
    scale = DepthScale(1, 100)
    np.testing.assert_array_equal(
        scale.colours(np.array([10.0], dtype=np.float32)), DepthScale(5, 20).colours(np.array([10.0], dtype=np.float32))
    )


def test_a_scale_without_extent_is_refused():
    with pytest.raises(ConfigError, match=r"near 5.*far 5"):
        DepthScale(5, 5)


# The view from above


def test_a_point_ahead_lies_above_the_middle_and_one_to_the_left_lies_left():
    view = TopDownView(200, 300, pixels_per_metre=5.0)
    ahead, left = view.pixels(np.array([[10.0, 0, 0], [0, 10, 0]]))
    assert ahead.tolist() == [100, 100]
    assert left.tolist() == [50, 150]


def test_the_middle_shows_the_chosen_centre():
    view = TopDownView(200, 300, pixels_per_metre=5.0, centre=(8.0, -2.0))
    assert view.pixels(np.array([8.0, -2.0, 1.0])).tolist() == [100, 150]


def test_a_cloud_point_ten_metres_ahead_is_drawn_there_in_its_own_hue():
    view = TopDownView(201, 301, pixels_per_metre=5.0)
    picture = top_down(rig_of(**YAWS), points((12, 3, 0), rgb=(200, 0, 0)), None, view)
    column, row = np.floor(view.pixels(np.array([12, 3]))).astype(int)
    red, green, blue = picture[row, column]
    assert red >= 200
    assert green == blue == 0


def test_lidar_is_drawn_over_the_cloud():
    view = TopDownView(201, 301, pixels_per_metre=5.0)
    column, row = np.floor(view.pixels(np.array([12, 3]))).astype(int)
    below, above = points((12, 3, 5)), np.array([[12, 3, 0]], dtype=np.float32)
    without = top_down(rig_of(**YAWS), below, None, view)[row, column]
    with_lidar = top_down(rig_of(**YAWS), below, above, view)[row, column]
    assert (without != with_lidar).any()


def test_the_higher_of_two_points_hides_the_lower():
    view = TopDownView(201, 301, pixels_per_metre=5.0)
    column, row = np.floor(view.pixels(np.array([12, 3]))).astype(int)
    high, low = points((12, 3, 5), rgb=(255, 0, 0)), points((12, 3, 0), rgb=(0, 255, 0))
    for first, second in ((high, low), (low, high)):
        both = ColouredPoints(np.concatenate([first.xyz, second.xyz]), np.concatenate([first.rgb, second.rgb]))
        assert top_down(rig_of(**YAWS), both, None, view)[row, column].tolist() == [255, 0, 0]


def test_points_outside_the_view_and_unknown_ones_are_left_out():
    view = TopDownView(201, 301, pixels_per_metre=5.0)
    empty = top_down(rig_of(**YAWS), points(), None, view)
    outside = points((1000, 0, 0), (-1000, 0, 0), (0, 1000, 0), (0, -1000, 0), (np.nan, 3, 0), (3, np.inf, 0))
    np.testing.assert_array_equal(top_down(rig_of(**YAWS), outside, None, view), empty)


def test_grid_lines_are_those_of_whole_tens_of_metres_in_view():
    xs, ys = TopDownView(200, 300, pixels_per_metre=5.0, centre=(8.0, 0.0)).grid_lines()
    assert xs == [-20, -10, 0, 10, 20, 30]
    assert ys == [-20, -10, 0, 10, 20]


# The sheet


def test_the_upper_row_looks_ahead_from_left_to_right():
    upper, lower = viewing_rows(rig_of(**YAWS))
    assert upper == ["front_left", "front", "front_right"]
    assert lower == ["left", "back", "right"]


@pytest.mark.parametrize("count", [2, 3, 5, 7])
def test_any_number_of_cameras_is_shown_once_each(count: int):
    rig = rig_of(**{f"camera{i}": 360 * i / count for i in range(count)})
    upper, lower = viewing_rows(rig)
    assert sorted(upper + lower) == sorted(rig.names)
    assert 0 <= len(upper) - len(lower) <= 1
    assert contact_sheet(rig, pictures_of(rig)).shape[1] == 1920


def test_every_camera_is_shown_above_its_own_depth():
    rig = rig_of(**YAWS)
    shown = pictures_of(rig)
    shown.depth[:] = (np.arange(6, dtype=np.float32) * 10 + 2)[:, None, None]
    sheet = contact_sheet(rig, shown)
    for index, depth in enumerate(shown.depth[:, 0, 0]):
        grey = (sheet == 100 + 10 * index).all(axis=-1)
        coloured = (sheet == DepthScale().colours(np.array(depth))).all(axis=-1)
        assert grey.sum() > 50_000
        picture_rows, picture_columns = np.nonzero(grey)
        # Of the depth's colour the legend has a column too.
        depth_rows, depth_columns = np.nonzero(coloured & (coloured.sum(axis=1) > 100)[:, None])
        assert depth_rows.min() > picture_rows.max()
        assert depth_rows.min() - picture_rows.max() < 10
        assert (depth_columns.min(), depth_columns.max()) == (picture_columns.min(), picture_columns.max())


def test_unknown_depth_is_black_on_the_sheet_too():
    rig = rig_of(**YAWS)
    known, unknown = (contact_sheet(rig, pictures_of(rig, depth)) for depth in (10.0, np.nan))
    changed = (known != unknown).any(axis=-1)
    assert changed.sum() > 300_000
    assert (unknown[changed] == 0).all()


def test_the_warning_is_on_the_sheet():
    rig = rig_of(**YAWS)
    plain = pictures_of(rig)
    warned = SurroundPictures(plain.pictures, plain.depth, plain.cloud, None, plain.title, warning="UNTRAINED")
    changed = np.nonzero((contact_sheet(rig, plain) != contact_sheet(rig, warned)).any(axis=-1))
    assert changed[0].size > 100
    assert changed[0].max() < 64
