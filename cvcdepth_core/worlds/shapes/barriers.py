# SPDX-License-Identifier: Apache-2.0
"""Walls, fences, hedges and rails along lines, and wires from pole to pole."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator

import numpy as np

from cvcdepth_core.worlds.description import Barrier, BarrierKind, Wires
from cvcdepth_core.worlds.shapes.meshes import Floats, Mesh, box, flat_mesh, joined, sphere_vertices, tube
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.palette import barrier_material, darker, metal, plain, stone

_PIECE = 2.5  # metres: how long straight pieces are, at most


def build_barriers(site: Site) -> None:
    """Add all barriers."""
    for barrier in site.spec.barriers:
        mesh = joined(_barrier(site, barrier))
        site.add(site.new_object(barrier.kind), mesh)


def build_wires(site: Site) -> None:
    """Add all wires."""
    for wires in site.spec.wires:
        site.add(site.new_object("wires"), joined(_wires(site, wires)))


def _barrier(site: Site, barrier: Barrier) -> Iterator[Mesh]:
    rng = np.random.default_rng([site.spec.seed, barrier.seed, 23])
    material = site.material(barrier_material(barrier.kind, barrier.colour))
    second = site.material(
        metal(darker(barrier.colour, 0.8)) if barrier.kind == "mesh" else stone(darker(barrier.colour, 0.8))
    )
    piece = _PIECES[barrier.kind]
    for start, end in _pieces(site, barrier):
        way = end[:2] - start[:2]
        length = float(np.hypot(*way))
        part = joined(piece(length, barrier.height, material, second, rng))
        # Pieces stay upright and follow the slope by shearing.
        slope = (end[2] - start[2]) / max(length, 0.1)
        sheared = part.vertices + np.c_[np.zeros((len(part.vertices), 2)), part.vertices[:, 0] * slope]
        part = Mesh(sheared, part.faces, part.uv + np.float32((start[0] + start[1]) % 7), part.normals, part.materials)
        middle = (start + end) / 2
        yield part.turned(math.atan2(way[1], way[0])).moved(*middle.tolist())


def _pieces(site: Site, barrier: Barrier) -> Iterator[tuple[Floats, Floats]]:
    """Both ends [3] of each straight piece, on the ground."""
    corners = np.array(barrier.line)
    for first, last in itertools.pairwise(corners):
        count = max(1, math.ceil(float(np.hypot(*(last - first))) / _PIECE))
        along = first + (last - first) * np.linspace(0, 1, count + 1)[:, None]
        xy = np.array([site.xy((float(a), float(b)), barrier.road) for a, b in along])
        ends = np.c_[xy, site.terrain.height(xy) + site.raised(xy)]
        yield from itertools.pairwise(ends)


_Piece = Callable[[float, float, int, int, np.random.Generator], Iterator[Mesh]]


def _wall(length: float, height: float, material: int, second: int, _: np.random.Generator) -> Iterator[Mesh]:
    yield box(length + 0.02, 0.24, height + 0.6, material, -0.6)
    yield box(length + 0.02, 0.3, 0.06, second, height)


def _fence(length: float, height: float, material: int, _: int, rng: np.random.Generator) -> Iterator[Mesh]:
    """Boards side by side, with or without gaps."""
    yield box(0.1, 0.1, height + 0.3, material, -0.25).moved(-length / 2)
    for z in (0.25, 0.8):
        yield box(length, 0.04, 0.08, material, z * height).moved(y=0.04)
    step = 0.15
    for x in np.arange(-length / 2 + step / 2, length / 2, step):
        yield box(0.115, 0.02, height * rng.uniform(0.97, 1.0), material, 0.05).moved(x)


def _railing(length: float, height: float, material: int, _: int, __: np.random.Generator) -> Iterator[Mesh]:
    """Thin upright bars."""
    for z in (0.12, height - 0.05):
        yield box(length + 0.02, 0.04, 0.04, material, z)
    yield box(0.06, 0.06, height + 0.1, material, -0.05).moved(-length / 2)
    for x in np.arange(-length / 2 + 0.08, length / 2, 0.16):
        yield box(0.02, 0.02, height, material, 0.08).moved(x)


def _mesh(length: float, height: float, material: int, second: int, _: np.random.Generator) -> Iterator[Mesh]:
    """Wire netting between posts."""
    yield box(0.06, 0.06, height + 0.4, second, -0.3).moved(-length / 2)
    yield box(length, 0.03, 0.03, second, height)
    wire, half = 0.008, length / 2
    for x in np.arange(-half, half, 0.2):
        yield _upright(x, x + wire, 0.05, height, material)
    for z in np.arange(0.15, height, 0.2):
        yield _upright(-half, half, z, z + wire, material)


def _upright(left: float, right: float, bottom: float, top: float, material: int) -> Mesh:
    """Return a rectangle in the plane y = 0."""
    corners = [(left, 0, bottom), (right, 0, bottom), (right, 0, top), (left, 0, top)]
    return flat_mesh(corners, [(0, 1, 2), (0, 2, 3)], material)


def _hedge(length: float, height: float, material: int, _: int, rng: np.random.Generator) -> Iterator[Mesh]:
    """Return A trimmed body with leaves that stick out of it."""
    depth = min(0.9, 0.35 + 0.3 * height)
    yield box(length + 0.06, 0.8 * depth, 0.95 * height, material, -0.1, (1.0, 0.85))
    count = int(110 * length * height / 2.5) + 40
    places = rng.uniform(-0.5, 0.5, (count, 3)) * (length, depth, height) + (0, 0, height / 2)
    face = rng.integers(0, 3, count)
    places[face == 0, 1] = -depth / 2 + rng.normal(0, 0.04, (face == 0).sum())
    places[face == 1, 1] = depth / 2 + rng.normal(0, 0.04, (face == 1).sum())
    places[face == 2, 2] = height + rng.normal(0, 0.05, (face == 2).sum())
    corners = places[:, None] + rng.normal(0, 0.05, (count, 3, 3))
    outward = np.select([(face == 0)[:, None], (face == 1)[:, None]], [(0, -1.0, 0.4), (0, 1.0, 0.4)], (0, 0, 1.0))
    outward = outward + 0.4 * sphere_vertices(2)[rng.integers(0, len(sphere_vertices(2)), count)]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    faces = np.arange(3 * count).reshape(-1, 3).astype(np.int32)
    normals = np.repeat(outward[:, None], 3, axis=1).astype(np.float32)
    uv = (corners[..., :2] + corners[..., 2:]).astype(np.float32)
    yield Mesh(corners.reshape(-1, 3), faces, uv, normals, np.full(count, material, np.int32))


def _guard_rail(length: float, height: float, material: int, _: int, __: np.random.Generator) -> Iterator[Mesh]:
    h = min(height, 0.8)
    for z in (h - 0.3, h - 0.14):
        yield box(length + 0.03, 0.07, 0.13, material, z)
    yield box(length + 0.03, 0.03, 0.3, material, h - 0.3)
    yield box(0.12, 0.1, h + 0.2, material, -0.2).moved(-length / 2, 0.08)


def _concrete_barrier(length: float, height: float, material: int, _: int, __: np.random.Generator) -> Iterator[Mesh]:
    h = min(height, 1.1)
    yield box(length - 0.02, 0.6, 0.25, material, -0.1)
    yield box(length - 0.02, 0.5, h - 0.15, material, 0.15, (1.0, 0.45))


_PIECES: dict[BarrierKind, _Piece] = {
    "wall": _wall,
    "brick_wall": _wall,
    "fence": _fence,
    "railing": _railing,
    "mesh": _mesh,
    "hedge": _hedge,
    "guard_rail": _guard_rail,
    "concrete_barrier": _concrete_barrier,
}


def _wires(site: Site, wires: Wires) -> Iterator[Mesh]:
    material = site.material(plain((0.02, 0.02, 0.02), 0.3))
    tops = [(*site.xy(at, wires.road), 0.0) for at in wires.line]
    tops = [(x, y, site.height_on(x, y) + wires.height) for x, y, _ in tops]
    t = np.linspace(0.0, 1.0, 13)[:, None]
    for first, last in itertools.pairwise(tops):
        a, b = np.array(first), np.array(last)
        across = np.array([-(b - a)[1], (b - a)[0], 0.0]) / max(float(np.hypot(*(b - a)[:2])), 0.1)
        for i in range(wires.count):
            offset = across * (i - (wires.count - 1) / 2) * 0.55 - np.array([0, 0, 0.25 * (i % 2)])
            points = a + (b - a) * t + offset - np.array([0, 0, 4 * wires.sag]) * t * (1 - t)
            yield tube(points, np.full(13, 0.012), material, 3, closed=False)
