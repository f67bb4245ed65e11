# SPDX-License-Identifier: Apache-2.0
"""A world at one moment, ready for rays: what stands still is prepared once, what moves at every moment."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.worlds.rendering.light import Lamps
from cvcdepth_core.worlds.rendering.ray_engine import Hits, TriangleScene
from cvcdepth_core.worlds.shapes.meshes import Floats, Ints, Mesh, cross, joined
from cvcdepth_core.worlds.world import OWN_VEHICLE, World

_MOVER_REACH = 220.0  # metres: movers farther away are left out
_STANDING = 0.02  # m/s
_BEAM, _BEAM_SPREAD = np.array([70.0, 66.0, 58.0]), 45.0  # light of a headlight at one metre, and how narrow it is
_OWN_FRONT = 2.2  # metres from the base to the headlights of the vehicle that carries the sensors


class Rays(NamedTuple):
    """N rays."""

    origins: Floats
    """[N, 3] float64 or float32 metres."""
    directions: Floats
    """[N, 3] unit vectors."""


class _Faces:
    """Properties of all faces by number; those of what moves are at the end, and where they are is written anew."""

    def __init__(self, mesh: Mesh, objects: Ints, still: int) -> None:
        count = len(mesh.faces)
        self.plane = np.zeros((count, 4))
        self.normals = np.zeros((9, count), np.float32)
        self.uv = np.ascontiguousarray(_differences(mesh.uv).T, np.float32)
        self.materials = mesh.materials.astype(np.int32)
        self.objects = objects.astype(np.int32)
        self.moving = np.zeros(count, bool)
        vertices = mesh.vertices.astype(np.float32)[mesh.faces[:still]]
        self.write(np.arange(still), vertices, mesh.normals[:still])

    def write(self, numbers: Ints, corners: Floats, normals: Floats) -> None:
        """Say where faces are: `corners` [F, 3, 3] float32 as rays meet them, `normals` as a `Mesh` has them."""
        exact = corners.astype(np.float64)
        flat = cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
        length = np.linalg.norm(flat, axis=1, keepdims=True)
        flat /= np.where(length > 0, length, 1.0)
        self.plane[numbers, :3] = flat
        self.plane[numbers, 3] = np.einsum("fi,fi->f", flat, exact[:, 0])
        # Corner normals as one and two differences, as barycentric weights are applied.
        given = (normals != 0).any(axis=(1, 2))[:, None, None]
        self.normals[:, numbers] = _differences(np.where(given, normals, flat[:, None]).astype(np.float32)).T


class _Movers:
    """All that moves, with each vertex's and face's mover; the vehicle that carries the sensors is the last."""

    def __init__(self, world: World, vehicle: Mesh | None) -> None:
        meshes = [mover.mesh for mover in world.movers] + ([vehicle] if vehicle is not None else [])
        self.ways = [mover.way for mover in world.movers]
        self.mesh = joined(meshes)
        self.objects = np.array(
            [*(mover.number for mover in world.movers), *([OWN_VEHICLE] if vehicle else [])], np.int32
        )
        count = np.arange(len(meshes))
        self.of_vertex = np.repeat(count, [len(mesh.vertices) for mesh in meshes])
        self.of_face = np.repeat(count, [len(mesh.faces) for mesh in meshes])
        self.face_objects = self.objects[self.of_face] if len(meshes) else np.zeros(0, np.int32)


def _differences(corners: Floats) -> Floats:
    """First corner, and what the second and third differ from it: [F, 3, C] to [F, 3 C]."""
    first = corners[:, 0]
    return np.concatenate([first, corners[:, 1] - first, corners[:, 2] - first], axis=1)


class Scene:
    """A world at one moment."""

    def __init__(self, world: World, vehicle: Mesh | None = None) -> None:
        """`vehicle` is the body of the vehicle that carries the sensors, in its base frame."""
        self.world = world
        self._movers = _Movers(world, vehicle)
        self._still_faces = len(world.mesh.faces)
        whole = joined([world.mesh, self._movers.mesh])
        self.faces = _Faces(whole, np.concatenate([world.objects, self._movers.face_objects]), self._still_faces)
        self._still = TriangleScene(world.mesh.vertices.astype(np.float32)[world.mesh.faces])
        self._moving = TriangleScene(np.zeros((0, 3, 3), np.float32))
        self._near: Ints = np.zeros(0, np.int32)
        self.headlights = Lamps.none()
        """Of the vehicles that move, and of the one that carries the sensors, at the moment."""
        self._moment: tuple[float, bytes] | None = None

    def set_moment(self, time: float, world_T_base: Pose, speed: float = 0.0) -> None:
        """Put everything that moves where it is at a time (seconds), the sensors' vehicle at `world_T_base`."""
        moment = (time, world_T_base.tobytes())
        if moment == self._moment:
            return
        self._moment = moment
        movers = self._movers
        if self.world.light.dark:
            self.headlights = self._headlights(time, world_T_base)
        if not len(movers.objects):
            return
        poses = np.stack([*(way.pose(time) for way in movers.ways), world_T_base])[: len(movers.objects)]
        speeds = np.array([*(way.speed(time) for way in movers.ways), speed])[: len(movers.objects)]
        near = np.linalg.norm(poses[:, :3, 3] - world_T_base[:3, 3], axis=1) < _MOVER_REACH
        chosen = np.flatnonzero(near[movers.of_face])
        of_vertex, of_face = movers.of_vertex, movers.of_face[chosen]
        vertices = np.einsum("vij,vj->vi", poses[of_vertex, :3, :3], movers.mesh.vertices) + poses[of_vertex, :3, 3]
        corners = vertices.astype(np.float32)[movers.mesh.faces[chosen]]
        normals = np.einsum("fij,fcj->fci", poses[of_face, :3, :3], movers.mesh.normals[chosen])
        self._near = chosen + self._still_faces
        self.faces.write(self._near, corners, normals)
        self.faces.moving[self._near] = np.abs(speeds[of_face]) > _STANDING
        self._moving = TriangleScene(corners)

    def _headlights(self, time: float, world_T_base: Pose) -> Lamps:
        shining = [mover for mover in self.world.movers if mover.headlights]
        poses = [mover.way.pose(time) for mover in shining]
        fronts = [float(mover.mesh.vertices[:, 0].max()) for mover in shining]
        lamps = [_pair(pose, front) for pose, front in zip(poses, fronts, strict=True)]
        return functools.reduce(Lamps.joined, lamps, _pair(world_T_base, _OWN_FRONT))

    def nearest(self, rays: Rays) -> Hits:
        """Return what the rays meet first; faces are numbered as in `faces`."""
        origins, directions = _single(rays.origins), _single(rays.directions)
        still = self._still.nearest(origins, directions)
        moving = self._moving.nearest(origins, directions, still.distances)
        nearer = (moving.faces >= 0) & (moving.distances < still.distances)
        if not nearer.any():
            return still
        numbered = moving._replace(faces=self._near[np.maximum(moving.faces, 0)])
        pairs = zip(numbered, still, strict=True)
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


def _pair(pose: Pose, front: float) -> Lamps:
    """Return the two headlights of a vehicle whose front is so many metres before its origin."""
    places = np.array([(front, 0.6, 0.65), (front, -0.6, 0.65)]) @ pose[:3, :3].T + pose[:3, 3]
    axis = np.tile(pose[:3, 0] - 0.03 * pose[:3, 2], (2, 1))
    return Lamps(places, np.tile(_BEAM, (2, 1)), axis, np.full(2, _BEAM_SPREAD))


def _single(values: Floats) -> Floats:
    return np.ascontiguousarray(values, np.float32)
