# SPDX-License-Identifier: Apache-2.0
"""A rig that drives through a ray-cast world, and the surround moments that it takes there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from solid_world import FORWARD, Rectangle, camera_matrix, pose, render

from cvcdepth_core.refinement.moments import SurroundMoment

SIZE = (96, 160)
FOCAL = 110.0
SECOND = 10**9

Way = Callable[[float], np.ndarray]
"""world_T_base at a time in seconds."""


@dataclass(frozen=True)
class Drive:
    """Cameras on a vehicle in a world; every camera fires `delays` seconds after the set's moment."""

    surfaces: Sequence[Rectangle]
    base_T_camera: np.ndarray
    way: Way
    delays: tuple[float, ...] = ()
    size: tuple[int, int] = SIZE
    focal: float = FOCAL

    @property
    def intrinsics(self) -> np.ndarray:
        return np.repeat(camera_matrix(*self.size, self.focal)[None], len(self.base_T_camera), axis=0)

    def moment(self, time: float, prior: float | np.ndarray = 1.0) -> SurroundMoment:
        """The set at a moment, with the true depth times `prior`."""
        cameras = len(self.base_T_camera)
        times = time + np.array(self.delays or (0.0,) * cameras)
        poses = np.stack([self.way(t) for t in times])
        views = [
            render(self.surfaces, placed @ mount, K, self.size, t)
            for placed, mount, K, t in zip(poses, self.base_T_camera, self.intrinsics, times, strict=True)
        ]
        return SurroundMoment(
            depth=(np.stack([depth for _, depth in views]) * np.float32(prior)).astype(np.float32),
            pictures=np.stack([picture for picture, _ in views]),
            present=np.ones(cameras, bool),
            intrinsics=self.intrinsics,
            valid=np.ones((cameras, *self.size), bool),
            base_T_camera=self.base_T_camera,
            times_ns=np.round(times * SECOND).astype(np.int64),
            world_T_base=poses,
        )


def straight(velocity: tuple[float, float, float] = (0.0, 0.0, 0.0), yaw_rate: float = 0.0) -> Way:
    """Constant velocity (m/s, base frame axes at time 0) and turn rate (degrees/s)."""
    return lambda time: pose(*(v * time for v in velocity), yaw=yaw_rate * time)


def looking(yaw: float = 0.0, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """base_T_camera of a camera turned by `yaw` degrees to the left."""
    return pose(x, y, z, yaw) @ FORWARD


def ring(cameras: int = 4, step: float = 60.0) -> np.ndarray:
    """Cameras around the vehicle, each turned by `step` degrees against the one before, on a circle of 0.5 m."""
    angles = np.arange(cameras) * step
    return np.stack([looking(a, 0.5 * np.cos(np.radians(a)), 0.5 * np.sin(np.radians(a))) for a in angles])
