# SPDX-License-Identifier: Apache-2.0
"""Buildings: walls with windows, roofs, and what sticks out of them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from cvcdepth_core.worlds.description import Building, WallKind
from cvcdepth_core.worlds.shapes.meshes import Mesh, box, extruded, flat_mesh, joined, prism
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.materials import FacadeParameters, Layer, Material, Pattern
from cvcdepth_core.worlds.surfaces.noise import Noise
from cvcdepth_core.worlds.surfaces.palette import (
    corrugated,
    darker,
    metal,
    plain,
    roof_tiles,
    sign_face,
    stone,
    stripes,
)

_WALLS: dict[WallKind, float] = {"plaster": 0, "brick": 1, "panels": 2, "boards": 3, "metal": 4, "glass": 2}
_STYLES = {"single": 0.0, "divided": 1.0, "bands": 2.0, "curtain": 3.0}
_GROUND_FLOORS = {"same": 0.0, "shop": 1.0, "gates": 2.0, "blind": 3.0, "arcade": 1.0}
_BASEMENT = 4.0  # metres that walls reach into the ground, for slopes
_ARCADE_DEPTH = 2.8


def build_buildings(site: Site) -> None:
    """Add all buildings."""
    for building in site.spec.buildings:
        site.stand("building", _BuildingBuilder(site, building).mesh(), building)


class _BuildingBuilder:
    """One building, in its own frame: its middle at the origin, its front towards -y."""

    def __init__(self, site: Site, building: Building) -> None:
        self.site = site
        self.b = building
        self.length, self.depth, self.height = building.size
        self.rng = np.random.default_rng([site.spec.seed, building.seed, 3])
        self.facade = site.material(self._facade())
        self.trim = site.material(stone(building.trim))
        self.ground_height = min(max(3.0, building.storey * 1.15), self.height)

    def mesh(self) -> Mesh:
        parts = [*self._walls(), *self._roof()]
        if self.b.balconies:
            parts += self._balconies()
        parts += [*self._front(), *self._roof_top()]
        return joined(parts)

    def _facade(self) -> Material:
        b = self.b
        night = b.windows == "curtain" or b.ground_floor == "shop"
        lit = (0.35 if night else 0.25) if self.site.spec.sky.weather in ("dusk", "night") else 0.0
        parameters = FacadeParameters(
            b.storey,
            b.bay,
            *b.window,
            _STYLES[b.windows],
            min(max(3.0, b.storey * 1.15), b.size[2]),
            _GROUND_FLOORS[b.ground_floor],
            _WALLS[b.wall],
            float(b.seed % 997),
            lit,
        )
        coarse, fine = Layer(Noise.CLOUDY, 6.0, 0.07), Layer(Noise.ROUGH, 50.0, 0.06)
        return Material(b.colour, b.glass, Pattern.FACADE, coarse, fine, parameters=tuple(parameters))

    def _walls(self) -> Iterator[Mesh]:
        if self.b.ground_floor != "arcade":
            yield _shell(self.length, self.depth, -_BASEMENT, self.height, self.facade)
            return
        recess = min(_ARCADE_DEPTH, self.depth / 2)
        upper = _shell(self.length, self.depth, self.ground_height, self.height, self.facade)
        ceiling = box(self.length, self.depth, 0.3, self.trim, self.ground_height - 0.3)
        yield from (upper, ceiling)
        yield _shell(self.length, self.depth - recess, -_BASEMENT, self.ground_height, self.facade).moved(y=recess / 2)
        for x in np.linspace(-self.length / 2 + 0.3, self.length / 2 - 0.3, max(2, round(self.length / 4.5))):
            column = box(0.5, 0.5, self.ground_height + _BASEMENT, self.trim, -_BASEMENT)
            yield column.moved(x, -self.depth / 2 + 0.25)

    def _roof(self) -> Iterator[Mesh]:
        b, rise = self.b, max(self.b.roof_height, 0.1)
        if b.roof == "flat":
            cover = self.site.material(plain(darker(b.roof_colour, 1.0), 1.5))
            yield box(self.length - 0.4, self.depth - 0.4, 0.05, cover, self.height - 0.1)
            yield from self._parapet(rise)
            return
        tiles = self.site.material(roof_tiles(b.roof_colour) if b.wall != "metal" else corrugated(b.roof_colour))
        over = 0.45
        hips = min(self.depth, self.length) / 2.2 if b.roof == "hip" else 0.0
        if b.roof == "saw":
            yield from self._saw_teeth(rise, tiles)
            return
        half_y, half_x = self.depth / 2 + over, self.length / 2 + over
        ridge_y = half_y - 0.3 if b.roof == "shed" else 0.0
        eaves = self.height - rise * over / max(half_y, 0.1)
        yield _gable(half_x, half_y, hips, ridge_y, eaves, self.height + rise, tiles)
        if b.roof == "gable":
            for side in (-1.0, 1.0):
                x = side * self.length / 2
                triangle = [
                    (x, -self.depth / 2, self.height),
                    (x, self.depth / 2, self.height),
                    (x, 0, self.height + rise),
                ]
                yield flat_mesh(triangle, [(0, 1, 2) if side > 0 else (0, 2, 1)], self.facade)

    def _parapet(self, rise: float) -> Iterator[Mesh]:
        x, y, thick = self.length, self.depth, 0.25
        for width, depth, dx, dy in (
            (x + 0.12, thick, 0, -y / 2 + thick / 2 - 0.06),
            (x + 0.12, thick, 0, y / 2 - thick / 2 + 0.06),
            (thick, y, -x / 2 + thick / 2 - 0.06, 0),
            (thick, y, x / 2 - thick / 2 + 0.06, 0),
        ):
            yield box(width, depth, rise + 0.12, self.trim, self.height - 0.12).moved(dx, dy)

    def _saw_teeth(self, rise: float, tiles: int) -> Iterator[Mesh]:
        count = max(2, round(self.length / 7))
        step = self.length / count
        for i in range(count):
            x = -self.length / 2 + i * step
            profile = [(x, self.height), (x + step, self.height), (x, self.height + rise)]
            yield extruded(profile, self.depth, tiles)

    def _balconies(self) -> Iterator[Mesh]:
        rail = self.site.material(metal(darker(self.b.trim, 0.4)))
        depth, width = self.rng.uniform(0.7, 1.4), self.b.bay * 0.8
        open_rail = self.rng.random() < 0.6
        every = int(self.rng.integers(1, 3))
        columns = math.floor(self.length / self.b.bay / 2)
        for i in range(-columns, columns, every):
            x = (i + 0.5) * self.b.bay
            for z in np.arange(self.ground_height, self.height - 1.5, self.b.storey):
                slab = box(width, depth, 0.16, self.trim, z - 0.05).moved(x, -self.depth / 2 - depth / 2)
                yield slab
                yield from self._balustrade(x, z + 0.1, width, depth, rail, open_rail)

    def _balustrade(self, x: float, z: float, width: float, depth: float, rail: int, open_rail: bool) -> Iterator[Mesh]:
        front = -self.depth / 2 - depth + 0.04
        if not open_rail:
            yield box(width, 0.06, 0.95, self.trim, z).moved(x, front)
            for side in (-1, 1):
                yield box(0.06, depth, 0.95, self.trim, z).moved(x + side * (width / 2 - 0.03), front + depth / 2)
            return
        yield box(width, 0.05, 0.05, rail, z + 0.95).moved(x, front)
        for dx in np.arange(-width / 2, width / 2 + 0.01, 0.28):
            yield box(0.025, 0.025, 0.95, rail, z).moved(x + dx, front)

    def _front(self) -> Iterator[Mesh]:
        """Cornices, awnings, signs, doors' canopies and pipes."""
        front = -self.depth / 2
        if self.height > 7 and self.b.wall in ("plaster", "brick") and self.rng.random() < 0.6:
            yield box(self.length + 0.2, 0.25, 0.3, self.trim, self.height - 0.45).moved(0, front - 0.05)
            yield box(self.length, 0.16, 0.2, self.trim, self.ground_height - 0.1).moved(0, front - 0.02)
        if self.b.ground_floor == "shop":
            yield from self._shop_front(front)
        if self.rng.random() < 0.5 and self.b.windows != "curtain":
            pipe = self.site.material(metal((0.3, 0.3, 0.29)))
            x = float(self.rng.choice([-1, 1])) * (self.length / 2 - 0.3)
            yield box(0.1, 0.1, self.height, pipe).moved(x, front - 0.07)
        if self.b.ground_floor in ("same", "blind"):
            yield from self._entrance(front)

    def _shop_front(self, front: float) -> Iterator[Mesh]:
        bay = self.b.bay * 1.7
        colour = tuple(self.rng.uniform(0.02, 0.6, 3).tolist())
        board = self.site.material(sign_face(darker(colour, 1.0), (0.75, 0.75, 0.7), bay * 0.9, 0.6))
        awning = self.site.material(stripes(darker(colour, 1.0), (0.7, 0.7, 0.66), 0.4, upright=True))
        for i in range(-math.floor(self.length / bay / 2), math.floor(self.length / bay / 2)):
            x, choice = (i + 0.5) * bay, self.rng.random()
            if choice < 0.55:
                yield box(bay * 0.9, 0.12, 0.6, board).moved(x, front - 0.08, self.ground_height - 0.75)
            if choice < 0.25:
                yield _awning(bay * 0.9, self.rng.uniform(0.8, 1.6), awning).moved(x, front, self.ground_height - 0.8)
            if choice > 0.85:
                blade = box(0.08, 0.7, 0.9, board).moved(x + bay * 0.4, front - 0.45, self.ground_height + 0.2)
                yield blade

    def _entrance(self, front: float) -> Iterator[Mesh]:
        x = self.rng.uniform(-0.35, 0.35) * self.length
        colour = tuple(self.rng.uniform(0.02, 0.3, 3).tolist())
        door = self.site.material(plain(darker(colour, 1.0), 0.5, 0.15))
        yield box(1.25, 0.12, 2.35, self.trim).moved(x, front)
        yield box(1.0, 0.16, 2.15, door).moved(x, front)
        for step in range(int(self.rng.integers(0, 3))):
            yield box(1.6, 0.35 * (step + 1), 0.16, self.trim, -0.16 * step).moved(x, front - 0.17 * (step + 1))
        if self.rng.random() < 0.5:
            yield box(1.9, 0.9, 0.12, self.trim, 2.5).moved(x, front - 0.45)

    def _roof_top(self) -> Iterator[Mesh]:
        """Chimneys and machines."""
        grey = self.site.material(metal((0.32, 0.32, 0.33)))
        chimney = self.site.material(stone(darker(self.b.trim, 0.7)))
        for _ in range(int(self.rng.integers(0, 4))):
            x, y = self.rng.uniform(-0.4, 0.4) * self.length, self.rng.uniform(-0.3, 0.3) * self.depth
            if self.b.roof == "flat":
                size = self.rng.uniform(0.8, 2.5, 3)
                yield box(float(size[0]), float(size[1]), float(size[2]) * 0.8, grey, self.height - 0.05).moved(x, y)
            elif self.b.roof in ("gable", "hip"):
                yield box(0.6, 0.6, self.b.roof_height + 1.1, chimney, self.height).moved(x, y * 0.4)


def _shell(length: float, depth: float, bottom: float, top: float, material: int) -> Mesh:
    """Four walls without floor; heights on their texture count from z = 0."""
    outline = [(-length / 2, -depth / 2), (length / 2, -depth / 2), (length / 2, depth / 2), (-length / 2, depth / 2)]
    return prism(outline, bottom, top, material)


def _gable(half_x: float, half_y: float, hips: float, ridge_y: float, eaves: float, top: float, material: int) -> Mesh:
    """Roof with its ridge along x at `ridge_y`; `hips` shorten the ridge at both ends."""
    corners = [(-half_x, -half_y, eaves), (half_x, -half_y, eaves), (half_x, half_y, eaves), (-half_x, half_y, eaves)]
    ridge = [(-half_x + hips, ridge_y, top), (half_x - hips, ridge_y, top)]
    faces = [(0, 1, 5), (0, 5, 4), (2, 3, 4), (2, 4, 5), (1, 2, 5), (3, 0, 4)]
    if not hips:
        faces = faces[:4]
    # The soffit, so that nobody looks into the roof from below.
    faces += [(0, 2, 1), (0, 3, 2)]
    return flat_mesh(corners + ridge, faces, material)


def _awning(width: float, depth: float, material: int) -> Mesh:
    """Slanted cloth before a shop, hanging from z = 0 down and outwards to -y."""
    w = width / 2
    points = [(-w, 0, 0), (w, 0, 0), (w, -depth, -0.55), (-w, -depth, -0.55), (w, -depth, -0.75), (-w, -depth, -0.75)]
    return flat_mesh(points, [(0, 2, 1), (0, 3, 2), (3, 4, 2), (3, 5, 4)], material)
