# SPDX-License-Identifier: Apache-2.0
"""A calibration says what its CameraInfo says, in the pixels of the sent images, or names what is impossible."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.calibration import Calibration, calibration_from_fields

K = (500.0, 0.0, 320.5, 0.0, 510.0, 239.5, 0.0, 0.0, 1.0)
P = (450.0, 0.0, 330.0, 0.0, 0.0, 460.0, 250.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def _fields(**changed: object) -> dict[str, object]:
    return {"width": 640, "height": 480, "k": K} | changed


def _matrix(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


IMPOSSIBLE = {
    "no width": ({"width": 0}, "size 0x480"),
    "uncalibrated": ({"k": (0.0,) * 9}, r"K\[0\] = 0: .*not calibrated"),
    "K without focal length in y": ({"k": (500.0, 0, 1, 0, 0, 1, 0, 0, 1)}, "K = .*fy > 0"),
    "K with negative focal length": ({"k": (-500.0, 0, 1, 0, 500, 1, 0, 0, 1)}, "K = .-500.0.*fx > 0"),
    "K not homogeneous": ({"k": (500.0, 0, 1, 0, 500, 1, 0, 0, 2)}, "K = .*2.0.*1 in the corner"),
    "K not a number": ({"k": (math.nan, *K[1:])}, "k = .nan.* is not finite"),
    "P infinite": ({"p": (*P[:11], math.inf)}, "p = .*inf.* is not finite"),
    "D not a number": ({"d": (0.1, math.nan, 0, 0)}, "d = .*nan.* is not finite"),
    "K singular": ({"k": (500.0, 0, 1, 500.0, 500, 1, 500, 500, 1)}, "K = .*zeros left of the diagonal"),
    "K of a point": ({"k": (1e-9, 0, 1, 0, 500, 1, 0, 0, 1)}, "K = .*1e-09.*no lens sees an image of 640x480 so"),
    "K of a telescope": ({"k": (1e30, 0, 1, 0, 500, 1, 0, 0, 1)}, "K = .*1e.30.*no lens sees"),
    "K far off its image": ({"k": (500, 0, -1e9, 0, 500, 1, 0, 0, 1)}, "K = .*no lens sees"),
    "K of a lens of half a degree": ({"k": (7e4, 0, 1, 0, 7e4, 1, 0, 0, 1)}, "K = .*70000.*no lens sees"),
    "P that is singular": ({"p": (*P[:8], 1.0, *P[9:])}, "P = .*zeros left of the diagonal"),
    "P that leans over": ({"p": (*P[:9], 1.0, *P[10:])}, "P = .*zeros left of the diagonal"),
    "P with a row of its own": ({"p": (*P[:4], 1.0, *P[5:])}, "P = .*zeros left of the diagonal"),
    "P of a point": ({"p": (450.0, *P[1:5], 1e-320, *P[6:])}, "P = .*no lens sees"),
    "R too large to multiply": ({"r": (1e200,) * 9}, "R = .*not a rotation"),
    "D beyond any lens": ({"d": (1e300, 0, 0, 0)}, "d = .*no lens has coefficients beyond 1e.06"),
    "giant": ({"width": 65000, "height": 65000}, "size 65000x65000: more than 50000000 pixels"),
    "longer than remap can count": ({"width": 32767, "height": 1500}, "size 32767x1500: a side is longer than 32766"),
    "a line": ({"width": 1, "height": 30_000}, "image of 1x30000: one side is more than 20 times the other"),
    "a line of a picture": ({"roi": {"width": 10, "height": 480}}, "image of 10x480: one side is more than 20 times"),
    "D of a million numbers": ({"d": (math.nan,) * 10**6}, "plumb_bob takes 0 or 4 or 5 numbers in d, found 1000000"),
    "K too short": ({"k": K[:8]}, "k has 8 numbers, want 9"),
    "R too long": ({"r": (1.0,) * 10}, "r has 10 numbers, want 9"),
    "P too short": ({"p": P[:9]}, "p has 9 numbers, want 12"),
    "P without focal length": ({"p": (0.0, *P[1:])}, "P = .*fx > 0"),
    "R a shear": ({"r": (1, 0.1, 0, 0, 1, 0, 0, 0, 1)}, "R = .*0.1.*not a rotation"),
    "R a mirror": ({"r": (-1, 0, 0, 0, 1, 0, 0, 0, 1)}, "R = .*-1.0.*not a rotation"),
    "unknown model": ({"distortion_model": "fov", "d": (0.9,)}, "distortion_model: .*equidistant.*found 'fov'"),
    "unnamed model": ({"distortion_model": "", "d": (0.1, 0, 0, 0)}, "distortion_model: .*found ''"),
    "plumb_bob with 8": ({"d": (0.1,) * 8}, "plumb_bob takes 0 or 4 or 5 numbers in d, found 8"),
    "equidistant with 5": ({"distortion_model": "equidistant", "d": (0.1,) * 5}, "takes 0 or 4 .*found 5"),
    "rational with 5": ({"distortion_model": "rational_polynomial", "d": (0.1,) * 5}, "8 or 12 or 14 .*found 5"),
    "no binning": ({"binning_x": 0}, "binning 0 x 1"),
    "negative binning": ({"binning_y": -2}, "binning 1 x -2"),
    "binning that leaves nothing": ({"binning_y": 481}, "binning 1 x 481 leaves .*640x0"),
    "ROI too wide": ({"roi": {"x_offset": 600, "width": 41, "height": 10}}, "'x_offset': 600.*inside.*640x480"),
    "ROI above": ({"roi": {"y_offset": -1, "width": 41, "height": 10}}, "'y_offset': -1.*inside.*640x480"),
    "ROI of full width but shifted": ({"roi": {"x_offset": 8, "height": 10}}, "'x_offset': 8.*inside"),
    "a word": ({"width": "broad"}, "width: .*integer.*found 'broad'"),
    "an unknown field": ({"fisheye": True}, "fisheye: .*not permitted, found True"),
}


@pytest.mark.parametrize(("changed", "found"), IMPOSSIBLE.values(), ids=IMPOSSIBLE.keys())
def test_an_impossible_calibration_is_refused_with_camera_field_and_value(changed: dict[str, object], found: str):
    with pytest.raises(RigError, match=f"camera rear_left: camera_info: .*{found}") as error:
        calibration_from_fields("rear_left", _fields(**changed))
    assert "\n" not in str(error.value)


def test_a_value_that_contains_itself_a_billion_times_is_told_shortly():
    bomb: list[object] = ["ha"] * 10
    for _ in range(9):
        bomb = [bomb] * 10
    with pytest.raises(RigError) as error:
        calibration_from_fields("rear", _fields(width=bomb))
    assert len(str(error.value)) < 300


def test_a_missing_matrix_is_named():
    with pytest.raises(RigError, match="camera rear: camera_info: k: Field required"):
        calibration_from_fields("rear", {"width": 640, "height": 480})


@pytest.mark.parametrize(
    ("model", "count"),
    [("plumb_bob", c) for c in (0, 4, 5)]
    + [("rational_polynomial", c) for c in (0, 8, 12, 14)]
    + [("equidistant", c) for c in (0, 4)],
)
def test_each_model_takes_the_coefficients_opencv_takes(model: str, count: int):
    calibration = calibration_from_fields("front", _fields(distortion_model=model, d=[0.01] * count))
    assert calibration.distortion.tolist() == ([0.01] * count or [0.0] * 4)


def test_a_model_without_name_or_coefficients_means_no_distortion():
    assert calibration_from_fields("front", _fields(distortion_model="", d=[])).distortion_model == "plumb_bob"


def test_without_p_the_rectified_camera_has_the_raw_matrix():
    assert np.array_equal(Calibration(**_fields()).rectified_intrinsics, np.array(K).reshape(3, 3))
    assert np.array_equal(Calibration(**_fields(p=P)).rectified_intrinsics, _matrix(450.0, 460.0, 330.0, 250.0))


def test_a_region_of_interest_moves_both_principal_points_and_sets_the_size():
    roi = {"x_offset": 100, "y_offset": 40, "width": 320, "height": 200}
    calibration = Calibration(**_fields(p=P, roi=roi))
    assert calibration.image_size == (320, 200)
    assert calibration.raw_intrinsics == pytest.approx(_matrix(500.0, 510.0, 220.5, 199.5))
    assert calibration.rectified_intrinsics == pytest.approx(_matrix(450.0, 460.0, 230.0, 210.0))


def test_binning_follows_the_region_of_interest_in_unbinned_pixels():
    roi = {"x_offset": 100, "y_offset": 40, "width": 321, "height": 200}
    calibration = Calibration(**_fields(roi=roi, binning_x=2, binning_y=4))
    assert calibration.image_size == (160, 50)
    # The centre of a binned pixel is the mean of its sensor pixels' centres.
    cx, cy = (320.5 - 100 - 0.5) / 2, (239.5 - 40 - 1.5) / 4
    assert calibration.raw_intrinsics == pytest.approx(_matrix(250.0, 127.5, cx, cy))
