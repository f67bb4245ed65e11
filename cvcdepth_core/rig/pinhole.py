# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera: intrinsics of scaled images, rays through pixels, and points seen in a rectified picture.

Pixel centres are the integers: pixel (0, 0) spans [-0.5, 0.5]. Scaling an image by s therefore takes the principal
point c to (c + 0.5) s - 0.5. The differentiable versions for torch are in `rendering.projection`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.poses import Pose, inverse


def scale_intrinsics(
    intrinsics: NDArray[np.float64], scale: tuple[float, float], offset: tuple[float, float] = (0.0, 0.0)
) -> NDArray[np.float64]:
    """Return the intrinsics [3, 3] of an image first shifted by `offset` pixels (x, y), then scaled by `scale` (x, y).

    Pixel centres stay at integers: c -> (c + offset + 0.5) scale - 0.5.
    """
    scaled: NDArray[np.float64] = intrinsics.copy()
    for row in (0, 1):
        scaled[row, :2] *= scale[row]
        scaled[row, 2] = (intrinsics[row, 2] + offset[row] + 0.5) * scale[row] - 0.5
    return scaled


def rays_through(pixels: NDArray[np.number], intrinsics: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rays (x, y, 1) [M, 3] in the optical frame through `pixels` (u, v) [M, 2]."""
    homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
    rays: NDArray[np.float64] = homogeneous @ np.linalg.inv(intrinsics).T
    return rays


def pixel_rays(intrinsics: NDArray[np.float64], height: int, width: int) -> NDArray[np.float32]:
    """Return the rays (x, y, 1) [H, W, 3] in the optical frame through all pixel centres of a picture."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    rays: NDArray[np.float64] = pixels @ np.linalg.inv(intrinsics).T
    return rays.astype(np.float32)


@dataclass(frozen=True, eq=False)
class PinholeView:
    """A rectified picture and where it was taken from."""

    intrinsics: NDArray[np.float64]
    """[3, 3], pixel centres at the integers."""
    base_T_camera: Pose
    """[4, 4] metres."""
    height: int
    """Rows."""
    width: int
    """Columns."""

    def project(self, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return pixels (u, v) [M, 2] and depths z [M] in metres of `points` [M, 3] in the base frame.

        Pixels of points that are not in front of the camera are NaN.
        """
        camera_T_base = inverse(self.base_T_camera)
        in_camera = points.astype(np.float64) @ camera_T_base[:3, :3].T + camera_T_base[:3, 3]
        z = in_camera[:, 2]
        divisor = np.where(z > 0, z, np.nan)[:, None]
        return (in_camera @ self.intrinsics.T)[:, :2] / divisor, z
