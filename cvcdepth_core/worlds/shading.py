# SPDX-License-Identifier: Apache-2.0
"""The light that rays bring back: textures, sun with shadows, sky, reflections, lamps and haze."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cvcdepth_core.worlds.light import Lamps
from cvcdepth_core.worlds.materials import Surface, evaluate
from cvcdepth_core.worlds.meshes import Floats, Ints
from cvcdepth_core.worlds.ray_engine import Hits
from cvcdepth_core.worlds.scene import Rays, Scene

_SHADOWS_TO = 350.0  # metres from the camera
_SHADOW_REACH = 120.0  # metres from what throws it
_SUN_RADIUS = 0.012  # radians: a little more than the sun's, for edges as soft as eyes expect
_LEAST_REFLECTION = 0.02
_LAMP_REACH, _MOST_LAMPS = 70.0, 24
_BRIGHTEST = 60.0


class _Places(NamedTuple):
    """Where N rays hit, and how surfaces lie there; arrays begin with the axis."""

    points: Floats
    """[3, N] float32"""
    directions: Floats
    """[3, N] of the rays."""
    normals: Floats
    """[3, N] smooth, towards where the ray came from."""
    flat: Floats
    """[3, N] of the face, likewise."""
    distances: Floats
    """[N]"""
    surface: Surface


def shade(scene: Scene, rays: Rays, spread: Floats, opened: Floats, row: int) -> Floats:
    """Light [3, N] of rays that are samples of a picture, `row` of them in each line.

    `spread` [N] is the angle between neighbouring rays (radians), `opened` [N] how open what they hit is to the sky.
    """
    light = scene.world.light
    hits = scene.nearest(rays)
    directions = np.ascontiguousarray(rays.directions.T, np.float32)
    hit = np.flatnonzero(hits.faces >= 0)
    result = np.empty_like(directions)
    missed = np.flatnonzero(hits.faces < 0)
    result[:, missed] = light.sky(directions[:, missed])
    if len(hit):
        places = _places(scene, rays, hits, hit, directions[:, hit], spread[hit])
        lamps = light.lamps.nearest(rays.origins[0], _MOST_LAMPS, _LAMP_REACH)
        lit = _lit(scene, places, opened[hit], _sun_offsets(row, len(directions[0]))[:, hit], lamps)
        lit = _with_reflections(scene, places, lit, spread[hit])
        result[:, hit] = light.through_air(lit, places.directions, places.distances)
    return np.clip(np.nan_to_num(result), 0.0, _BRIGHTEST)


def _places(scene: Scene, rays: Rays, hits: Hits, hit: Ints, directions: Floats, spread: Floats) -> _Places:
    faces, u, v, distances = (values[hit] for values in (hits.faces, hits.u, hits.v, hits.distances))
    points = np.ascontiguousarray(rays.origins[hit].T, np.float32) + directions * distances
    flat = _towards(np.ascontiguousarray(scene.faces.plane.take(faces, axis=0)[:, :3].T, np.float32), directions)
    corner = scene.faces.normals.take(faces, axis=0).T
    smooth = corner[0:3] + corner[3:6] * u + corner[6:9] * v
    smooth = _unit(smooth * np.where((smooth * flat).sum(axis=0) < 0, -1.0, 1.0).astype(np.float32))
    texture = scene.faces.uv.take(faces, axis=0).T
    place = texture[0:2] + texture[2:4] * u + texture[4:6] * v
    slope = np.maximum(np.abs((flat * directions).sum(axis=0)), 0.03)
    footprint = distances * spread / np.sqrt(slope)
    surface = evaluate(scene.world.materials, scene.faces.materials[faces], place[0], place[1], footprint)
    return _Places(points, directions, smooth, flat, distances, surface)


def _lit(scene: Scene, places: _Places, opened: Floats, sun_offsets: Floats, lamps: Lamps) -> Floats:
    """Light [3, N] that the surfaces scatter and send out themselves."""
    light, surface = scene.world.light, places.surface
    opened = opened + surface.leafy * 0.35 * (1.0 - opened)
    open_share = opened / (1.0 - 0.7 * surface.colour.mean(axis=0) * (1.0 - opened))
    received = light.ambient(places.normals) * open_share
    if light.sunlight.any():
        received += _sun(scene, places, sun_offsets)
    received += _lamplight(lamps, places) * (0.4 + 0.6 * open_share)
    return surface.colour * received + surface.emission


def _sun(scene: Scene, places: _Places, offsets: Floats) -> Floats:
    light = scene.world.light
    toward = light.sun.astype(np.float32)[:, None]
    slope = (places.normals * toward).sum(axis=0)
    leafy = places.surface.leafy
    # Leaves pass light on, and their crowns have no definite surface.
    received = np.maximum(slope, 0.0) * (1.0 - 0.5 * leafy) + leafy * (0.12 + 0.2 * np.abs(slope))
    faces_it = ((places.flat * toward).sum(axis=0) > 0) | (leafy > 0)
    looked = np.flatnonzero((received > 0.004) & faces_it & (places.distances < _SHADOWS_TO))
    lift = 2e-3 + 3e-4 * places.distances[looked]
    side = np.sign((places.flat[:, looked] * toward).sum(axis=0))
    origins = places.points[:, looked] + places.flat[:, looked] * (lift * side)
    directions = _unit(toward + offsets[:, looked])
    received *= faces_it
    received[looked] *= ~scene.blocked(origins.T, directions.T, _SHADOW_REACH)
    return light.sunlight.astype(np.float32)[:, None] * received


def _sun_offsets(row: int, count: int) -> Floats:
    """By how much each sample looks past the middle of the sun, [3, N]: neighbouring samples, different places."""
    index = np.arange(count)
    x, y = index % row, index // row
    corner = (x % 2) + 2 * (y % 2)
    angle = np.float32(np.pi / 2) * corner + np.float32(0.6)
    return np.stack([np.cos(angle), np.sin(angle), 0.0 * angle]).astype(np.float32) * np.float32(_SUN_RADIUS * 0.7)


def _lamplight(lamps: Lamps, places: _Places) -> Floats:
    total = np.zeros_like(places.points)
    for position, colour, axis, spread in zip(
        lamps.positions, lamps.colours, lamps.directions, lamps.spread, strict=True
    ):
        way = position.astype(np.float32)[:, None] - places.points
        squared = np.maximum((way * way).sum(axis=0), 0.05)
        way /= np.sqrt(squared)
        cosine = np.maximum(-(way * axis.astype(np.float32)[:, None]).sum(axis=0), 0.0)
        strength = np.maximum((places.normals * way).sum(axis=0), 0.0) / squared
        total += colour.astype(np.float32)[:, None] * (strength * cosine ** np.float32(spread))
    return total


def _with_reflections(scene: Scene, places: _Places, lit: Floats, spread: Floats) -> Floats:
    gloss = places.surface.gloss
    cosine = np.abs((places.normals * places.directions).sum(axis=0))
    share = gloss * (0.05 + 0.95 * np.clip(1.0 - cosine, 0.0, 1.0) ** 5)
    shiny = np.flatnonzero(share > _LEAST_REFLECTION)
    if len(shiny):
        mirrored = _mirrored(scene, places, shiny, spread)
        lit[:, shiny] = lit[:, shiny] * (1.0 - share[shiny]) + mirrored * share[shiny]
    return lit


def _mirrored(scene: Scene, places: _Places, shiny: Ints, spread: Floats) -> Floats:
    """Return what the shiny places reflect: what stands around in plain light, and the sky."""
    light = scene.world.light
    incoming, normals = places.directions[:, shiny], places.normals[:, shiny]
    ripple = places.surface.ripple[shiny]
    normals = _unit(normals + np.stack([ripple, -0.6 * ripple, 0.0 * ripple]))
    outgoing = incoming - 2.0 * (incoming * normals).sum(axis=0) * normals
    flat = places.flat[:, shiny]
    # A smooth normal may send the ray into the face that it comes from.
    into = np.minimum((outgoing * flat).sum(axis=0), 0.0)
    outgoing = _unit(outgoing - 1.05 * into * flat)
    origins = places.points[:, shiny] + flat * (3e-3 + 3e-4 * places.distances[shiny])
    rays = Rays(origins.T, outgoing.T)
    hits = scene.nearest(rays)
    seen = light.sky(outgoing)
    hit = np.flatnonzero(hits.faces >= 0)
    if len(hit):
        others = _places(scene, rays, hits, hit, outgoing[:, hit], 4.0 * spread[shiny[hit]])
        slope = np.maximum((others.normals * light.sun.astype(np.float32)[:, None]).sum(axis=0), 0.0)
        received = 0.6 * light.ambient(others.normals) + 0.6 * light.sunlight.astype(np.float32)[:, None] * slope
        seen[:, hit] = others.surface.colour * received + others.surface.emission
    return seen


def _towards(normals: Floats, directions: Floats) -> Floats:
    """Turn normals [3, N] so that they face the rays."""
    return normals * np.where((normals * directions).sum(axis=0) > 0, -1.0, 1.0).astype(np.float32)


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.sqrt((vectors * vectors).sum(axis=0)), np.float32(1e-9))
