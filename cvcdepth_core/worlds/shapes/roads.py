# SPDX-License-Identifier: Apache-2.0
"""Roads: carriageways, kerbs, pavements and what is painted on them, laid on the ground."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from cvcdepth_core.worlds.description import Colour
from cvcdepth_core.worlds.shapes.meshes import Floats, Mesh, flat_mesh, grid, joined
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.materials import Material
from cvcdepth_core.worlds.surfaces.palette import darker, ground_material, marking, plain, road_material, stone
from cvcdepth_core.worlds.terrain import Corridor

_STATION = 1.0  # metres along the road
_PAINT = 0.008  # metres that paint lies above the road, so that no ray can confuse them
_LATER = 0.006  # metres that each further road lies lower, where it crosses an earlier one
_KERB_STONE = 0.14
_DASH, _GAP = 3.0, 5.0
_VERGE = ((0.0, -0.01), (1.2, -0.01), (2.6, -0.015), (4.0, -0.2))  # metres outward, height


def build_roads(site: Site) -> None:
    """Add all roads."""
    paint = site.new_object("road markings") if site.corridors else 0
    for number in range(len(site.corridors)):
        _RoadBuilder(site, number).build(paint)


class _RoadBuilder:
    def __init__(self, site: Site, number: int) -> None:
        self.site = site
        self.number = number
        self.corridor = site.corridors[number]
        self.road = self.corridor.road
        self.others = [c for c in site.corridors if c is not self.corridor]
        self.stations = np.linspace(0.0, self.corridor.path.length, round(self.corridor.path.length / _STATION) + 1)
        self.wet = site.spec.sky.wet

    def build(self, paint: int) -> None:
        road, site = self.road, self.site
        right, left = self.corridor.carriageway
        surface = site.material(road_material(road, self.wet))
        columns = np.linspace(right, left, max(2, math.ceil((left - right) / 2.5) + 1))
        carriageway = self._strip(columns, np.zeros(len(columns)), surface, self.stations)
        site.add(site.new_object(f"road {self.number}"), carriageway)
        for side in (-1.0, 1.0):
            self._side(side, right if side < 0 else left)
        site.add(paint, joined([*self._lines(), *self._crossings(), *self._arrows(), *self._covers()]))

    def _side(self, side: float, edge: float) -> None:
        site, road = self.site, self.road
        width = road.pavement[0 if side > 0 else 1]
        outer = edge
        if width > 0:
            outer = edge + side * width
            kerb = site.material(stone(darker((0.36, 0.35, 0.33), 1.0)))
            top = site.material(
                ground_material(
                    road.pavement_surface, road.pavement_colour, darker(road.pavement_colour, 0.8), self.wet
                )
            )
            inner = edge + side * min(_KERB_STONE, width / 2)
            parts = [*self._slab(edge, inner, kerb, kerb), *self._slab(inner, outer, top, kerb)]
            site.add(site.new_object(f"pavement {self.number}"), joined(parts))
        self._verge(side, outer, road.kerb if width > 0 else 0.0)

    def _slab(self, inner: float, outer: float, top: int, sides: int) -> Iterator[Mesh]:
        """Return A raised strip with its sides and ends, wherever no other road runs."""
        across = np.array([inner, (inner + outer) / 2, outer])
        free = ~np.any(self._in_other_carriageway(self.stations, across, 0.0), axis=1)
        up, down = max(self.road.kerb, 0.01), -0.3
        for run in _runs(free):
            stations = self.stations[run]
            if len(stations) < 2:
                continue
            yield self._strip(across, np.full(3, up), top, stations)
            for lateral in (inner, outer):
                yield self._strip(np.array([lateral, lateral]), np.array([down, up]), sides, stations, upright=True)
            for s in (stations[0], stations[-1]):
                yield self._end(s, inner, outer, down, up, sides)

    def _end(self, s: float, inner: float, outer: float, down: float, up: float, material: int) -> Mesh:
        points = self._drape(np.full(4, s), np.array([inner, outer, outer, inner]))
        points[:, 2] += (down, down, up, up)
        return flat_mesh(points, [(0, 1, 2), (0, 2, 3)], material)

    def _verge(self, side: float, edge: float, lift: float) -> None:
        """Ground that leads from the paved part to the terrain."""
        ground = self.site.spec.ground
        material = self.site.material(ground_material(ground.surface, ground.colour, ground.second, self.wet))
        out, down = np.array(_VERGE).T
        heights = down + lift * np.array([1.0, 1.0, 0.5, 0.0])
        across = edge + side * out
        busy = np.zeros(len(self.stations), bool)
        for lateral in across:
            points = self.corridor.path.points(self.stations, lateral)
            for other in self.others:
                busy |= other.depth(points) > -0.3
        for run in _runs(~busy):
            if run.stop - run.start > 1:
                strip = self._strip(across, heights, material, self.stations[run], world_texture=True)
                self.site.add(self._verge_object(), strip)

    def _verge_object(self) -> int:
        return self.site.names.index("ground")

    def _strip(
        self,
        across: Floats,
        heights: Floats,
        material: int,
        stations: Floats,
        upright: bool = False,
        world_texture: bool = False,
    ) -> Mesh:
        """Surface over stations x lateral places; texture coordinates are s and l (height if `upright`) or x and y."""
        s, lateral = np.meshgrid(stations, across, indexing="ij")
        points = self._drape(s.reshape(-1), lateral.reshape(-1))
        points[:, 2] += np.tile(heights, len(stations))
        second = np.broadcast_to(heights, s.shape) if upright else lateral
        uv = points[:, :2].reshape(*s.shape, 2) if world_texture else np.stack([s, second], axis=-1)
        mesh = grid(points.reshape(*s.shape, 3), uv, material)
        return mesh if across[0] > across[-1] else _reversed(mesh)

    def _drape(self, s: Floats, lateral: Floats) -> Floats:
        """Points [N, 3] on the ground at s and l [N]."""
        xy = self.corridor.path.points(s, lateral)
        found: Floats = np.c_[xy, self.site.terrain.height(xy) - self.number * _LATER]
        return found

    def _in_other_carriageway(self, stations: Floats, across: Floats, margin: float) -> Floats:
        """Whether places lie on another road, [stations, across]."""
        s, lateral = np.meshgrid(stations, across, indexing="ij")
        points = self.corridor.path.points(s.reshape(-1), lateral.reshape(-1))
        found = np.zeros(len(points), bool)
        for other in self.others:
            found |= _on_carriageway(other, points, margin)
        return found.reshape(s.shape)

    # What is painted on the road.

    def _lines(self) -> Iterator[Mesh]:
        road = self.road
        if not road.lanes:
            return
        white, half = self._paint((0.68, 0.68, 0.66)), road.lanes * road.lane_width / 2
        centre = 0.0 if not road.one_way and road.lanes % 2 == 0 else None
        for i in range(1, road.lanes):
            lateral = -half + i * road.lane_width
            if centre is not None and abs(lateral - centre) < 0.1:
                yield from self._centre_line(lateral)
            else:
                yield from self._line(lateral, 0.12, white, dashed=True)
        if road.edge_lines:
            for lateral in (-half + 0.1, half - 0.1):
                yield from self._line(lateral, 0.13, white)

    def _centre_line(self, lateral: float) -> Iterator[Mesh]:
        paint, kind = self._paint(self.road.centre_colour), self.road.centre_line
        if kind == "double":
            yield from self._line(lateral - 0.13, 0.11, paint)
            yield from self._line(lateral + 0.13, 0.11, paint)
        elif kind != "none":
            yield from self._line(lateral, 0.13, paint, dashed=kind == "dashed")

    def _line(self, lateral: float, width: float, paint: int, dashed: bool = False) -> Iterator[Mesh]:
        across = np.array([lateral - width / 2, lateral + width / 2])
        spans = [(0.0, self.corridor.path.length)]
        if dashed:
            spans = [(s, s + _DASH) for s in np.arange(1.0, self.corridor.path.length - _DASH, _DASH + _GAP)]
        for first, last in spans:
            stations = np.linspace(first, last, max(2, round((last - first) / _STATION) + 1))
            busy = np.any(self._in_other_carriageway(stations, across, 1.0), axis=1)
            for s in self.road.crossings:
                busy |= np.abs(stations - s) < 3.5
            for run in _runs(~busy):
                if run.stop - run.start > 1:
                    yield self._strip(across, np.full(2, _PAINT), paint, stations[run])

    def _crossings(self) -> Iterator[Mesh]:
        paint = self._paint((0.7, 0.7, 0.68))
        right, left = self.corridor.carriageway
        for s in self.road.crossings:
            for lateral in np.arange(right + 0.4, left - 0.4, 1.0):
                yield self._strip(
                    np.array([lateral, lateral + 0.5]), np.full(2, _PAINT), paint, np.linspace(s - 1.7, s + 1.7, 4)
                )
            for sign in (-1.0, 1.0):
                half = np.array([right + 0.1, -0.1]) if sign < 0 else np.array([0.1, left - 0.1])
                along = np.array([s + sign * 3.0, s + sign * 3.35])
                yield self._strip(half, np.full(2, _PAINT), paint, np.sort(along))

    def _arrows(self) -> Iterator[Mesh]:
        paint, road = self._paint((0.66, 0.66, 0.64)), self.road
        outline = np.array([(0, -0.08), (2.6, -0.08), (2.6, -0.35), (4.2, 0), (2.6, 0.35), (2.6, 0.08), (0, 0.08)])
        faces = [(0, 1, 5), (0, 5, 6), (2, 3, 4)]
        for s in road.arrows:
            for i in range(road.lanes):
                lateral = (i + 0.5 - road.lanes / 2) * road.lane_width
                forward = 1.0 if road.one_way or lateral < 0 else -1.0
                places = outline * forward + (s, lateral)
                points = self._drape(places[:, 0], places[:, 1]) + np.array([0, 0, _PAINT])
                if not self._in_other_carriageway(np.array([s]), np.array([lateral]), 3.0).any():
                    yield flat_mesh(points, faces, paint)

    def _covers(self) -> Iterator[Mesh]:
        """Manholes and drains."""
        rng = np.random.default_rng([self.site.spec.seed, self.number, 11])
        right, left = self.corridor.carriageway
        if self.road.surface not in ("asphalt", "concrete", "cobbles"):
            return
        iron = self.site.material(plain((0.06, 0.058, 0.055), 2.0))
        angles = np.linspace(0.0, 2 * math.pi, 12, endpoint=False)
        for _ in range(int(self.corridor.path.length / 30 * 2 * self.road.wear)):
            s, lateral = rng.uniform(2, self.corridor.path.length - 2), rng.uniform(right + 0.5, left - 0.5)
            points = self._drape(s + 0.33 * np.cos(angles), lateral + 0.33 * np.sin(angles)) + np.array(
                [0, 0, _PAINT / 2]
            )
            yield flat_mesh(points, [(0, k, k + 1) for k in range(1, 11)], iron)

    def _paint(self, colour: Colour) -> int:
        material: Material = marking(colour, self.road.colour, self.road.markings_wear)
        return self.site.material(material)


def _on_carriageway(corridor: Corridor, points: Floats, margin: float) -> Floats:
    s, lateral = corridor.path.locate(points)
    right, left = corridor.carriageway
    between = (lateral > right - margin) & (lateral < left + margin)
    return between & (s > -margin) & (s < corridor.path.length + margin)


def _runs(flags: Floats) -> Sequence[slice]:
    """Return the stretches of True."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False]))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _reversed(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[:, ::-1], mesh.uv[:, ::-1], mesh.normals[:, ::-1], mesh.materials)
