# SPDX-License-Identifier: Apache-2.0
"""Cars, vans, trucks and buses, lofted from their side views. x forward, on the ground."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cvcdepth_core.worlds.description import Colour, Vehicle, VehicleKind
from cvcdepth_core.worlds.shapes.meshes import Floats, Mesh, box, cylinder, flat_mesh, joined, tube, wheel
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.materials import Material
from cvcdepth_core.worlds.surfaces.palette import (
    corrugated,
    darker,
    lamp,
    metal,
    paint,
    plain,
    rubber,
    sign_face,
    stripes,
    window,
)


@dataclass(frozen=True)
class _Shape:
    """Side view of a car body; heights above the ground, positions from its rear end as shares of its length."""

    length: float
    width: float
    height: float
    bonnet: float
    """Height of the bonnet's front edge."""
    belt: float
    """Height of the windows' lower edge."""
    boot: float
    """Height of the rear end."""
    cowl: float
    """Where the windscreen begins."""
    roof: tuple[float, float]
    """Rear and front end of the roof."""
    rear_window: float
    """Where the rear window ends."""
    clearance: float = 0.2
    wheel_radius: float = 0.32
    axles: tuple[float, float] = (0.19, 0.81)
    windows_to: float = 0.0
    """Where the side windows end, to the rear."""


_SHAPES: dict[VehicleKind, _Shape] = {
    "hatchback": _Shape(4.0, 1.75, 1.48, 0.72, 0.93, 0.9, 0.74, (0.14, 0.56), 0.015),
    "saloon": _Shape(4.7, 1.83, 1.45, 0.7, 0.92, 0.98, 0.71, (0.28, 0.53), 0.13),
    "estate": _Shape(4.75, 1.83, 1.48, 0.72, 0.93, 0.92, 0.72, (0.07, 0.54), 0.012),
    "suv": _Shape(4.6, 1.88, 1.7, 0.92, 1.1, 1.05, 0.73, (0.08, 0.57), 0.012, 0.24, 0.37),
    "van": _Shape(5.4, 2.0, 2.25, 1.0, 1.25, 1.25, 0.88, (0.015, 0.72), 0.005, 0.24, 0.35, windows_to=0.66),
    "minibus": _Shape(5.1, 1.95, 1.98, 0.98, 1.12, 1.1, 0.87, (0.02, 0.7), 0.008, 0.22, 0.34),
    "pickup": _Shape(5.4, 1.92, 1.83, 1.02, 1.18, 1.1, 0.7, (0.4, 0.53), 0.37, 0.28, 0.39, (0.22, 0.82), 0.4),
}
_TYRE_WIDTH = 0.22


def build_vehicles(site: Site) -> None:
    """Add all vehicles that stand still; those that move are `vehicle_mesh` alone."""
    for vehicle in site.spec.vehicles:
        if vehicle.motion is None:
            site.park(vehicle.kind, vehicle_mesh(site, vehicle), vehicle)


def vehicle_mesh(site: Site, vehicle: Vehicle) -> Mesh:
    """Return the vehicle in its own frame, on the ground."""
    rng = np.random.default_rng([site.spec.seed, vehicle.seed, 13])
    make = _Make(site, vehicle.colour, rng)
    if vehicle.kind in _SHAPES:
        return car_mesh(site, vehicle.kind, vehicle.colour, rng)
    return joined(list(_LARGE[vehicle.kind](make)))


def car_mesh(site: Site, kind: VehicleKind, colour: Colour, rng: np.random.Generator) -> Mesh:
    """Return A car, pickup, van or minibus."""
    make, shape = _Make(site, colour, rng), _varied(_SHAPES[kind], rng)
    parts = [_body(make, shape, kind), *_wheels(make, shape), *_lights(make, shape), *_trims(make, shape, kind)]
    return joined(parts)


class _Make:
    """Materials of one vehicle."""

    def __init__(self, site: Site, colour: Colour, rng: np.random.Generator) -> None:
        self.rng = rng
        night = site.spec.sky.weather in ("dusk", "night")
        self._site = site
        self.colour = colour
        self.paint = site.material(paint(colour))
        self.glass = site.material(window(0.015))
        self.black = site.material(plain((0.022, 0.022, 0.024), 0.5, 0.1))
        self.tyre = site.material(rubber())
        shade = float(rng.choice([0.42, 0.42, 0.3, 0.12, 0.03]))
        self.rim = site.material(metal((shade, shade, shade)))
        self.trim = self.black if rng.random() < 0.5 else self.paint
        self.head = site.material(lamp((0.6, 0.6, 0.58), 9.0 if night else 0.0))
        self.tail = site.material(lamp((0.4, 0.012, 0.012), 5.0 if night else 0.0))
        self.plate = site.material(plain((0.6, 0.6, 0.55), 0.5))

    def add(self, material: Material) -> int:
        return self._site.material(material)


def _varied(shape: _Shape, rng: np.random.Generator) -> _Shape:
    """Return the same kind of car by another maker."""
    length, width, height = (np.array([shape.length, shape.width, shape.height]) * rng.uniform(0.94, 1.06, 3)).tolist()
    factor = height / shape.height
    front = shape.roof[1] + rng.uniform(-0.02, 0.02)
    return _Shape(
        length,
        width,
        height,
        shape.bonnet * factor,
        shape.belt * factor * rng.uniform(0.98, 1.04),
        shape.boot * factor,
        shape.cowl + rng.uniform(-0.015, 0.015),
        (shape.roof[0] + rng.uniform(-0.01, 0.03), front),
        shape.rear_window,
        shape.clearance,
        shape.wheel_radius * rng.uniform(0.97, 1.05),
        shape.axles,
        shape.windows_to,
    )


class _Station(NamedTuple):
    """One cross-section of a body."""

    x: float
    low: float
    """Height of the underside."""
    belt: float
    top: float
    """Height of roof or bonnet."""
    wide: float
    """Half width at the widest."""
    belt_wide: float
    top_wide: float
    """Half width at the top's edge."""

    def outline(self) -> Floats:
        """Half of it, from the middle of the underside to the middle of the top, [9, 2] of y and z."""
        middle = self.low + 0.55 * (self.belt - self.low)
        top_edge = max(self.top - 0.055, self.belt)
        return np.array(
            [
                (0.0, self.low),
                (self.wide - 0.13, self.low),
                (self.wide - 0.03, self.low + 0.1),
                (self.wide, middle),
                (self.belt_wide + 0.025, self.belt - 0.03),
                (self.belt_wide, self.belt),
                (self.top_wide + 0.02, top_edge),
                (self.top_wide * 0.86, self.top),
                (0.0, self.top + 0.025),
            ]
        )


_SKIRT, _LAMP, _WINDOW, _TOP = slice(0, 2), slice(3, 5), slice(5, 6), slice(6, 8)  # strips of the outline
_DOOR = slice(2, 5)
_SEAM = 0.0016  # half the gap beside a door, as a share of the length


def _body(make: _Make, shape: _Shape, kind: VehicleKind) -> Mesh:
    stations = _stations(shape, kind)
    half = np.stack([station.outline() for station in stations])
    y, z = half[..., 0], half[..., 1]
    x = np.broadcast_to(np.array([station.x for station in stations])[:, None], y.shape)
    right = np.stack([x, -y, z], axis=-1)
    left = np.stack([x, y, z], axis=-1)[:, ::-1]
    ring = np.concatenate([right, left[:, 1:]], axis=1)
    materials = _skin(make, shape, kind, stations)
    m, n = ring.shape[:2]
    i, j = np.meshgrid(np.arange(m - 1), np.arange(n - 1), indexing="ij")
    a = (i * n + j).reshape(-1)
    quads = np.stack([a, a + n, a + n + 1, a + 1], axis=1)
    faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    ends = [_end_cap(ring[0], make.paint, front=False), _end_cap(ring[-1], make.paint, front=True)]
    skin = flat_mesh(ring.reshape(-1, 3), faces, np.repeat(materials.reshape(-1), 2))
    return joined([skin, *ends]).smoothed(38.0)


def _stations(s: _Shape, kind: VehicleKind) -> list[_Station]:
    """Cross-sections from the rear end to the front."""
    w, belt = s.width / 2, s.belt
    glass_wide, roof_wide = w - 0.06, w * 0.76 if kind not in ("van", "minibus") else w * 0.88
    bonnet = 0.55 * belt + 0.45 * s.bonnet + 0.03
    along = [
        # share of the length, underside, belt, top, wide, belt wide, top wide
        (0.0, s.clearance + 0.14, s.boot * 0.82, s.boot * 0.93, w - 0.12, w - 0.17, w * 0.7),
        (0.012, s.clearance + 0.06, s.boot * 0.94, s.boot, w - 0.06, w - 0.09, w * 0.76),
        (s.rear_window + 0.015, s.clearance, belt, max(belt, s.boot), w - 0.01, glass_wide, w * 0.8),
        (s.roof[0], s.clearance, belt, s.height - 0.03, w, glass_wide, roof_wide),
        ((s.roof[0] + s.roof[1]) / 2, s.clearance, belt, s.height, w, glass_wide, roof_wide),
        (s.roof[1], s.clearance, belt, s.height - 0.035, w, glass_wide, roof_wide),
        (s.cowl, s.clearance, belt, belt + 0.03, w, glass_wide, w * 0.8),
        (0.5 * (s.cowl + 1.0), s.clearance, 0.6 * belt + 0.4 * s.bonnet, bonnet, w - 0.01, w - 0.1, w * 0.74),
        (0.965, s.clearance, s.bonnet - 0.03, s.bonnet, w - 0.06, w - 0.13, w * 0.68),
        (0.99, s.clearance + 0.03, s.bonnet * 0.86, s.bonnet * 0.9, w - 0.13, w - 0.2, w * 0.62),
        (1.0, s.clearance + 0.1, s.bonnet * 0.7, s.bonnet * 0.76, w - 0.2, w - 0.27, w * 0.55),
    ]  # fmt: skip
    pillar = (s.roof[0] + s.roof[1]) / 2
    for share in (pillar - 0.012, pillar + 0.012):
        along.append((share, s.clearance, belt, s.height, w, glass_wide, roof_wide))
    if s.windows_to:
        along.append((s.windows_to, s.clearance, belt, s.height - 0.005, w, glass_wide, roof_wide))
    rows = np.array(sorted(row for row in along if row[0] != pillar))
    edges = [share + side * _SEAM for share in _seams(s) for side in (-1.0, 1.0)]
    rows = np.concatenate([rows, np.stack([np.interp(edges, rows[:, 0], column) for column in rows.T], axis=1)])
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return [_Station(share * s.length - s.length / 2, *rest) for share, *rest in rows.tolist()]


def _seams(s: _Shape) -> tuple[float, float]:
    """Where doors begin and end, as shares of the length."""
    return s.cowl - 0.035, max(s.roof[0] + 0.03, s.axles[0] + 0.085)


def _skin(make: _Make, s: _Shape, kind: VehicleKind, stations: list[_Station]) -> Floats:
    """Material of each cell between two stations and two points of the outline, both halves."""
    shares = [(station.x + s.length / 2) / s.length for station in stations]
    rows = []
    for first, last in itertools.pairwise(shares):
        row = np.full(8, make.paint)
        row[_SKIRT] = make.black
        middle = (first + last) / 2
        in_cabin = s.rear_window + 0.01 < middle < s.cowl
        pillar = last - first < 0.03 and s.roof[0] < middle < s.roof[1]
        if last - first < 2.5 * _SEAM:
            row[_DOOR] = make.black
        if 0.96 < middle < 0.992:
            row[_LAMP] = make.head
        elif middle < 0.008:
            row[_LAMP] = make.tail
        if in_cabin and not pillar and middle > s.windows_to:
            row[_WINDOW] = make.glass
        windscreen = s.roof[1] < middle < s.cowl
        rear = s.rear_window + 0.01 < middle < s.roof[0] and kind != "van"
        if windscreen or rear:
            row[_TOP] = make.glass
        rows.append(np.r_[row, row[::-1]])
    return np.array(rows)


def _end_cap(ring: Floats, material: int, front: bool) -> Mesh:
    centre = ring.mean(axis=0)
    count = len(ring)
    i = np.arange(count - 1)
    a, b = (i, i + 1) if front else (i + 1, i)
    return flat_mesh(np.r_[ring, centre[None]], np.c_[a, b, np.full(count - 1, count)], material)


def _wheels(make: _Make, s: _Shape) -> Iterator[Mesh]:
    r = s.wheel_radius
    spokes = make.black if make.rng.random() < 0.7 else None
    one = wheel(r, _TYRE_WIDTH, make.tyre, make.rim, spokes=spokes)
    for share in s.axles:
        x = share * s.length - s.length / 2
        for side in (-1.0, 1.0):
            y = side * (s.width / 2 - _TYRE_WIDTH / 2 + 0.015)
            yield one.moved(x, y, r)
            yield _arch(x, side * (s.width / 2 + 0.004), r + 0.02, 1.1 * r, make.black)


def _arch(x: float, y: float, z: float, radius: float, material: int) -> Mesh:
    """Return the dark of a wheel arch: the upper half of a disc in a plane of constant y."""
    angles = np.linspace(-0.15, math.pi + 0.15, 13)
    ring = np.stack([x + radius * np.cos(angles), np.full(13, y), z + radius * np.sin(angles)], axis=1)
    i = np.arange(12)
    order = (i, i + 1) if y < 0 else (i + 1, i)
    return flat_mesh(np.r_[ring, [[x, y, z]]], np.c_[order[0], order[1], np.full(12, 13)], material)


def _lights(make: _Make, s: _Shape) -> Iterator[Mesh]:
    """Yield the third brake light and the fog lights; the others are painted on the body."""
    f, w = s.length / 2, s.width / 2
    yield box(0.04, 0.4, 0.03, make.tail, 0).moved(-f + 0.02, 0, s.boot * 0.95)
    for side in (-1.0, 1.0):
        yield box(0.05, 0.14, 0.07, make.head, 0).moved(f - 0.06, side * (w - 0.36), s.clearance + 0.2)


def _trims(make: _Make, s: _Shape, kind: VehicleKind) -> Iterator[Mesh]:
    f, w = s.length / 2, s.width / 2
    yield box(0.06, s.width * 0.5, 0.16, make.black, 0).moved(f - 0.015, 0, s.bonnet * 0.52)
    yield box(0.06, s.width * 0.62, 0.12, make.black, 0).moved(f - 0.02, 0, s.clearance + 0.12)
    yield box(0.06, s.width * 0.7, 0.14, make.black, 0).moved(-f + 0.02, 0, s.clearance + 0.16)
    for x, z in ((f + 0.014, s.bonnet * 0.5), (-f - 0.012, s.boot * 0.66)):
        yield box(0.03, 0.5, 0.11, make.plate, 0).moved(x, 0, z)
    for share in (_seams(s)[0] - 0.16, _seams(s)[1] + 0.035):
        for side in (-1.0, 1.0):
            yield box(0.17, 0.03, 0.03, make.trim, 0).moved(share * s.length - f, side * (w - 0.015), s.belt - 0.13)
    mirror_x = s.cowl * s.length - f - 0.25
    for side in (-1.0, 1.0):
        yield box(0.12, 0.2, 0.14, make.paint, 0, (0.8, 0.8)).moved(mirror_x, side * (w + 0.06), s.belt + 0.02)
    if kind in ("suv", "estate") and make.rng.random() < 0.6:
        for side in (-1.0, 1.0):
            rail = box((s.roof[1] - s.roof[0]) * s.length, 0.04, 0.05, make.black, 0)
            yield rail.moved((s.roof[0] + s.roof[1]) / 2 * s.length - f, side * w * 0.68, s.height + 0.01)
    if kind == "pickup":
        bed = (s.rear_window - 0.02) * s.length
        yield box(bed - 0.2, s.width - 0.3, 0.02, make.black, s.boot + 0.02).moved(-f + bed / 2 + 0.05)


# Large vehicles, of boxes.


def _truck(make: _Make) -> Iterator[Mesh]:
    length, width, height = make.rng.uniform(7.0, 12.5), 2.5, make.rng.uniform(3.2, 3.9)
    cab = make.rng.uniform(1.9, 2.3)
    yield from _cab(make, length, width, cab)
    cargo = make.rng.uniform(0.0, 1.0)
    colour: Colour = darker(tuple(make.rng.uniform(0.1, 0.7, 3).tolist()), 1.0)
    white: Colour = (0.62, 0.62, 0.6)
    box_length, deck = length - cab - 0.35, 1.1
    if cargo < 0.4:
        skin = sign_face(white, colour, box_length, height - deck)
    else:
        skin = corrugated(colour) if cargo < 0.6 else stripes(white, colour, 1.3) if cargo < 0.75 else plain(white, 0.5)
    body = box(box_length, width, height - deck, make.add(skin), 0)
    yield body.moved(-length / 2 + box_length / 2, 0, deck)
    yield from _chassis(make, length, width, (0.88, 0.3, 0.16) if length > 9.5 else (0.86, 0.2))


def _cab(make: _Make, length: float, width: float, cab: float) -> Iterator[Mesh]:
    top = make.rng.uniform(2.7, 3.4)
    x = length / 2 - cab / 2
    yield box(cab, width, 1.15, make.paint, 0.55).moved(x)
    yield box(cab, width, top - 1.7, make.paint, 1.7, (0.86, 0.94)).moved(x)
    slope = 0.07 * cab
    yield box(0.06, width * 0.86, 0.85, make.glass, 1.75, (1.0, 0.96)).moved(length / 2 - slope * 0.6)
    yield box(cab * 0.45, width + 0.01, 0.75, make.glass, 1.78, (0.9, 0.955)).moved(x + cab * 0.2)
    yield box(0.05, width * 0.8, 0.5, make.black, 0.75).moved(length / 2 + 0.01)
    for side in (-1.0, 1.0):
        yield box(0.06, 0.36, 0.2, make.head, 0.62).moved(length / 2 + 0.02, side * (width / 2 - 0.3))
        yield box(0.12, 0.22, 0.5, make.black, 1.9).moved(length / 2 - 0.15, side * (width / 2 + 0.16))
    yield box(0.04, 0.5, 0.12, make.plate, 0.52).moved(length / 2 + 0.02)


def _chassis(make: _Make, length: float, width: float, axles: tuple[float, ...]) -> Iterator[Mesh]:
    yield box(length - 0.6, width * 0.4, 0.35, make.black, 0.6)
    yield box(0.1, width * 0.95, 0.2, make.black, 0.5).moved(-length / 2 + 0.1)
    for side in (-1.0, 1.0):
        yield box(0.05, 0.3, 0.14, make.tail, 0.75).moved(-length / 2 - 0.01, side * (width / 2 - 0.3))
        for share in axles:
            yield wheel(0.5, 0.32, make.tyre, make.rim).moved(
                share * length - length / 2, side * (width / 2 - 0.18), 0.5
            )


def _tanker(make: _Make) -> Iterator[Mesh]:
    length, width = make.rng.uniform(8.0, 12.0), 2.5
    yield from _cab(make, length, width, 2.1)
    steel = make.add(metal((0.5, 0.5, 0.5)))
    tank = tube([(-length / 2 + 0.2, 0, 2.15), (length / 2 - 2.6, 0, 2.15)], [1.1, 1.1], steel, 18)
    yield tank.smoothed(40.0)
    yield from _chassis(make, length, width, (0.87, 0.3, 0.17))


def _bus(make: _Make) -> Iterator[Mesh]:
    length, width, height = make.rng.uniform(9.5, 13.0), 2.52, make.rng.uniform(2.95, 3.25)
    yield box(length, width, 1.0, make.paint, 0.32)
    yield box(length, width, height - 1.32, make.paint, 1.32, (0.99, 0.93))
    yield box(length * 0.93, width + 0.01, 0.95, make.glass, 1.4, (1.0, 0.962)).moved(-length * 0.01)
    yield box(0.06, width * 0.92, 1.5, make.glass, 1.1, (1.0, 0.94)).moved(length / 2 - 0.002)
    yield box(0.06, width * 0.8, 0.8, make.glass, 1.5).moved(-length / 2)
    number = make.add(lamp((0.5, 0.25, 0.02), 1.0))
    yield box(0.06, 1.4, 0.25, number, height - 0.42).moved(length / 2 - 0.03)
    for x in np.arange(-length * 0.43, length * 0.45, 1.5):
        yield box(0.08, width + 0.02, 0.98, make.paint, 1.39, (1.0, 0.962)).moved(x)
    for side in (-1.0, 1.0):
        yield box(0.06, 0.34, 0.18, make.head, 0.55).moved(length / 2 + 0.01, side * (width / 2 - 0.3))
        yield box(0.06, 0.2, 0.35, make.tail, 0.9).moved(-length / 2 - 0.01, side * (width / 2 - 0.2))
        for share in (0.8, 0.26):
            place = (share * length - length / 2, side * (width / 2 - 0.14), 0.48)
            yield wheel(0.48, 0.3, make.tyre, make.rim).moved(*place)
            x, y, z = place
            yield tube([(x, y - side * 0.1, z), (x, side * (width / 2 + 0.006), z)], [0.56] * 2, make.black, 16)


def _tractor(make: _Make) -> Iterator[Mesh]:
    yield box(1.7, 0.8, 0.8, make.paint, 0.8, (0.95, 0.8)).moved(0.9)
    yield box(1.4, 1.5, 1.5, make.glass, 1.1, (0.8, 0.85)).moved(-0.7)
    yield box(1.3, 1.4, 0.12, make.paint, 2.6).moved(-0.7)
    yield cylinder(0.05, 1.2, make.black, 6, 1.5).moved(1.2, 0.35)
    for side in (-1.0, 1.0):
        yield wheel(0.8, 0.5, make.tyre, make.rim, 18).moved(-0.9, side * 0.85, 0.8)
        yield wheel(0.48, 0.36, make.tyre, make.rim).moved(1.35, side * 0.75, 0.48)
        yield box(0.8, 0.5, 0.08, make.paint, 1.62).moved(-0.9, side * 0.85)


def _trailer(make: _Make) -> Iterator[Mesh]:
    length = make.rng.uniform(2.5, 6.0)
    yield box(length, 2.0, make.rng.uniform(0.5, 2.0), make.paint, 0.6)
    yield box(1.4, 0.1, 0.1, make.black, 0.5).moved(length / 2 + 0.6)
    for side in (-1.0, 1.0):
        yield wheel(0.32, 0.22, make.tyre, make.rim).moved(-0.2, side * 1.0, 0.32)


_LARGE = {"truck": _truck, "tanker": _tanker, "bus": _bus, "tractor": _tractor, "trailer": _trailer}
