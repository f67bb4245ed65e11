# SPDX-License-Identifier: Apache-2.0
"""Pixels, rays and points of a pinhole camera agree with each other and with how OpenCV scales pictures."""

import cv2
import numpy as np
import pytest

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.pinhole import PinholeView, pixel_rays, rays_through, scale_intrinsics
from cvcdepth_core.rig.poses import pose_from_quaternion
from cvcdepth_core.rig.rig import Camera

INTRINSICS = np.array([[500.0, 0.0, 320.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]])
# Looks forward (z forward, x right, y down in a base frame of x forward, y left, z up) from a place on the left.
BASE_T_CAMERA = pose_from_quaternion((1.0, 2.0, 1.5), (-0.5, 0.5, -0.5, 0.5))


@pytest.mark.parametrize("scale", [(0.5, 0.5), (0.4, 1 / 3), (2.0, 3.0)])
def test_scaled_intrinsics_point_where_opencvs_resize_moves_the_picture(scale: tuple[float, float]):
    ramp_x, ramp_y = np.meshgrid(np.arange(60, dtype=np.float32), np.arange(30, dtype=np.float32))
    size = (round(60 * scale[0]), round(30 * scale[1]))
    # A ramp resized bilinearly tells for each new pixel which old position it shows.
    old_x, old_y = (cv2.resize(ramp, size, interpolation=cv2.INTER_LINEAR) for ramp in (ramp_x, ramp_y))
    u, v = size[0] // 2, size[1] // 2
    scaled = scale_intrinsics(np.eye(3), scale)
    assert scaled @ [old_x[v, u], old_y[v, u], 1.0] == pytest.approx([u, v, 1.0], abs=1e-4)


def test_scaling_leaves_the_given_matrix_alone():
    intrinsics = INTRINSICS.copy()
    scale_intrinsics(intrinsics, (0.5, 0.5), (-10.0, -20.0))
    assert np.array_equal(intrinsics, INTRINSICS)


def test_rays_lead_back_to_the_pixels_they_go_through():
    pixels = np.array([[0, 0], [320.5, 239.5], [639, 479.5]])
    rays = rays_through(pixels, INTRINSICS)
    assert rays[1] == pytest.approx([0.0, 0.0, 1.0])
    assert (rays @ INTRINSICS.T)[:, :2] == pytest.approx(pixels)
    every = pixel_rays(INTRINSICS, 480, 640)
    assert every[[0, 479], [0, 639]] == pytest.approx(rays_through(np.array([[0, 0], [639, 479]]), INTRINSICS))


def test_a_view_projects_points_of_the_base_frame_and_those_behind_it_to_nothing():
    pixels, z = PinholeView(INTRINSICS, BASE_T_CAMERA, 480, 640).project(np.array([[6.0, 1.0, 1.5], [0.0, 2.0, 1.5]]))
    assert pixels[0] == pytest.approx([320.5 + 500 / 5, 239.5])
    assert np.isnan(pixels[1]).all()
    assert z == pytest.approx([5.0, -1.0])


def test_a_camera_gives_its_rectified_view_at_full_size():
    calibration = Calibration(width=640, height=480, k=tuple(INTRINSICS.ravel()), binning_x=2, binning_y=2)
    view = Camera("front", calibration, BASE_T_CAMERA).rectified_view
    assert (view.width, view.height) == (320, 240)
    assert np.array_equal(view.intrinsics, calibration.rectified_intrinsics)
    assert np.array_equal(view.base_T_camera, BASE_T_CAMERA)
