# SPDX-License-Identifier: Apache-2.0
"""A world while it is being built."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cvcdepth_core.worlds.description import Placed, Point, WorldSpec
from cvcdepth_core.worlds.shapes.meshes import Floats, Ints, Mesh, joined
from cvcdepth_core.worlds.surfaces.materials import Material, MaterialTable
from cvcdepth_core.worlds.terrain import Corridor, Terrain


class Place(NamedTuple):
    """Where something stands."""

    x: float
    y: float
    z: float
    yaw: float
    """Radians in the world."""


class Site:
    """Collects meshes, materials and objects."""

    def __init__(self, spec: WorldSpec) -> None:
        self.spec = spec
        self.corridors = [Corridor.of_road(road) for road in spec.roads]
        self.terrain = Terrain(spec.ground, self.corridors)
        self.table = MaterialTable()
        self.names = ["sky", "own vehicle"]
        self._meshes: list[Mesh] = []
        self._numbers: list[int] = []

    def material(self, material: Material) -> int:
        """Return a material's number."""
        return self.table.add(material)

    def new_object(self, name: str) -> int:
        """Announce an object and return its number."""
        self.names.append(name)
        return len(self.names) - 1

    def add(self, number: int, mesh: Mesh) -> None:
        """Put a mesh, in the world's frame, into the world as (part of) an object."""
        self._meshes.append(mesh)
        self._numbers.append(number)

    def stand(self, name: str, mesh: Mesh, placed: Placed, sink: float = 0.0) -> None:
        """Stand a mesh on the ground where a part of the description says, `sink` metres deep."""
        place = self.place(placed)
        self.add(self.new_object(name), mesh.turned(place.yaw).moved(place.x, place.y, place.z - sink))

    def park(self, name: str, mesh: Mesh, placed: Placed) -> None:
        """Stand a vehicle on the ground as its wheels would."""
        place = self.place(placed)
        forward = np.array([math.cos(place.yaw), math.sin(place.yaw)])
        left = np.array([-forward[1], forward[0]])
        half = np.ptp(mesh.vertices[:, 0]) * 0.3, np.ptp(mesh.vertices[:, 1]) * 0.4
        wheels = np.array([place[:2] + a * half[0] * forward + b * half[1] * left for a in (1, -1) for b in (1, -1)])
        fl, fr, rl, rr = (self.terrain.height(wheels) + self.raised(wheels)).tolist()
        ahead = np.array([*forward, (fl + fr - rl - rr) / (4 * half[0])])
        aside = np.array([*left, (fl + rl - fr - rr) / (4 * half[1])])
        ahead /= np.linalg.norm(ahead)
        aside -= ahead * (ahead @ aside)
        aside /= np.linalg.norm(aside)
        rotation = np.stack([ahead, aside, np.cross(ahead, aside)], axis=1)
        self.add(self.new_object(name), mesh.transformed(rotation, (place.x, place.y, (fl + fr + rl + rr) / 4)))

    def place(self, placed: Placed) -> Place:
        """Where a part stands."""
        (x, y), yaw = self.xy(placed.at, placed.road), math.radians(placed.yaw)
        if placed.road is not None:
            yaw += float(self.corridors[placed.road].path.heading(placed.at[0]))
        return Place(x, y, self.height_on(x, y), yaw)

    def xy(self, at: Point, road: int | None) -> tuple[float, float]:
        """World's x, y of a place that may be told along a road."""
        if road is None:
            return at
        x, y = self.corridors[road].path.points(*at).tolist()
        return x, y

    def height_on(self, x: float, y: float) -> float:
        """Return z of what one stands on: a pavement's upper side, a road, the ground."""
        found: float = self.terrain.at(x, y) + self.raised(np.array([[x, y]])).item()
        return found

    def raised(self, points: Floats) -> Floats:
        """By how much pavements lift what stands on them, [N]."""
        lift = np.zeros(len(points))
        on_road = np.zeros(len(points), bool)
        for corridor in self.corridors:
            depth = corridor.depth(points)
            _, left = corridor.path.locate(points)
            right_edge, left_edge = corridor.carriageway
            driven = (depth > 0) & (left > right_edge) & (left < left_edge)
            lift = np.where((depth > 0) & ~driven, np.maximum(lift, corridor.road.kerb), lift)
            on_road |= driven
        return np.where(on_road, 0.0, lift)

    def mesh(self) -> tuple[Mesh, Ints]:
        """Everything that was added, and the object of each face."""
        numbers = np.repeat(self._numbers, [len(mesh.faces) for mesh in self._meshes]).astype(np.int32)
        return joined(self._meshes), numbers
