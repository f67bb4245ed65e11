# SPDX-License-Identifier: Apache-2.0
"""The light that rays bring back: textures, sun with shadows, sky, reflections, lamps and haze."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cvcdepth_core.worlds.rendering.light import Lamps
from cvcdepth_core.worlds.rendering.ray_engine import Hits
from cvcdepth_core.worlds.rendering.scene import Rays, Scene
from cvcdepth_core.worlds.shapes.meshes import Floats, Ints
from cvcdepth_core.worlds.surfaces.materials import Surface, evaluate

_SHADOWS_TO = 350.0  # metres from the camera
_SHADOW_REACH = 120.0  # metres from what throws it
_SUN_RADIUS = 0.012  # radians: a little more than the sun's, for edges as soft as eyes expect
_LEAST_REFLECTION = 0.02
_LAMP_REACH, _MOST_LAMPS = 70.0, 24
_BRIGHTEST = 60.0
_BEAM, _BEAM_NEAR = 10.0, 60.0  # exponent from which a lamp is a headlight; square metres within which it is even


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
        lamps = light.lamps.joined(scene.headlights).nearest(rays.origins[0], _MOST_LAMPS, _LAMP_REACH)
        lit = _lit(scene, places, opened[hit], _sun_offsets(row, len(directions[0]))[:, hit], lamps)
        lit = _with_reflections(scene, places, lit, spread[hit])
        result[:, hit] = light.through_air(lit, places.directions, places.distances)
    return np.clip(result, 0.0, _BRIGHTEST, out=result)


def _places(scene: Scene, rays: Rays, hits: Hits, hit: Ints, directions: Floats, spread: Floats) -> _Places:
    faces, u, v, distances = (values[hit] for values in (hits.faces, hits.u, hits.v, hits.distances))
    points = np.ascontiguousarray(rays.origins[hit].T, np.float32) + directions * distances
    flat = _towards(np.ascontiguousarray(scene.faces.plane.take(faces, axis=0)[:, :3].T, np.float32), directions)
    corner = scene.faces.normals.take(faces, axis=1)
    smooth = corner[0:3] + corner[3:6] * u + corner[6:9] * v
    smooth = _unit(smooth * np.where(_dot(smooth, flat) < 0, np.float32(-1.0), np.float32(1.0)))
    texture = scene.faces.uv.take(faces, axis=1)
    place = texture[0:2] + texture[2:4] * u + texture[4:6] * v
    slope = np.maximum(np.abs(_dot(flat, directions)), 0.03)
    footprint = distances * spread / np.sqrt(slope)
    surface = evaluate(scene.world.materials, scene.faces.materials[faces], place[0], place[1], footprint)
    return _Places(points, directions, smooth, flat, distances, surface)


def _lit(scene: Scene, places: _Places, opened: Floats, sun_offsets: Floats, lamps: Lamps) -> Floats:
    """Light [3, N] that the surfaces scatter and send out themselves."""
    light, surface = scene.world.light, places.surface
    opened = opened + surface.leafy * 0.35 * (1.0 - opened)
    brightness = (surface.colour[0] + surface.colour[1] + surface.colour[2]) / 3.0
    open_share = opened / (1.0 - 0.7 * brightness * (1.0 - opened))
    received = light.ambient(places.normals) * open_share
    if light.sunlight.any():
        received += _sun(scene, places, sun_offsets)
    received += _lamplight(lamps, places) * (0.4 + 0.6 * open_share)
    found: Floats = surface.colour * received + surface.emission
    return found


def _sun(scene: Scene, places: _Places, offsets: Floats) -> Floats:
    light = scene.world.light
    toward = light.sun.astype(np.float32)[:, None]
    slope = _dot(places.normals, toward)
    leafy = places.surface.leafy
    # Leaves pass light on, and their crowns have no definite surface.
    received = np.maximum(slope, 0.0) * (1.0 - 0.5 * leafy) + leafy * (0.12 + 0.2 * np.abs(slope))
    facing = _dot(places.flat, toward)
    faces_it = (facing > 0) | (leafy > 0)
    looked = np.flatnonzero((received > 0.004) & faces_it & (places.distances < _SHADOWS_TO))
    lift = 2e-3 + 3e-4 * places.distances[looked]
    side = np.sign(facing[looked])
    origins = places.points[:, looked] + places.flat[:, looked] * (lift * side)
    across = np.cross(light.sun, (0.0, 0.0, 1.0) if abs(light.sun[2]) < 0.99 else (1.0, 0.0, 0.0))
    across = (across / np.linalg.norm(across)).astype(np.float32)
    upward = np.cross(across, light.sun).astype(np.float32)
    directions = toward + across[:, None] * offsets[0, looked] + upward[:, None] * offsets[1, looked]
    received *= faces_it
    received[looked] *= ~scene.blocked(origins.T, directions.T, _SHADOW_REACH)
    return light.sunlight.astype(np.float32)[:, None] * received


@lru_cache(maxsize=4)
def _sun_offsets(row: int, count: int) -> Floats:
    """By how much each sample looks past the sun's middle, across and up, [2, N]; neighbours to different sides."""
    index = np.arange(count)
    corner = (index % row % 2) + 2 * (index // row % 2)
    angle = np.float32(np.pi / 2) * corner + np.float32(0.6)
    found: Floats = np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32) * np.float32(_SUN_RADIUS * 0.7)
    return found


def _lamplight(lamps: Lamps, places: _Places) -> Floats:
    total = np.zeros_like(places.points)
    for position, colour, axis, spread in zip(
        lamps.positions, lamps.colours, lamps.directions, lamps.spread, strict=True
    ):
        way = position.astype(np.float32)[:, None] - places.points
        # Headlights are shaped so that the road right before them is not lit most.
        squared = np.maximum(_dot(way, way), _BEAM_NEAR if spread > _BEAM else 0.05)
        way /= np.sqrt(squared)
        cosine = np.maximum(-_dot(way, axis.astype(np.float32)), 0.0)
        strength = np.maximum(_dot(places.normals, way), 0.0) / squared
        total += colour.astype(np.float32)[:, None] * (strength * cosine ** np.float32(spread))
    return total


def _with_reflections(scene: Scene, places: _Places, lit: Floats, spread: Floats) -> Floats:
    gloss = places.surface.gloss
    cosine = np.abs(_dot(places.normals, places.directions))
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
    outgoing = incoming - 2.0 * _dot(incoming, normals) * normals
    flat = places.flat[:, shiny]
    # A smooth normal may send the ray into the face that it comes from.
    into = np.minimum(_dot(outgoing, flat), 0.0)
    outgoing = _unit(outgoing - 1.05 * into * flat)
    origins = places.points[:, shiny] + flat * (3e-3 + 3e-4 * places.distances[shiny])
    rays = Rays(origins.T, outgoing.T)
    hits = scene.nearest(rays)
    seen = light.sky(outgoing)
    hit = np.flatnonzero(hits.faces >= 0)
    if len(hit):
        others = _places(scene, rays, hits, hit, outgoing[:, hit], 4.0 * spread[shiny[hit]])
        slope = np.maximum(_dot(others.normals, light.sun.astype(np.float32)), 0.0)
        received = 0.6 * light.ambient(others.normals) + 0.6 * light.sunlight.astype(np.float32)[:, None] * slope
        seen[:, hit] = others.surface.colour * received + others.surface.emission
    return seen


def _towards(normals: Floats, directions: Floats) -> Floats:
    """Turn normals [3, N] so that they face the rays."""
    found: Floats = normals * np.where(_dot(normals, directions) > 0, np.float32(-1.0), np.float32(1.0))
    return found


def _dot(a: Floats, b: Floats) -> Floats:
    """Return the products of vectors [3, N]; component by component, for numpy adds up short axes slowly."""
    product: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


def _unit(vectors: Floats) -> Floats:
    unit: Floats = vectors / np.maximum(np.sqrt(_dot(vectors, vectors)), np.float32(1e-9))
    return unit
