# SPDX-License-Identifier: Apache-2.0
"""Pictures of a world in linear light, with exact depth, objects, motion and normals for every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.worlds.rendering.lenses import Lens
from cvcdepth_core.worlds.rendering.openness import openness
from cvcdepth_core.worlds.rendering.scene import Rays, Scene
from cvcdepth_core.worlds.rendering.shading import shade
from cvcdepth_core.worlds.shapes.meshes import Floats, Mesh
from cvcdepth_core.worlds.world import SKY, Way, World

_NEAR = 0.02  # metres: nothing is seen closer to the lens
_LEAST_AHEAD = 1e-3  # of a ray's unit vector
_SAMPLES_AT_ONCE = 262_144  # rays that are shaded at once, which bounds the memory for large pictures
_BAND = 16  # rows of a rolling shutter that are drawn at once


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

    def __init__(self, world: World, way: Way, body: Mesh | None = None, samples: int = 2) -> None:
        """`way` is that of the vehicle's base frame, `body` its body in that frame.

        Each pixel's colour is the mean of `samples` x `samples` rays.
        """
        self.scene = Scene(world, body)
        self._way = way
        self._samples = samples

    def view(self, lens: Lens, base_T_camera: Pose, time: float, readout: float = 0.0) -> View:
        """Take a picture at a time, seconds.

        With a `readout` (seconds from the first row to the last) each row sees the world at its own time, the middle
        one at `time`; what moves by itself is then moved on every few rows.
        """
        parts = []
        for band in _bands(lens.height, time, readout):
            truth, opened = self._truth(lens, base_T_camera, band)
            parts.append(View(self._light(lens, base_T_camera, band, opened), truth))
        return View(np.concatenate([part.light for part in parts]), _stacked([part.truth for part in parts]))

    def truth(self, lens: Lens, base_T_camera: Pose, time: float, readout: float = 0.0) -> Truth:
        """Return the truth of `view` alone."""
        bands = _bands(lens.height, time, readout)
        return _stacked([self._truth(lens, base_T_camera, band)[0] for band in bands])

    def _truth(self, lens: Lens, base_T_camera: Pose, band: _Band) -> tuple[Truth, Floats]:
        """Return also how open each pixel's place is to the sky, [H, W]."""
        self.scene.set_moment(band.middle, self._way.pose(band.middle), self._way.speed(band.middle))
        camera_rays = lens.centre_rays[:, band.rows]
        rays = _rays(camera_rays, self._way.poses(band.times) @ base_T_camera)
        hits = self.scene.nearest(rays)
        distances = self.scene.exact_distances(rays, hits)
        faces, hit = np.maximum(hits.faces, 0), hits.faces >= 0
        normals = self.scene.faces.plane.take(faces, axis=0)[:, :3]
        away = np.einsum("ni,ni->n", normals, rays.directions) > 0
        normals = np.where(away[:, None], -normals, normals) * hit[:, None]
        shape = camera_rays.shape[1:]
        truth = Truth(
            # Depth is along the axis; a fisheye sees beyond 90 degrees from it.
            np.where(camera_rays[2] > _LEAST_AHEAD, (distances + _NEAR).reshape(shape) * camera_rays[2], np.nan),
            np.where(hit, self.scene.faces.objects[faces], SKY).reshape(shape).astype(np.int32),
            (hit & self.scene.faces.moving[faces]).reshape(shape),
            normals.reshape(*shape, 3).astype(np.float32),
        )
        return truth, openness(self.scene, rays, distances, truth)

    def _light(self, lens: Lens, base_T_camera: Pose, band: _Band, opened: Floats) -> NDArray[np.float32]:
        """Return linear light [H, W, 3], shaded some rows at a time."""
        n = self._samples
        poses = (self._way.poses(band.times) @ base_T_camera).astype(np.float32)
        height = len(opened)
        step = max(1, _SAMPLES_AT_ONCE // (lens.width * n * n))
        blocks = []
        for start in range(0, height, step):
            rows = slice(start, min(start + step, height))
            own = np.repeat(poses[rows] if len(poses) > 1 else poses, n if len(poses) > 1 else 1, axis=0)
            first = band.rows.start
            rays = _rays(lens.rays(n)[:, (first + rows.start) * n : (first + rows.stop) * n], own)
            spread = _finer(lens.pixel_angles[first + rows.start : first + rows.stop] / n, n).astype(np.float32)
            light = shade(self.scene, rays, spread, _finer(opened[rows], n), lens.width * n)
            blocks.append(_averaged(light.reshape(3, rows.stop - rows.start, n, lens.width, n)))
        return np.concatenate(blocks)


def _averaged(samples: Floats) -> Floats:
    """Return the mean over each pixel's samples [3, H, n, W, n], [H, W, 3] float32."""
    n = samples.shape[2]
    mean = samples[:, :, 0, :, 0] / np.float32(n * n)
    for dy, dx in [(i // n, i % n) for i in range(1, n * n)]:
        mean += samples[:, :, dy, :, dx] / np.float32(n * n)
    return np.ascontiguousarray(np.moveaxis(mean, 0, -1), np.float32)


class _Band(NamedTuple):
    """Rows that are drawn at once."""

    rows: slice
    times: Floats
    """Of each row, or one for all."""
    middle: float
    """When what moves by itself is where it is drawn."""


def _bands(height: int, time: float, readout: float) -> list[_Band]:
    if not readout:
        return [_Band(slice(0, height), np.array([time]), time)]
    times = time + ((np.arange(height) + 0.5) / height - 0.5) * readout
    starts = range(0, height, _BAND)
    bands = (slice(start, min(start + _BAND, height)) for start in starts)
    return [_Band(rows, times[rows], float(times[rows].mean())) for rows in bands]


def _stacked(parts: list[Truth]) -> Truth:
    names = ("depth", "objects", "moving", "normals")
    return Truth(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _finer(values: Floats, n: int) -> Floats:
    """Repeat each pixel's value [H, W] for its rays, flat."""
    return np.repeat(np.repeat(values, n, axis=0), n, axis=1).reshape(-1)


def _rays(camera_rays: Floats, world_T_camera: Floats) -> Rays:
    """Return rays of the world from unit vectors [3, H, W] of a camera; they start a little before the lens.

    `world_T_camera` is [H, 4, 4] or [1, 4, 4].
    """
    x, y, z = camera_rays
    R = world_T_camera[:, None, :3, :3]
    ways = [R[..., i, 0] * x + R[..., i, 1] * y + R[..., i, 2] * z for i in range(3)]
    directions = np.stack(ways, axis=-1)
    origins = world_T_camera[:, None, :3, 3] + directions.dtype.type(_NEAR) * directions
    return Rays(origins.reshape(-1, 3), directions.reshape(-1, 3))
