# SPDX-License-Identifier: Apache-2.0
"""The baseline of the benchmarks: the merged cloud as one writes it at first. No ROS here."""

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.pointcloud import CloudLimits
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.surround_depth import SurroundDepth


def baseline_cloud(surround: SurroundDepth, rig: Rig, limits: CloudLimits) -> NDArray[np.float32]:
    """Return the points [M, 4] that `merged_cloud` returns, whole cameras at a time, by plain numpy."""
    clouds = []
    for index, camera in enumerate(rig.cameras):
        cloud = _camera_cloud(surround, index)[:: limits.stride, :: limits.stride].reshape(-1, 4)
        cloud = cloud[(cloud[:, 2] >= limits.min_range) & (cloud[:, 2] <= limits.max_range)]
        base_T_camera = camera.base_T_camera.astype(np.float32)
        cloud[:, :3] = cloud[:, :3] @ base_T_camera[:3, :3].T + base_T_camera[:3, 3]
        clouds.append(cloud)
    return np.concatenate(clouds)


def _camera_cloud(surround: SurroundDepth, camera: int) -> NDArray[np.float32]:
    depth, picture = surround.depth[camera], surround.pictures[camera].astype(np.uint32)
    v, u = np.indices(depth.shape)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(surround.intrinsics[camera]).T
    rgb = (picture[..., 0] << 16 | picture[..., 1] << 8 | picture[..., 2]).view(np.float32)
    return np.concatenate([(rays * depth[..., None]).astype(np.float32), rgb[..., None]], axis=-1)
