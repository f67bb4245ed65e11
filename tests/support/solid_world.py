# SPDX-License-Identifier: Apache-2.0
"""A ray-cast world of textured rectangles, seen by any camera at any moment: pictures with exactly known depth.

Textures are sums of waves, each faded where a pixel covers too much of it, as a lens and a sensor would.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""base_T_camera of a camera at the base frame's origin that looks ahead."""
WAVES = 24


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    """A pose in the base frame's convention (x forward, y left, z up); angles in degrees."""
    a, b = math.radians(yaw), math.radians(pitch)
    turn = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    nod = np.array([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
    found = np.eye(4)
    found[:3, :3] = turn @ nod
    found[:3, 3] = x, y, z
    return found


def camera_matrix(height: int, width: int, focal: float) -> np.ndarray:
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


@dataclass(frozen=True)
class Rectangle:
    """A flat surface that looks along its frame's x axis, spanned by y and z."""

    world_T_surface: np.ndarray
    half_y: float = math.inf
    half_z: float = math.inf
    seed: int = 0
    wavelengths: tuple[float, float] = (0.5, 4.0)
    """Shortest and longest, metres."""
    contrast: float = 100.0
    """Grey levels; 0 is a surface without texture."""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres per second, in the world."""

    def at(self, time: float) -> np.ndarray:
        moved = self.world_T_surface.copy()
        moved[:3, 3] += np.array(self.velocity) * time
        return moved

    def grey(self, y: np.ndarray, z: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Grey levels [...] of points on the surface; `footprint` is the width in metres that a pixel covers."""
        random = np.random.default_rng(self.seed)
        lengths = np.exp(random.uniform(*np.log(self.wavelengths), WAVES))
        angles, phases = random.uniform(0, 2 * math.pi, (2, WAVES))
        total = np.zeros_like(y)
        for length, angle, phase in zip(lengths, angles, phases, strict=True):
            wave = np.sin(2 * math.pi / length * (math.cos(angle) * y + math.sin(angle) * z) + phase)
            total += wave * np.exp(-0.5 * (2 * math.pi / length * 0.6 * footprint) ** 2)
        return 127 + self.contrast * total * math.sqrt(2 / WAVES) / 3


def render(
    surfaces: Sequence[Rectangle], world_T_camera: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], time=0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Picture [h, w, 3] and depth [h, w] (NaN where nothing is) at a moment in seconds."""
    height, width = size
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(intrinsics).T @ world_T_camera[:3, :3].T
    depth, grey = np.full(size, np.inf), np.zeros(size)
    for surface in surfaces:
        placed = surface.at(time)
        local_rays = rays @ placed[:3, :3]
        origin = (world_T_camera[:3, 3] - placed[:3, 3]) @ placed[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origin[0] / local_rays[..., 0]
            y, z = (origin[i] + distance * local_rays[..., i] for i in (1, 2))
        hit = (distance > 0) & (distance < depth) & (np.abs(y) <= surface.half_y) & (np.abs(z) <= surface.half_z)
        slant = np.abs(local_rays[..., 0]) / np.linalg.norm(local_rays, axis=-1)
        footprint = distance / intrinsics[0, 0] / np.sqrt(np.maximum(slant, 1e-3))
        depth[hit] = distance[hit]
        grey[hit] = surface.grey(y[hit], z[hit], footprint[hit])
    picture = np.rint(np.clip(grey, 0, 255)).astype(np.uint8)
    return np.repeat(picture[..., None], 3, axis=-1), np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)


def street(seed: int = 1) -> list[Rectangle]:
    """A ground 1.5 m below the base frame's origin, house fronts to the sides, boxes, and ends far away."""
    ground = pose(z=-1.5)
    ground[:3, :3] = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # its x axis looks up
    sides = [Rectangle(pose(y=7.0, yaw=90), seed=seed + 1), Rectangle(pose(y=-6.0, yaw=90), seed=seed + 2)]
    ends = [Rectangle(pose(x=25.0), seed=seed + 3), Rectangle(pose(x=-18.0), seed=seed + 4)]
    boxes = [
        Rectangle(pose(x=x, y=y, z=-0.6, yaw=yaw), 1.0, 0.9, seed + 5 + i, (0.2, 1.5))
        for i, (x, y, yaw) in enumerate([(6.0, 2.0, 0), (8.0, -2.5, 20), (1.0, 4.0, 90), (-5.0, -2.0, 10), (3, -4, 70)])
    ]
    return [Rectangle(ground, seed=seed, wavelengths=(0.4, 4.0)), *sides, *ends, *boxes]
