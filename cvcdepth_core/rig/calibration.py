# SPDX-License-Identifier: Apache-2.0
"""One camera's calibration: the content of a `sensor_msgs/CameraInfo`, validated."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, model_validator

from cvcdepth_core.errors import RigError, first_validation_message
from cvcdepth_core.rig.pinhole import scale_intrinsics

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
_COEFFICIENT_COUNTS: dict[str, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (0, 8, 12, 14),
    "equidistant": (0, 4),
}
MAX_PIXELS = 50_000_000
"""Pixels of the largest image that a camera may send; decoding takes up to 16 bytes for each."""
# Far beyond any lens, and far within what arithmetic holds: a principal point in image sizes, an image size in focal
# lengths, and a distortion coefficient.
_MAX_RATIO = 1e4
_MAX_COEFFICIENT = 1e6
# In image sizes: a field of view of 0.6 degrees, 600 mm before a sensor of 6 mm.
_MAX_FOCAL_LENGTH = 100
_MAX_SIDE = 2**15 - 2  # pixels: OpenCV's remap counts in 16 bits, and refuses 32767
# No sensor is so narrow; buffers of a given width whose height follows the image's would grow without end.
_MAX_ASPECT = 20


class RegionOfInterest(BaseModel):
    """The part of the full sensor that the image shows, in unbinned pixels; width = height = 0 means all of it."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    x_offset: int = 0
    """Leftmost column."""
    y_offset: int = 0
    """Topmost row."""
    width: int = 0
    """Columns, 0 for all."""
    height: int = 0
    """Rows, 0 for all."""


class Calibration(BaseModel):
    """Intrinsics and distortion of one camera, field by field as `sensor_msgs/CameraInfo` defines them.

    K and D describe the raw image, R and P the rectified one, all at the full, unbinned resolution. With R other than
    the identity (a stereo pair), the camera's frame is the rectified one, as depth_image_proc and stereo_image_proc
    take it. Build it with `calibration_from_fields`, whose errors name the camera.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    width: int
    """Columns of the full sensor image."""
    height: int
    """Rows of the full sensor image."""
    distortion_model: DistortionModel = "plumb_bob"
    """How D is to be read."""
    d: tuple[float, ...] = ()
    """Distortion coefficients in OpenCV's order; empty for none."""
    k: tuple[float, ...]
    """Raw camera matrix, 9 numbers row by row."""
    r: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    """Rectifying rotation, 9 numbers row by row."""
    p: tuple[float, ...] = (0.0,) * 12
    """Rectified projection, 12 numbers row by row; all zeros means that the rectified camera has the matrix K."""
    binning_x: int = 1
    """Sensor columns per image column."""
    binning_y: int = 1
    """Sensor rows per image row."""
    roi: RegionOfInterest = RegionOfInterest()
    """The part of the sensor that the image shows."""

    @model_validator(mode="before")
    @classmethod
    def _name_the_model_of_no_distortion(cls, fields: Any) -> Any:
        # Converters of rectified datasets name no model and give no coefficients: then there is nothing to misread.
        if isinstance(fields, dict) and fields.get("distortion_model") == "" and not fields.get("d"):
            return fields | {"distortion_model": "plumb_bob"}
        return fields

    @model_validator(mode="after")
    def _check(self) -> "Calibration":
        problem = _first_problem(self)
        if problem:
            raise ValueError(problem)
        return self

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the images that the camera sends, after region of interest and binning."""
        width, height = self.roi.width or self.width, self.roi.height or self.height
        return width // self.binning_x, height // self.binning_y

    @property
    def raw_intrinsics(self) -> NDArray[np.float64]:
        """K [3, 3] of the raw image as sent, in its own pixels."""
        return self._in_image_pixels(np.array(self.k).reshape(3, 3))

    @property
    def rectified_intrinsics(self) -> NDArray[np.float64]:
        """Left 3x3 part of P (of K where P is all zeros), in pixels of an image of `image_size`."""
        if any(self.p):
            return self._in_image_pixels(np.array(self.p).reshape(3, 4)[:, :3])
        return self.raw_intrinsics

    @property
    def rotation(self) -> NDArray[np.float64]:
        """R [3, 3]: takes rays of the raw camera to the rectified one."""
        return np.array(self.r).reshape(3, 3)

    @property
    def distortion(self) -> NDArray[np.float64]:
        """D as OpenCV wants it; zeros where the file has none."""
        return np.array(self.d if self.d else (0.0,) * 4)

    def _in_image_pixels(self, sensor_intrinsics: NDArray[np.float64]) -> NDArray[np.float64]:
        offset = (-self.roi.x_offset, -self.roi.y_offset)
        return scale_intrinsics(sensor_intrinsics, (1 / self.binning_x, 1 / self.binning_y), offset)


def calibration_from_fields(camera: str, fields: dict[str, object]) -> Calibration:
    """Build a Calibration from the fields of a CameraInfo; RigError names the camera and the first impossible field."""
    try:
        return Calibration.model_validate(fields)
    except ValueError as error:
        raise RigError(f"camera {camera}: camera_info: {first_validation_message(error)}") from error


def _first_problem(calibration: Calibration) -> str | None:
    """Say what makes the calibration impossible, most basic reason first; None where nothing does."""
    checks = (_size_problem, _count_problem, _number_problem, _matrix_problem, _region_problem)
    return next((problem for check in checks if (problem := check(calibration))), None)


def _size_problem(c: Calibration) -> str | None:
    if c.width <= 0 or c.height <= 0:
        return f"size {c.width}x{c.height}: the camera has no pixels"
    if c.width * c.height > MAX_PIXELS:
        return f"size {c.width}x{c.height}: more than {MAX_PIXELS} pixels"
    if max(c.width, c.height) > _MAX_SIDE:
        return f"size {c.width}x{c.height}: a side is longer than {_MAX_SIDE} pixels"
    return None


def _count_problem(c: Calibration) -> str | None:
    for name, row, want in (("k", c.k, 9), ("r", c.r, 9), ("p", c.p, 12)):
        if len(row) != want:
            return f"{name} has {len(row)} numbers, want {want}"
    counts = _COEFFICIENT_COUNTS[c.distortion_model]
    if len(c.d) not in counts:
        return f"{c.distortion_model} takes {_alternatives(counts)} numbers in d, found {len(c.d)}"
    return None


def _number_problem(c: Calibration) -> str | None:
    for name, row in (("k", c.k), ("d", c.d), ("r", c.r), ("p", c.p)):
        if not all(map(math.isfinite, row)):
            return f"{name} = {row} is not finite"
    if any(abs(coefficient) > _MAX_COEFFICIENT for coefficient in c.d):
        return f"d = {c.d}: no lens has coefficients beyond {_MAX_COEFFICIENT:g}"
    if c.k[0] == 0.0:
        return "K[0] = 0: the camera is not calibrated"
    if c.binning_x < 1 or c.binning_y < 1:
        return f"binning {c.binning_x} x {c.binning_y}: want 1 or more"
    return None


def _matrix_problem(c: Calibration) -> str | None:
    if not (c.k[0] > 0 and c.k[4] > 0 and c.k[8] == 1.0):
        return f"K = {c.k} is not a camera matrix: want fx > 0, fy > 0 and 1 in the corner"
    if c.k[3] or c.k[6] or c.k[7]:
        return f"K = {c.k} is not a camera matrix: want zeros left of the diagonal"
    if any(c.p) and not (c.p[0] > 0 and c.p[5] > 0 and c.p[10] == 1.0):
        return f"P = {c.p} is not a projection matrix: want fx > 0, fy > 0 and 1 in the corner"
    if c.p[4] or c.p[8] or c.p[9]:
        return f"P = {c.p} is not a projection matrix: want zeros left of the diagonal"
    lengths = (c.k[0], c.k[4], *((c.p[0], c.p[5]) if any(c.p) else ()))
    size, centre = max(c.width, c.height), max(map(abs, (c.k[1], c.k[2], c.k[5], c.p[1], c.p[2], c.p[6])))
    if not size / _MAX_RATIO < min(lengths) <= max(lengths) < size * _MAX_FOCAL_LENGTH or centre > size * _MAX_RATIO:
        return f"K = {c.k}, P = {c.p}: no lens sees an image of {c.width}x{c.height} so"
    R = c.rotation
    is_rotation = np.abs(R).max() < 2 and np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0
    return None if is_rotation else f"R = {c.r} is not a rotation"


def _region_problem(c: Calibration) -> str | None:
    right, bottom = c.roi.x_offset + (c.roi.width or c.width), c.roi.y_offset + (c.roi.height or c.height)
    if min(c.roi.x_offset, c.roi.y_offset, c.roi.width, c.roi.height) < 0 or right > c.width or bottom > c.height:
        return f"region of interest {c.roi.model_dump()} is not inside the sensor's {c.width}x{c.height}"
    if 0 in c.image_size:
        return f"binning {c.binning_x} x {c.binning_y} leaves an image of {c.image_size[0]}x{c.image_size[1]}"
    if max(c.image_size) > _MAX_ASPECT * min(c.image_size):
        return f"image of {c.image_size[0]}x{c.image_size[1]}: one side is more than {_MAX_ASPECT} times the other"
    return None


def _alternatives(counts: Sequence[int]) -> str:
    return " or ".join(map(str, counts))
