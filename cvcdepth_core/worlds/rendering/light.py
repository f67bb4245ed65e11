# SPDX-License-Identifier: Apache-2.0
"""The sky, the sun, the haze and the lamps of a world, in linear light."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cvcdepth_core.worlds.shapes.meshes import Floats
from cvcdepth_core.worlds.surfaces.noise import Noise, noise

_DISC = 0.9998  # cosine of the angle at which the sun's disc ends


@dataclass(frozen=True, eq=False)
class Lamps:
    """Lamps that light a world at night and in tunnels."""

    positions: Floats
    """[K, 3] metres."""
    colours: Floats
    """[K, 3] light at a distance of one metre."""
    directions: Floats
    """[K, 3] unit vectors of their axes."""
    spread: Floats
    """[K] exponent of the cosine to the axis; 0 shines evenly all around."""

    @classmethod
    def none(cls) -> Lamps:
        """No lamp."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))

    def joined(self, other: Lamps) -> Lamps:
        """Return these and the other ones."""
        pairs = ((getattr(self, f), getattr(other, f)) for f in ("positions", "colours", "directions", "spread"))
        return Lamps(*(np.concatenate(pair) for pair in pairs))

    def nearest(self, place: Floats, count: int, reach: float) -> Lamps:
        """Return those within `reach` of a place [3], at most `count`."""
        distance = np.linalg.norm(self.positions - place, axis=1)
        order = np.argsort(distance, kind="stable")[:count]
        order = order[distance[order] < reach]
        return Lamps(self.positions[order], self.colours[order], self.directions[order], self.spread[order])


@dataclass(frozen=True, eq=False)
class Light:
    """Everything that shines from far away, and what the air does to it."""

    sun: Floats
    """[3] unit vector towards the sun."""
    sunlight: Floats
    """[3] light on a surface that faces the sun; zeros behind clouds and at night."""
    zenith: Floats
    """[3] light of the sky above."""
    horizon: Floats
    """[3] light of the sky at the horizon."""
    ground: Floats
    """[3] light that comes back from the ground."""
    glow: float
    """How much brighter the sky is around the sun."""
    cloud: Floats
    """[3] light of clouds."""
    cover: float
    """Share of the sky under clouds, 0 to 1."""
    cloud_scale: float
    """Texels per unit of the plane that the clouds lie on."""
    cloud_offset: tuple[float, float]
    visibility: float
    """Metres after which 1 / e of a thing's light is left."""
    lamps: Lamps
    dark: bool = False
    """Whether vehicles have their lights on."""

    def sky(self, directions: Floats) -> Floats:
        """Light [3, N] from unit directions [3, N]."""
        height = np.clip(directions[2], 0.0, 1.0)
        share = height ** np.float32(0.55)
        colour = _column(self.horizon) * (1.0 - share) + _column(self.zenith) * share
        toward = np.clip(_dot(directions, self.sun), 0.0, 1.0)
        colour += _column(self.sunlight) * (self.glow * (0.09 * toward**8 + 0.22 * toward**64))
        density = self._clouds(directions, height)
        lit = _column(self.cloud) * (0.85 + 0.35 * toward**6) * (1.08 - 0.3 * density)
        colour = colour * (1.0 - density) + lit * density
        found: Floats = colour + _column(self.sunlight) * (40.0 * (toward > _DISC) * (1.0 - density))
        return found

    def ambient(self, normals: Floats) -> Floats:
        """Light [3, N] of sky and ground on open surfaces with the unit normals [3, N]."""
        upward = (0.5 + 0.5 * normals[2]).astype(np.float32)
        above = 0.55 * self.zenith + 0.45 * self.horizon
        side = _column(self.horizon - above) * (1.0 - np.abs(normals[2])) * 0.5
        found: Floats = _column(above) * upward + side * upward + _column(self.ground) * (1.0 - upward)
        return found

    def through_air(self, light: Floats, directions: Floats, distances: Floats) -> Floats:
        """Light [3, N] of things at these distances [N] as it arrives."""
        left = np.exp(-distances / np.float32(self.visibility)).astype(np.float32)
        toward = np.clip(_dot(directions, self.sun), 0.0, 1.0) ** 6
        air = _column(self.horizon) * 0.92 + _column(self.sunlight) * (0.05 * self.glow * toward)
        found: Floats = light * left + air * (1.0 - left)
        return found

    def _clouds(self, directions: Floats, height: Floats) -> Floats:
        if self.cover <= 0.0:
            return np.zeros_like(height)
        plane = self.cloud_scale / (height + np.float32(0.09))
        u, v = directions[0] * plane + self.cloud_offset[0], directions[1] * plane + self.cloud_offset[1]
        wide = plane * 0.02
        value = noise(Noise.CLOUDY, u, v, wide) + 0.3 * noise(Noise.ROUGH, 5.0 * u, 5.0 * v, 5.0 * wide)
        edge = 2.2 - 4.4 * self.cover
        return np.clip((value - edge) * 0.8, 0.0, 1.0) * np.clip(height * 9.0, 0.0, 1.0)


def sun_direction(azimuth: float, elevation: float) -> Floats:
    """Return unit vector towards the sun; degrees, azimuth counter-clockwise from x."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def sunlight(elevation: float) -> Floats:
    """Colour [3] of the direct light of a sun so many degrees high: the longer its way through the air, the redder."""
    sine = max(math.sin(math.radians(elevation)), 0.0)
    mass = 1.0 / (sine + 0.06)
    return 3.6 * np.exp(-np.array([0.055, 0.105, 0.2]) * mass)


def _column(colour: Floats) -> Floats:
    return colour.astype(np.float32)[:, None]


def _dot(vectors: Floats, axis: Floats) -> Floats:
    x, y, z = axis.astype(np.float32)
    found: Floats = vectors[0] * x + vectors[1] * y + vectors[2] * z
    return found
