# SPDX-License-Identifier: Apache-2.0
"""Hills, woods and towns that close the view far away, and the tall grass close by."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from cvcdepth_core.worlds.description import Horizon
from cvcdepth_core.worlds.shapes.meshes import Floats, Mesh, box, grid, joined, sphere, sphere_vertices
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.materials import FacadeParameters, Layer, Material, Pattern
from cvcdepth_core.worlds.surfaces.noise import Noise, noise
from cvcdepth_core.worlds.surfaces.palette import darker, leaves, lighter

_BELOW = 12.0  # metres that far things reach below the ground, which is flat out there
_FROM_ROADS = 25.0
_TALLEST = 0.7
_MOST_TUFTS = 5000


def build_horizon(site: Site) -> None:
    """Add everything far away."""
    makers = {"hills": _hills, "woods": _woods, "town": _town}
    for horizon in site.spec.horizon:
        rng = np.random.default_rng([site.spec.seed, horizon.seed, 53])
        mesh = joined(makers[horizon.kind](site, horizon, rng))
        site.add(site.new_object(f"far {horizon.kind}"), mesh)


def _ring(site: Site, distance: float, angles: Floats) -> Floats:
    """Return places [N, 2] around all roads."""
    points = [c.path.points(np.linspace(0, c.path.length, 40)) for c in site.corridors]
    around = np.concatenate(points) if points else np.zeros((1, 2))
    middle, half = (around.max(axis=0) + around.min(axis=0)) / 2, np.ptp(around, axis=0) / 2
    found: Floats = middle + np.stack([np.cos(angles), np.sin(angles)], axis=-1) * (half + distance)
    return found


def _off_roads(site: Site, places: Floats) -> Floats:
    """Return whether places [N, 2] keep away from all roads."""
    free = np.ones(len(places), bool)
    for corridor in site.corridors:
        free &= corridor.depth(places) < -_FROM_ROADS
    return free


def _hills(site: Site, horizon: Horizon, rng: np.random.Generator) -> Iterator[Mesh]:
    coarse, fine = Layer(Noise.BLOTCHES, 0.25, 0.18), Layer(Noise.ROUGH, 1.1, 0.22)
    cover = Material(horizon.colour, darker(horizon.colour, 0.6), Pattern.MOTTLED, coarse, fine, leafy=0.5)
    material = site.material(cover)
    angles = np.linspace(0, 2 * math.pi, 121)
    start = rng.uniform(0, 256)
    profile = 0.5 + 0.28 * noise(Noise.CLOUDY, start + 40 * np.cos(angles), 60 + 40 * np.sin(angles), np.ones(121))
    rows = []
    for share, out in ((-1.0, 0.0), (0.35, 0.12), (0.75, 0.3), (1.0, 0.6)):
        xy = _ring(site, horizon.distance * (1 + out), angles)
        z = np.full(121, -_BELOW) if share < 0 else horizon.height * share * np.clip(profile, 0.08, 1.3)
        rows.append(np.c_[xy, z])
    points = np.stack(rows)[:, ::-1]
    uv = np.stack([np.broadcast_to(angles * horizon.distance, points.shape[:2]), points[..., 2]], axis=-1)
    yield grid(points, uv, material).smoothed(60.0)


def _woods(site: Site, horizon: Horizon, rng: np.random.Generator) -> Iterator[Mesh]:
    """Yield crowns side by side, two deep."""
    shades = [site.material(leaves(darker(horizon.colour, factor))) for factor in (0.75, 1.0, 1.3)]
    gap = 0.55 * horizon.height
    for row in range(2):
        distance = horizon.distance + row * gap * 1.5
        around = 2 * math.pi * (distance + 120)
        angles = np.sort(rng.uniform(0, 2 * math.pi, int(min(around / gap, 320))))
        places = _ring(site, distance, angles)
        for (x, y), free in zip(places.tolist(), _off_roads(site, places), strict=True):
            height, rough = horizon.height * rng.uniform(0.6, 1.15), 1 + 0.15 * rng.normal(size=len(sphere_vertices(1)))
            crown = sphere(1.0, int(rng.choice(shades)), 1, rough).scaled(0.5 * height, 0.5 * height, 0.62 * height)
            if free:
                yield crown.moved(x, y, 0.42 * height)


def _town(site: Site, horizon: Horizon, rng: np.random.Generator) -> Iterator[Mesh]:
    lit = 0.3 if site.spec.sky.weather in ("dusk", "night") else 0.0
    walls = [_far_wall(site, rng, lit) for _ in range(6)]
    count = int(min(140, 2 * math.pi * (horizon.distance + 150) / 16))
    places = _ring(site, horizon.distance, rng.uniform(0, 2 * math.pi, count))
    places += rng.uniform(-0.25, 0.25, places.shape) * horizon.distance
    for (x, y), free in zip(places.tolist(), _off_roads(site, places), strict=True):
        tall = rng.random() < 0.12
        height = horizon.height * (rng.uniform(1.2, 2.5) if tall else rng.uniform(0.3, 1.0))
        size = rng.uniform(10, 22 if tall else 40, 2)
        block = box(float(size[0]), float(size[1]), height + _BELOW, int(rng.choice(walls)), -_BELOW)
        if free:
            yield block.turned(float(rng.uniform(0, math.pi))).moved(x, y)


def _far_wall(site: Site, rng: np.random.Generator, lit: float) -> int:
    shade = float(rng.uniform(0.12, 0.6))
    tint = rng.uniform(0.85, 1.1, 3)
    colour = lighter(darker((1.0, 0.95, 0.9), shade), 0.0)
    parameters = FacadeParameters(
        storey=float(rng.uniform(2.8, 4.0)),
        bay=float(rng.uniform(2.0, 5.0)),
        style=float(rng.integers(0, 4)),
        seed=float(rng.integers(0, 997)),
        lit=lit,
    )
    r, g, b = (np.array(colour) * tint).clip(0, 0.9).tolist()
    return site.material(Material((r, g, b), (0.05, 0.055, 0.06), Pattern.FACADE, parameters=tuple(parameters)))


def build_tall_grass(site: Site) -> None:
    """Add tufts beside the roads and on the ground nearby."""
    ground = site.spec.ground
    if ground.tall <= 0 or not site.corridors:
        return
    rng = np.random.default_rng([site.spec.seed, 59])
    count = int(_MOST_TUFTS * ground.tall)
    corridor = site.corridors[0]
    s = rng.uniform(0, corridor.path.length, count)
    side = rng.choice([-1.0, 1.0], count)
    edge = np.where(side > 0, corridor.left, corridor.right)
    places = corridor.path.points(s, side * (edge + 0.15 + rng.exponential(2.5, count)))
    free = np.ones(count, bool)
    for each in site.corridors:
        free &= each.depth(places) < -0.1
    places = places[free]
    roots = np.c_[places, site.terrain.height(places) - 0.03]
    material = site.material(leaves(lighter(ground.colour, 0.01)))
    site.add(site.new_object("tall grass"), _tufts(rng, roots, _TALLEST * ground.tall, material))


def _tufts(rng: np.random.Generator, roots: Floats, height: float, material: int) -> Mesh:
    """Return three blades for each root [N, 3]."""
    count = 3 * len(roots)
    base = np.repeat(roots, 3, axis=0) + np.c_[rng.normal(0, 0.08, (count, 2)), np.zeros(count)]
    angle, lean = rng.uniform(0, 2 * math.pi, count), rng.normal(0, 0.35, (count, 2))
    high = height * rng.uniform(0.35, 1.0, count)
    wide = 0.02 + 0.06 * high
    across = np.c_[np.cos(angle) * wide, np.sin(angle) * wide, np.zeros(count)]
    tip = base + np.c_[lean * high[:, None], high]
    corners = np.stack([base - across, base + across, tip], axis=1)
    faces = np.arange(3 * count).reshape(-1, 3).astype(np.int32)
    normals = np.tile(np.array([0.25, 0.0, 0.97], np.float32), (count, 3, 1))
    uv = (corners[..., :2] + corners[..., 2:]).astype(np.float32)
    return Mesh(corners.reshape(-1, 3), faces, uv, normals, np.full(count, material, np.int32))
