# SPDX-License-Identifier: Apache-2.0
"""What a lens sees: the angles between its axis and the rays that reach its image, also beyond 90 degrees."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.calibration import Calibration

_SAMPLES = 2000  # of 90 degrees
_LEAST_SLOPE = 1e-3  # focal lengths per radian: near the turn of a polynomial a step would leave it


class FieldOfView(NamedTuple):
    """Angles in degrees from the lens's axis to the middles of the image's sides."""

    left: float
    right: float
    up: float
    down: float

    @property
    def horizontal(self) -> float:
        """Degrees that the image is wide."""
        return self.left + self.right


def image_radii(calibration: Calibration, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far from the principal point, in focal lengths, rays at `angles` (radians) from the axis arrive.

    Only the lens's radial distortion counts: the small tangential, prism and tilt terms would tilt the axis.
    """
    d = calibration.distortion
    if calibration.distortion_model == "equidistant":
        return equidistant_radii(d, angles)
    k = [*d[:2], *d[4:8], *[0.0] * 6]
    r = np.tan(angles)
    square = r * r
    above = 1 + square * (k[0] + square * (k[1] + square * k[2]))
    below = 1 + square * (k[3] + square * (k[4] + square * k[5]))
    radii: NDArray[np.float64] = r * above / below
    return radii


def equidistant_radii(distortion: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the radii of `image_radii` for the four coefficients of the equidistant model (Kannala, Brandt 2006)."""
    k1, k2, k3, k4 = distortion
    square = angles * angles
    radii: NDArray[np.float64] = angles * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    return radii


def angle_table(calibration: Calibration) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return angles [M] from the axis, radians, and their `image_radii`: up to where the radii stop to grow.

    A distortion polynomial turns back beyond the angles that it was fitted to, and would show the picture twice.
    Fisheyes see up to 180 degrees from their axis, other models less than 90.
    """
    quarters = 2 if calibration.distortion_model == "equidistant" else 1
    angles = np.linspace(0.0, 0.5 * math.pi * quarters, _SAMPLES * quarters, endpoint=False)
    radii = image_radii(calibration, angles)
    shrinks = np.flatnonzero(np.diff(radii) <= 0)
    last = int(shrinks[0]) + 1 if shrinks.size else len(angles)
    return angles[:last], radii[:last]


def largest_angle(calibration: Calibration) -> float:
    """Return the angle from the axis, radians, below which the distortion model holds."""
    angles, _ = angle_table(calibration)
    is_fisheye = calibration.distortion_model == "equidistant"
    whole = _SAMPLES * (2 if is_fisheye else 1)
    return float(angles[-1]) if len(angles) < whole else math.pi * (1.0 if is_fisheye else 0.5)


def angles_at(calibration: Calibration, radii: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angles from the axis, radians, that reach `radii` (see `image_radii`); the largest beyond it."""
    angles, known = angle_table(calibration)
    found: NDArray[np.float64] = np.interp(radii, known, angles)
    step = 1e-6
    slopes = (image_radii(calibration, found + step) - image_radii(calibration, found - step)) / (2 * step)
    # The table is true to 1e-7; one step of Newton's makes it true to the last digits.
    refined = found - (image_radii(calibration, found) - radii) / np.where(slopes > _LEAST_SLOPE, slopes, np.inf)
    return np.where(radii < known[-1], refined, found)


def field_of_view(calibration: Calibration, rectified: bool = False) -> FieldOfView:
    """Return what the raw image shows; where the images are `rectified` already, what these do."""
    K = calibration.rectified_intrinsics if rectified else calibration.raw_intrinsics
    width, height = calibration.image_size
    sides = np.array([K[0, 2] + 0.5, width - 0.5 - K[0, 2], K[1, 2] + 0.5, height - 0.5 - K[1, 2]])
    radii = sides / K[[0, 0, 1, 1], [0, 0, 1, 1]]
    signed = np.arctan(radii) if rectified else np.sign(radii) * angles_at(calibration, abs(radii))
    return FieldOfView(*np.degrees(signed).tolist())
