# SPDX-License-Identifier: Apache-2.0
"""Where each pixel's place is seen by the same or another camera at another time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.worlds.rendering.lenses import Lens
from cvcdepth_core.worlds.rendering.renderer import Truth
from cvcdepth_core.worlds.shapes.meshes import Floats
from cvcdepth_core.worlds.world import OWN_VEHICLE, Way, World

_NEAR = 0.02  # metres before the other camera


def flow(
    world: World, way: Way, truth: Truth, seen: tuple[Lens, Pose, float], other: tuple[Lens, Pose, float]
) -> NDArray[np.float32]:
    """Return the pixels [H, W, 2] at which `other` would see the places that `truth` has of `seen`.

    Both are a lens, base_T_camera and a time in seconds, of global shutters. What moves is followed. NaN for the sky
    and for what lies behind the other camera; whether something hides a place there is not told.
    """
    lens, mount, time = seen
    rays = np.moveaxis(lens.centre_rays, 0, -1)
    depth = np.where(np.isfinite(truth.depth), truth.depth, np.nan)
    points = _moved(rays * (depth / rays[..., 2])[..., None], way.pose(time) @ mount)
    points = _followed(points, truth.objects, world, way, time, other[2])
    there = _moved(points, inverse(way.pose(other[2]) @ other[1])).reshape(-1, 3)
    found = np.full((len(there), 2), np.nan, np.float32)
    ahead = np.flatnonzero(there[:, 2] > _NEAR)
    if len(ahead):
        found[ahead] = other[0].project(there[ahead])
    pixels: NDArray[np.float32] = found.reshape(*truth.depth.shape, 2)
    return pixels


def _followed(points: Floats, objects: Floats, world: World, way: Way, time: float, later: float) -> Floats:
    """Move the points of each mover, and of the vehicle itself, from where it is at a time to where it is later."""
    followed: Floats = points.copy()
    for number, own in [(OWN_VEHICLE, way), *((mover.number, mover.way) for mover in world.movers)]:
        on_it = objects == number
        if on_it.any():
            followed[on_it] = _moved(points[on_it], own.pose(later) @ inverse(own.pose(time)))
    return followed


def _moved(points: Floats, pose: Pose) -> Floats:
    moved: Floats = np.einsum("ij,...j->...i", pose[:3, :3], points) + pose[:3, 3]
    return moved
