# SPDX-License-Identifier: Apache-2.0
"""A ray-cast street: flat ground, a far wall, and a post in front of it."""

import math

import numpy as np

from cvcdepth_core.rendering.agreement import PosedDepth
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.pinhole import pixel_rays
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_core.surround_depth import SurroundDepth

HEIGHT, WIDTH, FOCAL = 96, 160, 110.0
K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
WALL, POST = 12.0, (6.0, -0.6, 0.6)  # x of the wall; x and the range of y of the post


def turned(degrees: float) -> np.ndarray:
    angle = math.radians(degrees)
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return pose


def camera(name: str, y: float, yaw: float) -> Camera:
    base_T_camera = turned(yaw) @ FORWARD
    base_T_camera[:3, 3] = 0.0, y, 1.5
    calibration = Calibration(width=WIDTH, height=HEIGHT, k=tuple(K.ravel()))
    return Camera(name, calibration, base_T_camera)


def cast(world_T_camera: np.ndarray, post: bool) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] and picture [H, W, 3] of the street."""
    rays = pixel_rays(K, HEIGHT, WIDTH).astype(np.float64) @ world_T_camera[:3, :3].T
    origin = world_T_camera[:3, 3]
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], np.inf)
        depth = np.minimum(ground, (WALL - origin[0]) / rays[..., 0])
        at_post = (POST[0] - origin[0]) / rays[..., 0]
    y = origin[1] + at_post * rays[..., 1]
    on_post = post & (y > POST[1]) & (y < POST[2]) & (at_post < depth)
    depth = np.where(on_post, at_post, depth)
    x, y, z = np.moveaxis(origin + rays * depth[..., None], -1, 0)
    waves = [np.sin(2.1 * y + 1.3 * z + x), np.cos(1.7 * x - 2.3 * y), np.sin(1.9 * z - 0.8 * y + 0.5 * x)]
    return depth.astype(np.float32), np.rint(127 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)


RIG = Rig((camera("left", 0.4, 8.0), camera("right", -0.4, -8.0)), "base_link", "left", {})


def seen(world_T_base: np.ndarray | None = None, post: bool = True) -> PosedDepth:
    """What the rig sees from a place, with the right depth and the right poses."""
    poses = [(np.eye(4) if world_T_base is None else world_T_base) @ camera.base_T_camera for camera in RIG.cameras]
    depth, pictures = map(np.stack, zip(*(cast(pose, post) for pose in poses), strict=True))
    surround = SurroundDepth(depth, pictures, np.stack([K, K]), np.ones(2, bool))
    return PosedDepth.from_rig(surround, RIG, None if world_T_base is None else [world_T_base] * 2)
