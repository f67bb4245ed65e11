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
from cvcdepth_core.rig.lens import angles_at, equidistant_radii, largest_angle
from cvcdepth_core.rig.pinhole import scale_intrinsics
from cvcdepth_core.rig.view import Aspect, network_part

_MAX_OVERSAMPLING = 8
_FAR_OUTSIDE = -1e6  # pixels
_REDUCTIONS: tuple[Reduction, ...] = (8, 4, 2)


class Rectifier:
    """Resamples one camera's raw pictures to rectified ones of `height` x `width` pixels.

    `intrinsics` [3, 3] float64 belong to the rectified, resized picture, in its pixels (centres at the integers); what
    of it these show is `aspect`'s to say, see `network_part`.
    `visible`, bool [height, width], is False where the rectified picture shows nothing of the raw one: outside it, and
    beyond the angle up to which the distortion model holds. Pictures are reduced by `reduction` before they are
    resampled, by the decoder where it can.
    """

    def __init__(
        self, calibration: Calibration, height: int, width: int, rectified: bool = False, aspect: Aspect = "stretch"
    ) -> None:
        image_width, image_height = calibration.image_size
        self.height, self.width = height, width
        self.image_size = calibration.image_size
        part = network_part(calibration, height, width, aspect)
        self.intrinsics = scale_intrinsics(
            calibration.rectified_intrinsics, (width / part.width, height / part.height), (-part.left, -part.top)
        )
        finer = _pixels_per_network_pixel(calibration, self.intrinsics, rectified)
        self.reduction: Reduction = _reduction(finer)
        # What is reduced is low-passed already; bilinear samples 1.5 pixels apart still touch each of its pixels.
        spacing = self.reduction * (1.5 if self.reduction > 1 else 1.0)
        x, y = _sampling_maps(calibration, self.intrinsics, (width, height), rectified, finer / spacing)
        inside = (x >= -0.5) & (x <= image_width - 0.5) & (y >= -0.5) & (y <= image_height - 0.5)
        self.visible: NDArray[np.bool_] = self._average(255 * inside.astype(np.uint8)) == 255
        if not rectified:
            self.visible &= _ray_angles(calibration, self.intrinsics, (width, height)) < largest_angle(calibration)
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
    """Return where each pixel of the raw image lies in the rectified picture with `intrinsics`, float32 [h, w, 2].

    Far outside, at -1e6, for what lies behind the rectified camera.
    """
    width, height = calibration.image_size
    raw = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2).astype(np.float64)
    rays = _raw_rays(calibration, rectified, raw)
    x, y, z = intrinsics @ _raw_view(calibration, rectified)[2] @ rays
    ahead = z > 1e-6
    divisor = np.where(ahead, z, 1.0)
    pixels = np.where(ahead[:, None], np.stack([x / divisor, y / divisor], axis=-1), _FAR_OUTSIDE)
    return pixels.astype(np.float32).reshape(height, width, 2)


def _raw_rays(calibration: Calibration, rectified: bool, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rays [3, M] through `pixels` [M, 2] of the raw image, in the raw camera's frame."""
    source, distortion, _ = _raw_view(calibration, rectified)
    if not _is_fisheye(calibration, rectified):
        x, y = cv2.undistortPoints(pixels[:, None], source, distortion).reshape(-1, 2).T
        return np.stack([x, y, np.ones_like(x)])
    x, y = ((pixels - source[:2, 2]) / source.diagonal()[:2]).T
    radii = np.hypot(x, y)
    angles = angles_at(calibration, radii)
    sines = np.sin(angles) / np.maximum(radii, 1e-12)
    return np.stack([x * sines, y * sines, np.cos(angles)])


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
    fine_size = (size[0] * ox, size[1] * oy)
    if _is_fisheye(calibration, rectified):
        return _fisheye_maps(source, distortion, rotation, fine, fine_size)
    x, y = cv2.initUndistortRectifyMap(source, distortion, rotation, fine, fine_size, cv2.CV_32FC1)
    # OpenCV knows no behind: what a turned view sees there would show the picture's front once more.
    behind = _ray_depths(rotation, fine, fine_size) <= 0
    x[behind] = _FAR_OUTSIDE
    return x, y


def _fisheye_maps(
    source: NDArray[np.float64],
    distortion: NDArray[np.float64],
    rotation: NDArray[np.float64],
    fine: NDArray[np.float64],
    size: tuple[int, int],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the maps of the equidistant model, also for rays beyond 90 degrees, which OpenCV's leave out."""
    x, y = np.empty(size[::-1], np.float32), np.empty(size[::-1], np.float32)
    to_raw = rotation.T @ np.linalg.inv(fine)
    u = np.arange(size[0], dtype=np.float64)
    for row in range(size[1]):  # a row at a time: all at once would take a hundred bytes for each sample
        rays = to_raw @ np.stack([u, np.full_like(u, row), np.ones_like(u)])
        across = np.hypot(rays[0], rays[1])
        radii = equidistant_radii(distortion, np.arctan2(across, rays[2]))
        stretch = radii / np.maximum(across, 1e-12)
        x[row] = source[0, 0] * stretch * rays[0] + source[0, 2]
        y[row] = source[1, 1] * stretch * rays[1] + source[1, 2]
    return x, y


def _ray_depths(
    rotation: NDArray[np.float64], intrinsics: NDArray[np.float64], size: tuple[int, int]
) -> NDArray[np.float64]:
    """Return z [H, W] in the raw camera's frame of the rays through a picture's pixels."""
    across, down, first = (rotation.T @ np.linalg.inv(intrinsics))[2]
    depths: NDArray[np.float64] = across * np.arange(size[0]) + (down * np.arange(size[1]) + first)[:, None]
    return depths


def _raw_view(
    calibration: Calibration, rectified: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the camera matrix, distortion and rectifying rotation of the pictures that the camera sends."""
    if rectified:
        return calibration.rectified_intrinsics, np.zeros(4), np.eye(3)
    return calibration.raw_intrinsics, calibration.distortion, calibration.rotation


def _is_fisheye(calibration: Calibration, rectified: bool) -> bool:
    return calibration.distortion_model == "equidistant" and not rectified


def _ray_angles(
    calibration: Calibration, intrinsics: NDArray[np.float64], size: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the angle [H, W] between each network pixel's ray and the raw camera's axis, radians."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    raw_from_pixels = calibration.rotation.T @ np.linalg.inv(intrinsics)
    x, y, z = np.tensordot(raw_from_pixels, np.stack([u, v, np.ones_like(u)]), axes=1)
    angles: NDArray[np.float64] = np.arctan2(np.hypot(x, y), z)
    return angles


def _oversampling(samples_per_network_pixel: float) -> int:
    """Return the whole number of samples along one axis, rounded up; bounded for calibrations that zoom far out."""
    return min(max(1, math.ceil(samples_per_network_pixel - 1e-6)), _MAX_OVERSAMPLING)
