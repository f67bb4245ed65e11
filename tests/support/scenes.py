# SPDX-License-Identifier: Apache-2.0
"""Rigs and scenes for the tests: random ones for algebra, and a textured slanted plane with known depth for physics."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cvcdepth_core.rendering.projection import axis_angle_to_rotation, rigid, rigid_inverse, unit_depth_points
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.objective import Prediction

FLOAT64 = torch.float64


def ring_neighbours(cameras: int) -> tuple[Tensor, Tensor]:
    """Return (targets, sources): every camera of a ring and its two neighbours; an open, uneven chain for 3 cameras."""
    if cameras == 3:
        return torch.tensor([0, 0, 1, 2]), torch.tensor([1, 2, 0, 0])
    pairs = [(camera, (camera + side) % cameras) for camera in range(cameras) for side in (-1, 1)]
    return torch.tensor([pair[0] for pair in pairs]), torch.tensor([pair[1] for pair in pairs])


def ring_poses(samples: int, cameras: int) -> Tensor:
    """Return base_T_camera [B, N, 4, 4] of cameras that look outwards from a circle of 0.5 m, a little disturbed."""
    yaw = -2 * math.pi * torch.arange(cameras, dtype=FLOAT64) / cameras
    forward = torch.stack([yaw.cos(), yaw.sin(), torch.zeros_like(yaw)], dim=-1)
    right = torch.stack([yaw.sin(), -yaw.cos(), torch.zeros_like(yaw)], dim=-1)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=FLOAT64).expand_as(forward)
    poses = rigid(torch.stack([right, down, forward], dim=-1), 0.5 * forward)
    disturbance = axis_angle_to_rotation(0.02 * torch.randn(samples, cameras, 3, dtype=FLOAT64))
    return poses @ rigid(disturbance, 0.05 * torch.randn(samples, cameras, 3, dtype=FLOAT64))


def random_batch(samples: int, cameras: int, height: int, width: int) -> RigBatch:
    """Return a batch of random smooth images with soft masks, float64."""
    coarse = torch.rand(samples * 3 * cameras, 3, 5, 7, dtype=FLOAT64)
    frames = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear", align_corners=True)
    fov = math.radians(360 / cameras + 40)
    focal = width / 2 / math.tan(min(fov, math.radians(140)) / 2)
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=FLOAT64)
    targets, sources = ring_neighbours(cameras)
    return RigBatch(
        frames=frames.view(samples, 3, cameras, 3, height, width),
        masks=(torch.rand(samples, cameras, 1, height, width, dtype=FLOAT64) * 4).clamp(0, 1),
        intrinsics=intrinsics.expand(samples, cameras, 3, 3).clone(),
        base_T_camera=ring_poses(samples, cameras),
        targets=targets,
        sources=sources,
        camera_names=[f"camera{index}" for index in range(cameras)],
    )


def random_prediction(batch: RigBatch) -> Prediction:
    """Return depths of 2 to 12 m and small motions for `batch`."""
    samples, _, cameras, _, height, width = batch.frames.shape
    disparity = torch.rand(samples, cameras, 1, height, width, dtype=FLOAT64)
    vectors = 0.02 * torch.randn(samples, 2, cameras, 3, dtype=FLOAT64)
    motions = rigid(axis_angle_to_rotation(vectors), 10 * vectors)
    return Prediction(disparity.requires_grad_(), 2 + 10 * disparity, motions)


@dataclass(frozen=True)
class PlaneScene:
    """A textured plane, normal . X = offset in the base frame, seen by the cameras of `batch`."""

    batch: RigBatch
    depth: Tensor
    """[1, N, 1, H, W] metres, the truth."""
    motions: Tensor
    """[1, 2, N, 4, 4] the true motions to the frames -1 and +1."""


def slanted_plane(
    height: int = 48,
    width: int = 64,
    baseline: float = 0.8,
    turn: float = 0.06,
    tilt: tuple[float, float] = (0.25, 0.15),
    travel: float = 0.3,
) -> PlaneScene:
    """Render two cameras side by side, turned a little towards each other, that look at a slanted plane.

    The base frame is that of a camera between them: z forward, x right. The rig travels sideways and ahead.
    """
    base_T_camera = _side_by_side(baseline, turn)
    step = torch.tensor([[-travel, 0.02, -travel / 2], [travel, 0.02, travel / 2]], dtype=FLOAT64)
    world_T_base = rigid(
        torch.eye(3, dtype=FLOAT64).expand(3, 3, 3), torch.cat([torch.zeros(1, 3, dtype=FLOAT64), step])
    )
    return seen_plane(world_T_base[:, None] @ base_T_camera, base_T_camera, height, width, tilt)


def passed_plane(delays: tuple[float, float], velocity: float, yaw_rate: float = 0.0) -> PlaneScene:
    """Render the two cameras of `slanted_plane`, which fire after one another, from a rig in constant motion.

    Its velocity is sideways, metres per frame; it turns about the vertical, radians per frame. The cameras fire
    `delays` after the frame's moment, in frames, which are seconds here.
    """
    base_T_camera = _side_by_side(baseline=0.8, turn=0.06)
    twist = torch.zeros(4, 4, dtype=FLOAT64)
    twist[0, 2], twist[2, 0], twist[0, 3] = yaw_rate, -yaw_rate, velocity
    times = torch.tensor([0.0, -1.0, 1.0], dtype=FLOAT64)[:, None] + torch.tensor(delays, dtype=FLOAT64)
    world_T_base = torch.linalg.matrix_exp(times[..., None, None] * twist)
    scene = seen_plane(world_T_base @ base_T_camera, base_T_camera, height=48, width=64, tilt=(0.25, 0.15))
    batch = replace(
        scene.batch,
        exposure_delays=torch.tensor([delays], dtype=FLOAT64),
        context_times=torch.tensor([[-1.0, 1.0]], dtype=FLOAT64),
    )
    return replace(scene, batch=batch)


def _side_by_side(baseline: float, turn: float) -> Tensor:
    """Return base_T_camera [1, 2, 4, 4]."""
    inward = torch.tensor([[0.0, turn, 0.0], [0.0, -turn, 0.0]], dtype=FLOAT64)
    sideways = torch.tensor([[-baseline / 2, 0.0, 0.0], [baseline / 2, 0.0, 0.0]], dtype=FLOAT64)
    return rigid(axis_angle_to_rotation(inward), sideways).unsqueeze(0)


def seen_plane(
    world_T_camera: Tensor, base_T_camera: Tensor, height: int, width: int, tilt: tuple[float, float]
) -> PlaneScene:
    """Render the plane from the poses [3, 2, 4, 4] at the frames 0, -1 and +1."""
    focal = 0.9 * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=FLOAT64)
    intrinsics = K.expand(1, 2, 3, 3).clone()
    images, depths = zip(
        *(render_plane(pose, intrinsics[0], height, width, tilt) for pose in world_T_camera), strict=True
    )
    batch = RigBatch(
        frames=torch.stack(images).unsqueeze(0),
        masks=torch.ones(1, 2, 1, height, width, dtype=FLOAT64),
        intrinsics=intrinsics,
        base_T_camera=base_T_camera,
        targets=torch.tensor([0, 1]),
        sources=torch.tensor([1, 0]),
        camera_names=["left", "right"],
    )
    motions = rigid_inverse(world_T_camera[1:]) @ world_T_camera[:1]
    return PlaneScene(batch, depths[0].unsqueeze(0), motions.unsqueeze(0))


def render_plane(
    world_T_camera: Tensor, intrinsics: Tensor, height: int, width: int, tilt: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """Return images [N, 3, H, W] and depths [N, 1, H, W] of the plane, by intersecting every pixel's ray with it."""
    normal = torch.tensor([*tilt, 1.0], dtype=FLOAT64)
    rays = world_T_camera[:, :3, :3] @ unit_depth_points(torch.linalg.inv(intrinsics), height, width)
    origin = world_T_camera[:, :3, 3:]
    depth = (8.0 - normal @ origin).unsqueeze(1) / (normal @ rays).unsqueeze(1)
    points = origin + rays * depth
    return plane_texture(points).view(-1, 3, height, width), depth.view(-1, 1, height, width)


def plane_texture(points: Tensor) -> Tensor:
    """Return colours [N, 3, M] in [0, 1] of points on the plane: waves of some decimetres to metres."""
    x, y = points[:, 0], points[:, 1]
    waves = [
        (1.1 * x + 0.3 * y).sin() + 0.5 * (3.1 * x - 1.7 * y).sin() + 0.3 * (5.0 * x + 4.0 * y).cos(),
        (0.8 * x - 0.9 * y).cos() + 0.5 * (2.6 * x + 2.1 * y).sin() + 0.3 * (4.6 * y - 3.9 * x).sin(),
        (1.4 * x + 1.2 * y).sin() + 0.5 * (3.5 * x).cos() + 0.3 * (5.4 * x - 2.4 * y).sin(),
    ]
    return 0.5 + 0.25 * torch.stack(waves, dim=1)
