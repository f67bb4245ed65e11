# SPDX-License-Identifier: Apache-2.0
"""The pinhole view that is taken from a camera's lens, and the part of it that a network's picture shows."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.poses import Pose

WIDEST_PINHOLE_DEG = 120.0
"""Horizontal field of view above which a pinhole picture has hardly a pixel left for its middle."""

Aspect = Literal["crop", "pad", "stretch"]
"""How a picture comes into a network of another shape."""

# The published method resizes 1936x1216 to 640x384, its pixels 5 % wider than high; 16:9 in 8:5 are 11 % narrower, and were
# better than padded: networks take what fills the padding for the vehicle.
_SQUARE_ENOUGH = 1.12


class View(BaseModel):
    """A pinhole camera in the place of a real one: of its images' size, with square pixels and centred."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    hfov: float | None = Field(default=None, ge=5, le=WIDEST_PINHOLE_DEG, allow_inf_nan=False)
    """Degrees that the picture is wide."""
    focal_length: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """In place of `hfov`: focal length in pixels of the camera's images."""
    yaw: float = Field(default=0.0, ge=-180, le=180, allow_inf_nan=False)
    """Degrees to the left by which the view is turned around the vehicle's vertical; the horizon stays level."""

    @model_validator(mode="after")
    def _check(self) -> View:
        if (self.hfov is None) == (self.focal_length is None):
            raise ValueError("view: give hfov or focal_length, one of them")
        return self

    def focal_length_of(self, calibration: Calibration) -> float:
        """Return the focal length in pixels of the camera's images."""
        if self.focal_length is not None:
            return self.focal_length
        return calibration.image_size[0] / 2 / math.tan(math.radians(self.hfov or 0.0) / 2)

    def seen_from(
        self, calibration: Calibration, base_T_camera: Pose, rectified: bool = False
    ) -> tuple[Calibration, Pose]:
        """Return the view as a calibration of the same images, with R and P of its own, and its pose.

        Where the images are `rectified` already, the calibration's K is what was P, without distortion.
        """
        if rectified:
            calibration = _without_lens(calibration)
        base_R_camera = base_T_camera[:3, :3]
        base_T_view = base_T_camera.copy()
        base_T_view[:3, :3] = _turn_left(self.yaw) @ base_R_camera
        R = base_T_view[:3, :3].T @ base_R_camera @ calibration.rotation if self.yaw else calibration.rotation
        changes = {"r": tuple(R.ravel().tolist()), "p": self._projection(calibration)}
        return calibration.model_copy(update=changes), base_T_view

    def _projection(self, calibration: Calibration) -> tuple[float, ...]:
        """Return P, as CameraInfo has it: at the sensor's full resolution."""
        focal_length = self.focal_length_of(calibration)
        binning = (calibration.binning_x, calibration.binning_y)
        offset = (calibration.roi.x_offset, calibration.roi.y_offset)
        fx, fy = (focal_length * step for step in binning)
        cx, cy = (
            (size / 2) * step - 0.5 + first
            for size, step, first in zip(calibration.image_size, binning, offset, strict=True)
        )
        return (fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0)


class PicturePart(NamedTuple):
    """The part of the rectified picture, in its pixels, that a network's picture shows; larger where it is padded."""

    left: float
    top: float
    width: float
    height: float


def network_part(calibration: Calibration, height: int, width: int, aspect: Aspect) -> PicturePart:
    """Return which part of the rectified picture a network's picture of `height` x `width` shows.

    Where resizing the whole picture would make pixels more than 12 % wider or narrower than high, they stay square:
    `crop` shows the whole width and cuts off rows above and below, evenly, `pad` shows all of it and leaves borders
    without content. Columns are never cut off: they are what cameras share. A picture that is wider than the network's
    is padded either way. Else, and with `stretch`, all of it is resized.
    """
    image_width, image_height = calibration.image_size
    K = calibration.rectified_intrinsics
    scales = np.array([width / image_width, height / image_height])
    focal_lengths = scales * K.diagonal()[:2]
    if aspect == "stretch" or max(focal_lengths) <= _SQUARE_ENOUGH * min(focal_lengths):
        return PicturePart(0.0, 0.0, image_width, image_height)
    chosen = focal_lengths[0] if aspect == "crop" else min(focal_lengths)
    shown = np.array([width, height]) / (scales * chosen / focal_lengths)
    left, top = (np.array([image_width, image_height]) - shown) / 2
    return PicturePart(float(left), float(top), *shown.tolist())


def _without_lens(calibration: Calibration) -> Calibration:
    """Return the calibration of images that are rectified already: P is their K, and nothing distorts or turns them."""
    k = tuple(np.array(calibration.p).reshape(3, 4)[:, :3].ravel().tolist()) if any(calibration.p) else calibration.k
    plain = {"distortion_model": "plumb_bob", "d": (), "r": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)}
    return calibration.model_copy(update={"k": k, **plain})


def _turn_left(degrees: float) -> NDArray[np.float64]:
    """Return the rotation [3, 3] around z (up) that turns to the left."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
