# SPDX-License-Identifier: Apache-2.0
"""A world at one moment, ready for rays: what stands still is prepared once, what moves at every moment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.worlds.meshes import Floats, Ints, Mesh, face_normals, joined
from cvcdepth_core.worlds.ray_engine import Hits, TriangleScene
from cvcdepth_core.worlds.world import OWN_VEHICLE, World

_MOVER_REACH = 220.0  # metres: movers farther away are left out
_STANDING = 0.02  # m/s


class Rays(NamedTuple):
    """N rays."""

    origins: Floats
    """[N, 3] float64 or float32 metres."""
    directions: Floats
    """[N, 3] unit vectors."""


class _Faces:
    """Properties of all faces by number; those of what moves are at the end and are written anew at every moment."""

    def __init__(self, mesh: Mesh, objects: Ints, moving_faces: int) -> None:
        count = len(mesh.faces) + moving_faces
        self.plane = np.zeros((count, 4))
        self.normals = np.zeros((count, 9), np.float32)
        self.uv = np.zeros((count, 6), np.float32)
        self.materials = np.zeros(count, np.int32)
        self.objects = np.zeros(count, np.int32)
        self.moving = np.zeros(count, bool)
        self.write(0, mesh, objects, np.zeros(len(mesh.faces), bool))

    def write(self, start: int, mesh: Mesh, objects: Ints, moving: Floats) -> Floats:
        """Fill in a mesh from face `start` on; return its corners [F, 3, 3] float32 as rays meet them."""
        stop = start + len(mesh.faces)
        vertices = mesh.vertices.astype(np.float32)
        exact = vertices.astype(np.float64)
        flat = face_normals(exact, mesh.faces)
        self.plane[start:stop, :3] = flat
        self.plane[start:stop, 3] = np.einsum("fi,fi->f", flat, exact[mesh.faces[:, 0]])
        # Corner normals as one and two differences, as barycentric weights are applied.
        corner = np.where(np.any(mesh.normals, axis=2, keepdims=True), mesh.normals, flat[:, None]).astype(np.float32)
        self.normals[start:stop] = _differences(corner)
        self.uv[start:stop] = _differences(mesh.uv)
        self.materials[start:stop], self.objects[start:stop] = mesh.materials, objects
        self.moving[start:stop] = moving
        return vertices[mesh.faces]


def _differences(corners: Floats) -> Floats:
    """First corner, and what the second and third differ from it: [F, 3, C] to [F, 3 C]."""
    first = corners[:, 0]
    return np.concatenate([first, corners[:, 1] - first, corners[:, 2] - first], axis=1)


class Scene:
    """A world at one moment."""

    def __init__(self, world: World, vehicle: Mesh | None = None) -> None:
        """`vehicle` is the body of the vehicle that carries the sensors, in its base frame."""
        self.world = world
        self._vehicle = vehicle
        moving_faces = sum(len(mover.mesh.faces) for mover in world.movers)
        moving_faces += len(vehicle.faces) if vehicle is not None else 0
        self.faces = _Faces(world.mesh, world.objects, moving_faces)
        self._first_moving = len(world.mesh.faces)
        self._still = TriangleScene(world.mesh.vertices.astype(np.float32)[world.mesh.faces])
        self._moving = TriangleScene(np.zeros((0, 3, 3), np.float32))
        self._moment: tuple[float, bytes] | None = None

    def set_moment(self, time: float, world_T_base: Pose, speed: float = 0.0) -> None:
        """Put everything that moves where it is at a time (seconds), the sensors' vehicle at `world_T_base`."""
        moment = (time, world_T_base.tobytes())
        if moment == self._moment:
            return
        self._moment = moment
        meshes, objects, moving = self._moved(time, world_T_base, speed)
        mesh = joined(meshes)
        numbers = np.repeat(objects, [len(m.faces) for m in meshes]).astype(np.int32)
        flags = np.repeat(moving, [len(m.faces) for m in meshes]).astype(bool)
        corners = self.faces.write(self._first_moving, mesh, numbers, flags)
        self._moving = TriangleScene(corners)

    def nearest(self, rays: Rays) -> Hits:
        """Return what the rays meet first; faces are numbered as in `faces`."""
        origins, directions = _single(rays.origins), _single(rays.directions)
        still = self._still.nearest(origins, directions)
        moving = self._moving.nearest(origins, directions, still.distances)
        nearer = (moving.faces >= 0) & (moving.distances < still.distances)
        if not nearer.any():
            return still
        pairs = zip(moving._replace(faces=moving.faces + self._first_moving), still, strict=True)
        return Hits(*(np.where(nearer, a, b) for a, b in pairs))

    def exact_distances(self, rays: Rays, hits: Hits) -> Floats:
        """Distances [N] float64 to the planes of the faces that were hit; inf where none was."""
        plane = self.faces.plane.take(np.maximum(hits.faces, 0), axis=0)
        origins, directions = rays.origins.astype(np.float64), rays.directions.astype(np.float64)
        slope = np.einsum("ni,ni->n", plane[:, :3], directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            distances = (plane[:, 3] - np.einsum("ni,ni->n", plane[:, :3], origins)) / slope
        # Seen edge-on a plane is met anywhere; what Embree found is as good as float32 gets.
        sound = np.abs(distances - hits.distances) < 1e-3 * (1.0 + hits.distances)
        return np.where(hits.faces < 0, np.inf, np.where(sound, distances, hits.distances))

    def blocked(self, origins: Floats, directions: Floats, limits: Floats | float) -> Floats:
        """Whether anything lies on each ray within `limits`, bool [N]."""
        origins, directions = _single(origins), _single(directions)
        reach = np.broadcast_to(np.asarray(limits, np.float32), len(origins)).copy()
        blocked = self._still.blocked(origins, directions, reach)
        open_ones = np.flatnonzero(~blocked)
        blocked[open_ones] = self._moving.blocked(origins[open_ones], directions[open_ones], reach[open_ones])
        return blocked

    def _moved(self, time: float, world_T_base: Pose, speed: float) -> tuple[list[Mesh], list[int], list[bool]]:
        meshes, objects, moving = [], [], []
        for mover in self.world.movers:
            pose = mover.way.pose(time)
            if np.linalg.norm(pose[:3, 3] - world_T_base[:3, 3]) < _MOVER_REACH:
                meshes.append(mover.mesh.transformed(pose[:3, :3], pose[:3, 3].tolist()))
                objects.append(mover.number)
                moving.append(abs(mover.way.speed(time)) > _STANDING)
        if self._vehicle is not None:
            meshes.append(self._vehicle.transformed(world_T_base[:3, :3], world_T_base[:3, 3].tolist()))
            objects.append(OWN_VEHICLE)
            moving.append(abs(speed) > _STANDING)
        return meshes, objects, moving


def _single(values: Floats) -> Floats:
    return np.ascontiguousarray(values, np.float32)
