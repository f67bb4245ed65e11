# SPDX-License-Identifier: Apache-2.0
"""From a camera's raw picture to the rectified one that the network sees: for the node, the bag tool and the trainer.

Undistorting, rectifying and resizing happen in one resampling whose maps are built once per calibration. The picture is
sampled on a grid that is finer than the network's by whole numbers, at least as fine as the picture itself, and the
samples of each network pixel are averaged: that keeps what the network's resolution cannot show from aliasing into it.
A picture that is much finer than the network's is reduced by a half, a quarter or an eighth before; decoders do that
while they decode, in less than half the time.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError
from cvcdepth_core.images.decoding import Picture, Reduction, reduce_picture
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.pinhole import scale_intrinsics

_MAX_OVERSAMPLING = 8
_REDUCTIONS: tuple[Reduction, ...] = (8, 4, 2)


class Rectifier:
    """Resamples one camera's raw pictures to rectified ones of `height` x `width` pixels.

    `intrinsics` [3, 3] float64 belong to the rectified, resized picture, in its pixels (centres at the integers).
    `visible`, bool [height, width], is False where the rectified picture shows nothing of the raw one: outside it, and
    beyond the angle up to which the distortion model holds. Pictures are reduced by `reduction` before they are
    resampled, by the decoder where it can.
    """

    def __init__(self, calibration: Calibration, height: int, width: int, rectified: bool = False) -> None:
        image_width, image_height = calibration.image_size
        self.height, self.width = height, width
        self.image_size = calibration.image_size
        self.intrinsics = scale_intrinsics(
            calibration.rectified_intrinsics, (width / image_width, height / image_height)
        )
        finer = _pixels_per_network_pixel(calibration, self.intrinsics, rectified)
        self.reduction: Reduction = _reduction(finer)
        # What is reduced is low-passed already; bilinear samples 1.5 pixels apart still touch each of its pixels.
        spacing = self.reduction * (1.5 if self.reduction > 1 else 1.0)
        x, y = _sampling_maps(calibration, self.intrinsics, (width, height), rectified, finer / spacing)
        inside = (x >= -0.5) & (x <= image_width - 0.5) & (y >= -0.5) & (y <= image_height - 0.5)
        self.visible: NDArray[np.bool_] = self._average(255 * inside.astype(np.uint8)) == 255
        if not rectified:
            self.visible &= _ray_radii(calibration, self.intrinsics, (width, height)) < _unfolded_radius(calibration)
        shift = 0.5 / self.reduction - 0.5
        self._maps = cv2.convertMaps(x / self.reduction + shift, y / self.reduction + shift, cv2.CV_16SC2)

    def __call__(self, picture: Picture, camera: str, reduced: Reduction = 1) -> Picture:
        """Rectify and resize `picture`, uint8 [h, w] or [h, w, 3], to uint8 [height, width] or [height, width, 3].

        It has been `reduced` already: not at all, or by this rectifier's `reduction`. ImageError names the camera when
        its size is not the calibration's.
        """
        found, full = (picture.shape[1], picture.shape[0]), self.image_size
        want = (-(-full[0] // reduced), -(-full[1] // reduced))
        if found != want:
            scale = f" / {reduced}" if reduced > 1 else ""
            raise ImageError(
                f"camera {camera}: image of {found[0]}x{found[1]}, but its camera_info says {full[0]}x{full[1]}{scale}"
            )
        picture = reduce_picture(picture, self.reduction // reduced)
        return self._average(cv2.remap(picture, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    def _average(self, samples: NDArray[np.uint8]) -> Picture:
        """Average the samples of each network pixel; INTER_AREA is exact for whole-number ratios."""
        resized: Picture = cv2.resize(samples, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return resized


def raw_pixels(calibration: Calibration, rectified: bool, intrinsics: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return where each pixel of the raw image lies in the rectified picture with `intrinsics`, float32 [h, w, 2]."""
    width, height = calibration.image_size
    raw = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(np.float64)
    source, distortion, rotation = _raw_view(calibration, rectified)
    undistort = cv2.fisheye.undistortPoints if _is_fisheye(calibration, rectified) else cv2.undistortPoints
    pixels = undistort(raw, source, distortion, R=rotation, P=intrinsics)
    return np.asarray(pixels, np.float32).reshape(height, width, 2)


def _pixels_per_network_pixel(
    calibration: Calibration, intrinsics: NDArray[np.float64], rectified: bool
) -> NDArray[np.float64]:
    """Return how many raw pixels one network pixel is wide and high, in the middle of the picture."""
    source, _, _ = _raw_view(calibration, rectified)
    ratios: NDArray[np.float64] = (source.diagonal() / intrinsics.diagonal())[:2]
    return ratios


def _reduction(pixels_per_network_pixel: NDArray[np.float64]) -> Reduction:
    """Return the greatest reduction that leaves two pixels per network pixel, for those that a lens has drawn apart."""
    least = float(pixels_per_network_pixel.min())
    return next((reduction for reduction in _REDUCTIONS if least >= 2 * reduction), 1)


def _sampling_maps(
    calibration: Calibration,
    intrinsics: NDArray[np.float64],
    size: tuple[int, int],
    rectified: bool,
    samples_per_network_pixel: NDArray[np.float64],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where each sample of the fine grid lies in the raw picture: x, y, float32 [H oy, W ox], in pixels."""
    source, distortion, rotation = _raw_view(calibration, rectified)
    ox, oy = map(_oversampling, samples_per_network_pixel)
    fine = scale_intrinsics(intrinsics, (ox, oy))
    fisheye = _is_fisheye(calibration, rectified)
    build = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    x, y = build(source, distortion, rotation, fine, (size[0] * ox, size[1] * oy), cv2.CV_32FC1)
    return x, y


def _raw_view(
    calibration: Calibration, rectified: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the camera matrix, distortion and rectifying rotation of the pictures that the camera sends."""
    if rectified:
        return calibration.rectified_intrinsics, np.zeros(4), np.eye(3)
    return calibration.raw_intrinsics, calibration.distortion, calibration.rotation


def _is_fisheye(calibration: Calibration, rectified: bool) -> bool:
    return calibration.distortion_model == "equidistant" and not rectified


def _ray_radii(calibration: Calibration, intrinsics: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """Return each network pixel's distance [H, W] from the raw camera's axis at z = 1; inf behind the camera."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    raw_from_pixels = calibration.rotation.T @ np.linalg.inv(intrinsics)
    x, y, z = np.tensordot(raw_from_pixels, np.stack([u, v, np.ones_like(u)]), axes=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        radii: NDArray[np.float64] = np.where(z > 0, np.hypot(x, y) / z, np.inf)
    return radii


def _unfolded_radius(calibration: Calibration) -> float:
    """Return the radius at z = 1 up to which the distorted radius grows, inf where it always does.

    A distortion polynomial turns back beyond the angles it was fitted to and would show the picture a second time.
    """
    radii = np.tan(np.linspace(0.0, 0.5 * math.pi, 2000, endpoint=False))
    points = np.stack([radii, np.zeros_like(radii), np.ones_like(radii)], axis=1)[:, None]
    origin = np.zeros(3)
    if calibration.distortion_model == "equidistant":
        projected, _ = cv2.fisheye.projectPoints(points, origin, origin, np.eye(3), calibration.distortion)
    else:
        # Only the radial part folds; the small tangential, prism and tilt terms would tilt the axis looked along.
        radial = calibration.distortion.copy()
        radial[[2, 3, *range(8, len(radial))]] = 0.0
        projected, _ = cv2.projectPoints(points, origin, origin, np.eye(3), radial)
    shrinks = np.flatnonzero(np.diff(projected[:, 0, 0]) <= 0)
    return float(radii[shrinks[0]]) if shrinks.size else math.inf


def _oversampling(samples_per_network_pixel: float) -> int:
    """Return the whole number of samples along one axis, rounded up; bounded for calibrations that zoom far out."""
    return min(max(1, math.ceil(samples_per_network_pixel - 1e-6)), _MAX_OVERSAMPLING)
