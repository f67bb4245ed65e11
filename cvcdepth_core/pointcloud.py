# SPDX-License-Identifier: Apache-2.0
"""Coloured point clouds from depth: float32 [..., 4] with x, y, z in metres and the colour packed as PCL packs it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.estimator import SurroundDepth
from cvcdepth_core.rig import Rig

Cloud = NDArray[np.float32]


@dataclass(frozen=True)
class CloudLimits:
    """Which pixels the merged cloud takes."""

    stride: int = 1
    """Every n-th row and column."""
    min_range: float = 0.0
    """Metres from the camera along its axis; nearer points are left out."""
    max_range: float = float("inf")
    """Metres from the camera along its axis; farther points are left out."""


def pixel_rays(intrinsics: NDArray[np.float64], height: int, width: int) -> NDArray[np.float32]:
    """Rays (x, y, 1) [H, W, 3] through the pixel centres, in the optical frame."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    rays: NDArray[np.float64] = pixels @ np.linalg.inv(intrinsics).T
    return rays.astype(np.float32)


def pack_rgb(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Pack RGB [..., 3] into float32 [...] whose bits are 0x00RRGGBB, the `rgb` field that RViz and PCL read."""
    channels = picture.astype(np.uint32)
    packed = channels[..., 0] * 0x10000 + channels[..., 1] * 0x100 + channels[..., 2]
    return packed.astype(np.uint32, copy=False).view(np.float32)


def organised_cloud(surround: SurroundDepth, camera: int) -> Cloud:
    """Return one camera's cloud [H, W, 4] in its optical frame; x, y, z are NaN where depth is (REP 118)."""
    depth = surround.depth[camera]
    xyz = pixel_rays(surround.intrinsics[camera], *depth.shape) * depth[..., None]
    return np.concatenate([xyz, pack_rgb(surround.pictures[camera])[..., None]], axis=-1)


def merged_cloud(surround: SurroundDepth, rig: Rig, limits: CloudLimits) -> Cloud:
    """Return the points of all cameras with known depth inside `limits`, [M, 4] in the base frame."""
    clouds = []
    for index, camera in enumerate(rig.cameras):
        cloud = organised_cloud(surround, index)[:: limits.stride, :: limits.stride].reshape(-1, 4)
        depth = cloud[:, 2]
        cloud = cloud[(depth >= limits.min_range) & (depth <= limits.max_range)]
        base_T_camera = camera.base_T_camera.astype(np.float32)
        cloud[:, :3] = cloud[:, :3] @ base_T_camera[:3, :3].T + base_T_camera[:3, 3]
        clouds.append(cloud)
    return np.concatenate(clouds)
