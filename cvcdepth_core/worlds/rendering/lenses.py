# SPDX-License-Identifier: Apache-2.0
"""The rays of a camera's raw pixels, by OpenCV's undistortion of points: independent of our own rectifier.

Fisheyes see beyond 90 degrees from their axis, where OpenCV's points end: theirs are turned back by a table.
"""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.lens import angles_at, image_radii
from cvcdepth_core.worlds.shapes.meshes import Floats

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-13)
_MAX_ERROR = 1e-3  # pixels by which a ray may miss its pixel when it is projected again


class Lens:
    """One camera's pixels as rays in its optical frame (z forward, x right, y down)."""

    def __init__(self, name: str, calibration: Calibration, rectified: bool = False) -> None:
        """RigError names the camera and the first pixel whose ray cannot be found: the model does not reach there."""
        self.name = name
        self.width, self.height = calibration.image_size
        self._calibration = calibration
        self._rectified = rectified
        self._rays: dict[int, Floats] = {}
        self.centre_rays = self._sampled_rays(1)
        """Unit vectors [3, H, W] float64 through the pixels' centres."""

    def rays(self, samples: int) -> Floats:
        """Return unit vectors [3, H samples, W samples] float32: `samples` x `samples` of them through each pixel."""
        if samples not in self._rays:
            self._rays[samples] = self._sampled_rays(samples).astype(np.float32)
        return self._rays[samples]

    def _sampled_rays(self, samples: int) -> Floats:
        x = (np.arange(self.width * samples) + 0.5) / samples - 0.5
        y = (np.arange(self.height * samples) + 0.5) / samples - 0.5
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return np.moveaxis(self.through(pixels).reshape(len(y), len(x), 3), -1, 0)

    def through(self, pixels: Floats) -> Floats:
        """Return unit vectors [N, 3] float64 through the places `pixels` [N, 2] of the raw image."""
        rays = self._fisheye_rays(pixels) if self._is_fisheye else self._flat_rays(pixels)
        if not self._rectified:
            rays = rays @ self._calibration.rotation.T
        unit: Floats = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return unit

    def project(self, points: Floats) -> Floats:
        """Return the pixels [N, 2] float64 of points [N, 3] before the camera, metres in its optical frame."""
        c = self._calibration
        if self._rectified:
            homogeneous = points @ c.rectified_intrinsics.T
            pixels: Floats = homogeneous[:, :2] / homogeneous[:, 2:]
            return pixels
        return self._distorted(points @ c.rotation)

    def _distorted(self, points: Floats) -> Floats:
        """Return the raw pixels [N, 2] of points [N, 3] in the frame of the raw camera."""
        c, origin = self._calibration, np.zeros(3)
        K = c.raw_intrinsics
        if self._is_fisheye:
            across = np.linalg.norm(points[:, :2], axis=1)
            radii = image_radii(c, np.arctan2(across, points[:, 2]))
            places = points[:, :2] * (radii / np.maximum(across, 1e-12))[:, None]
            found: Floats = places * K[[0, 1], [0, 1]] + K[:2, 2]
            return found
        pixels, _ = cv2.projectPoints(np.ascontiguousarray(points[:, None]), origin, origin, K, c.distortion)
        return np.asarray(pixels, np.float64).reshape(-1, 2)

    @cached_property
    def pixel_angles(self) -> Floats:
        """Angle that each pixel spans, radians, [H, W]."""
        rays = self.centre_rays
        down = np.linalg.norm(np.gradient(rays, axis=1), axis=0) if self.height > 1 else 0.0
        right = np.linalg.norm(np.gradient(rays, axis=2), axis=0) if self.width > 1 else 0.0
        found: Floats = np.sqrt(np.maximum(down, 1e-9) * np.maximum(right, 1e-9))
        return found

    @property
    def _is_fisheye(self) -> bool:
        return self._calibration.distortion_model == "equidistant" and not self._rectified

    def _fisheye_rays(self, pixels: Floats) -> Floats:
        """Return unit vectors [N, 3] in the frame of the raw camera."""
        K = self._calibration.raw_intrinsics
        places = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
        radii = np.linalg.norm(places, axis=1)
        angles = angles_at(self._calibration, radii)
        rays: Floats = np.c_[places * (np.sin(angles) / np.maximum(radii, 1e-12))[:, None], np.cos(angles)]
        self._check(pixels, rays)
        return rays

    def _flat_rays(self, pixels: Floats) -> Floats:
        """Return the rays [N, 3], z = 1, in the frame of the raw camera."""
        normalised = self._normalised(pixels)
        rays: Floats = np.c_[normalised, np.ones(len(normalised))]
        if not self._rectified:
            self._check(pixels, rays)
        return rays

    def _normalised(self, pixels: Floats) -> Floats:
        """Return x / z and y / z [N, 2] of the raw camera's rays."""
        c = self._calibration
        if self._rectified:
            K = c.rectified_intrinsics
            return (pixels - K[:2, 2] - np.outer(pixels[:, 1] - K[1, 2], [K[0, 1] / K[1, 1], 0.0])) / K[[0, 1], [0, 1]]
        source = np.ascontiguousarray(pixels[:, None], np.float64)
        if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4, whose undistortPoints stops after five iterations
            found = cv2.undistortPointsIter(source, c.raw_intrinsics, c.distortion, np.eye(3), np.eye(3), _CRITERIA)
        else:
            found = cv2.undistortPoints(source, c.raw_intrinsics, c.distortion, criteria=_CRITERIA)
        normalised: Floats = np.asarray(found, np.float64).reshape(-1, 2)
        return normalised

    def _check(self, pixels: Floats, rays: Floats) -> None:
        """Project again: outside of what a distortion polynomial was fitted to, undistorting ends anywhere."""
        c = self._calibration
        errors = np.linalg.norm(self._distorted(rays) - pixels, axis=1)
        worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
        if not errors[worst] < _MAX_ERROR:
            x, y = pixels[worst].tolist()
            raise RigError(
                f"camera {self.name}: {c.distortion_model} with d = {list(c.d)} cannot be inverted at pixel "
                f"({x:.1f}, {y:.1f}) of {self.width}x{self.height}: its ray comes back {errors[worst]:.3g} pixels off"
            )
