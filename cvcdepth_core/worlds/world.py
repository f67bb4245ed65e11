# SPDX-License-Identifier: Apache-2.0
"""A world that has been built: everything that rays can meet, and everything that shines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.worlds.rendering.light import Light
from cvcdepth_core.worlds.shapes.meshes import Floats, Ints, Mesh

SKY, OWN_VEHICLE = 0, 1
"""Numbers of objects that every world has; the others follow."""


class Way(Protocol):
    """Where something is over time."""

    def pose(self, time: float) -> Pose:
        """Return world_T_object [4, 4] at a time, seconds from the beginning."""

    def poses(self, times: Floats) -> Floats:
        """Return world_T_object [T, 4, 4] at times [T]."""

    def speed(self, time: float) -> float:
        """Metres per second, negative backwards."""


@dataclass(frozen=True, eq=False)
class Mover:
    """Something that moves as a rigid body."""

    number: int
    """Its object number."""
    mesh: Mesh
    """In its own frame: x forward, z up, on the ground."""
    way: Way
    headlights: bool = False
    """Whether it has some, for when it is dark."""


@dataclass(frozen=True, eq=False)
class World:
    """A world that has been built."""

    mesh: Mesh
    """All that stands still."""
    objects: Ints
    """[F] number of the object that each face of `mesh` belongs to."""
    names: tuple[str, ...]
    """What the objects are called, by number."""
    movers: tuple[Mover, ...]
    materials: Floats
    """The table for `materials.evaluate`."""
    light: Light
