# SPDX-License-Identifier: Apache-2.0
"""Pictures of a world in linear light, with exact depth, objects, motion and normals for every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.worlds.lenses import Lens
from cvcdepth_core.worlds.meshes import Floats, Mesh
from cvcdepth_core.worlds.openness import openness
from cvcdepth_core.worlds.scene import Rays, Scene
from cvcdepth_core.worlds.shading import shade
from cvcdepth_core.worlds.world import SKY, World

_NEAR = 0.02  # metres: nothing is seen closer to the lens


@dataclass(frozen=True, eq=False)
class Truth:
    """What each pixel of a raw image sees, by the ray through its centre."""

    depth: NDArray[np.float64]
    """[H, W] metres along the optical axis; inf where there is nothing but sky."""
    objects: NDArray[np.int32]
    """[H, W] numbers of objects, see `World.names`; 0 is the sky, 1 the vehicle that carries the camera."""
    moving: NDArray[np.bool_]
    """[H, W] whether the object moves over the ground at that moment."""
    normals: NDArray[np.float32]
    """[H, W, 3] unit normals of the surfaces, towards the camera, in the world's frame; zeros for the sky."""


@dataclass(frozen=True, eq=False)
class View:
    """One picture."""

    light: NDArray[np.float32]
    """[H, W, 3] linear red, green and blue, unbounded."""
    truth: Truth


class Renderer:
    """Draws one world as seen by the cameras of one vehicle."""

    def __init__(self, world: World, vehicle: Mesh | None = None, samples: int = 2) -> None:
        """`vehicle` is its body in its base frame; each pixel's colour is the mean of `samples` x `samples` rays."""
        self.scene = Scene(world, vehicle)
        self._samples = samples

    def view(self, lens: Lens, base_T_camera: Pose, world_T_base: Pose, time: float, speed: float = 0.0) -> View:
        """Take a picture at a time (seconds); `speed` of the vehicle tells whether its own body moves."""
        self.scene.set_moment(time, world_T_base, speed)
        world_T_camera = world_T_base @ base_T_camera
        truth, open_share = self._truth(lens, world_T_camera)
        return View(self._light(lens, world_T_camera, open_share), truth)

    def truth(self, lens: Lens, base_T_camera: Pose, world_T_base: Pose, time: float, speed: float = 0.0) -> Truth:
        """The truth of `view` alone."""
        self.scene.set_moment(time, world_T_base, speed)
        return self._truth(lens, world_T_base @ base_T_camera)[0]

    def _truth(self, lens: Lens, world_T_camera: Pose) -> tuple[Truth, Floats]:
        """Return also how open each pixel's place is to the sky, [H, W]."""
        camera_rays = lens.centre_rays.reshape(3, -1)
        rays = _rays(camera_rays, world_T_camera)
        hits = self.scene.nearest(rays)
        distances = self.scene.exact_distances(rays, hits)
        faces, hit = np.maximum(hits.faces, 0), hits.faces >= 0
        normals = self.scene.faces.plane.take(faces, axis=0)[:, :3]
        away = np.einsum("ni,ni->n", normals, rays.directions) > 0
        normals = np.where(away[:, None], -normals, normals) * hit[:, None]
        shape = (lens.height, lens.width)
        truth = Truth(
            ((distances + _NEAR) * camera_rays[2]).reshape(shape),
            np.where(hit, self.scene.faces.objects[faces], SKY).reshape(shape).astype(np.int32),
            (hit & self.scene.faces.moving[faces]).reshape(shape),
            normals.reshape(*shape, 3).astype(np.float32),
        )
        return truth, openness(self.scene, rays, distances, truth)

    def _light(self, lens: Lens, world_T_camera: Pose, open_share: Floats) -> NDArray[np.float32]:
        n = self._samples
        rays = _rays(lens.rays(n).reshape(3, -1), world_T_camera)
        spread = np.repeat(np.repeat(lens.pixel_angles / n, n, axis=0), n, axis=1).reshape(-1).astype(np.float32)
        opened = np.repeat(np.repeat(open_share, n, axis=0), n, axis=1).reshape(-1)
        light = shade(self.scene, rays, spread, opened, lens.width * n)
        averaged = light.reshape(3, lens.height, n, lens.width, n).mean(axis=(2, 4))
        return np.ascontiguousarray(np.moveaxis(averaged, 0, -1), np.float32)


def _rays(camera_rays: Floats, world_T_camera: Pose) -> Rays:
    """Rays of the world [N, 3] from unit vectors [3, N] of the camera; they start a little before the lens."""
    x, y, z = camera_rays
    R = world_T_camera[:3, :3]
    directions = np.stack([R[i, 0] * x + R[i, 1] * y + R[i, 2] * z for i in range(3)], axis=1)
    return Rays(world_T_camera[:3, 3] + _NEAR * directions, directions)
