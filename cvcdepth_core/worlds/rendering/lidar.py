# SPDX-License-Identifier: Apache-2.0
"""Sweeps of a spinning LiDAR while its vehicle and the world around it move."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.worlds.rendering.scene import Rays, Scene
from cvcdepth_core.worlds.sensors import Lidar
from cvcdepth_core.worlds.shapes.meshes import Floats
from cvcdepth_core.worlds.world import OWN_VEHICLE, Way

_SLICES = 12  # of a turn: within each, what moves stands still


class Sweep(NamedTuple):
    """One turn, without measurements that came back from nowhere."""

    points: Floats
    """[M, 3] metres in the LiDAR's frame, at the stamp if deskewed, else each at its own time."""
    intensities: Floats
    """[M] 0 to 1."""
    seconds: Floats
    """[M] later than the stamp (earlier if negative)."""
    rings: Floats
    """[M] number of the beam, from the lowest."""


def lidar_mount(lidar: Lidar) -> Pose:
    """Return the LiDAR's place: x forward, z up."""
    pose = np.eye(4)
    pose[:3, 3] = lidar.position
    return pose


def sweep(scene: Scene, lidar: Lidar, way: Way, stamp: float, period: float, seed: tuple[int, ...]) -> Sweep:
    """Turn once, from half a period before `stamp` (seconds) to half after, beginning behind and to the left.

    The stamp is that of the middle, when the LiDAR looks ahead.
    """
    parts = []
    for number in range(_SLICES):
        columns = np.arange(number * lidar.columns // _SLICES, (number + 1) * lidar.columns // _SLICES)
        parts.append(_slice(scene, lidar, way, stamp, period, columns))
    joined = Sweep(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
    return _measured(joined, lidar, seed)


def _slice(scene: Scene, lidar: Lidar, way: Way, stamp: float, period: float, columns: Floats) -> Sweep:
    seconds = ((columns + 0.5) / lidar.columns - 0.5) * period
    poses = np.einsum("cij,jk->cik", way.poses(stamp + seconds), lidar_mount(lidar))
    middle = stamp + float(seconds.mean())
    scene.set_moment(middle, way.pose(middle), way.speed(middle))
    own = _directions(lidar, columns)  # [C, B, 3]
    directions = np.einsum("cij,cbj->cbi", poses[:, :3, :3], own)
    origins = np.broadcast_to(poses[:, None, :3, 3], directions.shape)
    rays = Rays((origins + lidar.nearest * directions).reshape(-1, 3).astype(np.float64), directions.reshape(-1, 3))
    hits = scene.nearest(rays)
    distances = scene.exact_distances(rays, hits) + lidar.nearest
    faces = np.maximum(hits.faces, 0)
    kept = np.flatnonzero((distances < lidar.range) & (scene.faces.objects[faces] != OWN_VEHICLE))
    cosine = np.abs(np.einsum("ni,ni->n", scene.faces.plane[faces[kept], :3], rays.directions[kept]))
    albedo = scene.world.materials[scene.faces.materials[faces[kept]], 1:4].mean(axis=1)
    points = own.reshape(-1, 3)[kept] * distances[kept, None]
    times = np.repeat(seconds, lidar.beams)[kept]
    if lidar.deskewed:
        points = _deskewed(points, poses, kept // lidar.beams, inverse(way.pose(stamp) @ lidar_mount(lidar)))
    return Sweep(points, albedo * (0.25 + 0.75 * cosine), times, kept % lidar.beams)


def _directions(lidar: Lidar, columns: Floats) -> Floats:
    """Return unit vectors [C, B, 3] in the LiDAR's frame; it turns clockwise, seen from above."""
    azimuth = math.pi - 2 * math.pi * (columns + 0.5) / lidar.columns
    elevation = np.radians(np.linspace(*lidar.elevations, lidar.beams))
    level = np.cos(elevation)
    return np.stack(
        [
            np.cos(azimuth)[:, None] * level,
            np.sin(azimuth)[:, None] * level,
            np.broadcast_to(np.sin(elevation), (len(columns), lidar.beams)),
        ],
        axis=-1,
    )


def _deskewed(points: Floats, poses: Floats, columns: Floats, lidar_T_world: Pose) -> Floats:
    """Move points [M, 3], each seen from `poses[column]`, to the frame of `lidar_T_world`."""
    relative = np.einsum("ij,cjk->cik", lidar_T_world, poses)[columns]
    found: Floats = np.einsum("mij,mj->mi", relative[:, :3, :3], points) + relative[:, :3, 3]
    return found


def _measured(found: Sweep, lidar: Lidar, seed: tuple[int, ...]) -> Sweep:
    """Apply noise and losses."""
    if not lidar.noise and not lidar.lost:
        return found
    rng = np.random.default_rng(seed)
    distance = np.linalg.norm(found.points, axis=1, keepdims=True)
    noisy = found.points * (1.0 + lidar.noise * rng.standard_normal(distance.shape) / np.maximum(distance, 0.1))
    kept = rng.random(len(noisy)) >= lidar.lost
    return Sweep(noisy[kept], *(values[kept] for values in found[1:]))
