# SPDX-License-Identifier: Apache-2.0
"""What stands in streets: lamps, poles, signs, bins and much more. The front is towards -x, where drivers come from."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from cvcdepth_core.worlds.description import Colour, Furniture, FurnitureKind
from cvcdepth_core.worlds.shapes.meshes import Mesh, box, cylinder, joined, prism, sphere, sphere_vertices, tube
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.materials import Material
from cvcdepth_core.worlds.surfaces.palette import (
    corrugated,
    darker,
    lamp,
    leaves,
    metal,
    paint,
    plain,
    sign_face,
    stone,
    stripes,
    window,
    wood,
)

_HEIGHTS: dict[FurnitureKind, float] = {
    "lamp": 7.0, "pole": 5.0, "power_pole": 9.0, "sign": 2.5, "traffic_light": 3.4, "bollard": 0.9, "bin": 0.9,
    "bench": 0.45, "cabinet": 1.2, "hydrant": 0.7, "shelter": 2.5, "billboard": 6.0, "cone": 0.7, "barrel": 1.0,
    "container": 2.6, "planter": 0.6, "rock": 0.6, "pallets": 1.2, "skip": 1.4, "parasol": 2.4, "post_box": 1.3,
    "crate": 0.8,
}  # fmt: skip
LAMP_ARM = 1.6
"""Metres that a street lamp's head reaches over the road, to its left."""


def build_furniture(site: Site) -> None:
    """Add all furniture."""
    for item in site.spec.furniture:
        make = _Make(site, item)
        site.stand(item.kind, joined(list(_MAKERS[item.kind](make))), item)


def furniture_height(item: Furniture) -> float:
    """Return the height that is given, else the usual one."""
    return item.height or _HEIGHTS[item.kind]


class _Make:
    def __init__(self, site: Site, item: Furniture) -> None:
        self._site = site
        self.rng = np.random.default_rng([site.spec.seed, item.seed, 29])
        self.h = furniture_height(item)
        self.colour = item.colour
        self.night = site.spec.sky.weather in ("dusk", "night")
        self.body = self.add(metal(item.colour))
        self.dark = self.add(plain((0.03, 0.03, 0.032), 0.6))

    def add(self, material: Material) -> int:
        return self._site.material(material)

    def bright(self) -> Colour:
        """Return A strong colour."""
        choices = ((0.55, 0.03, 0.03), (0.02, 0.09, 0.4), (0.03, 0.3, 0.09), (0.6, 0.42, 0.02), (0.6, 0.6, 0.58))
        return choices[int(self.rng.integers(len(choices)))]


def _lamp(m: _Make) -> Iterator[Mesh]:
    head = m.add(lamp((0.7, 0.68, 0.6), 14.0 if m.night else 0.0))
    yield cylinder(0.1, 0.8, m.body, 8)
    bend = [(0, 0, 0.7), (0, 0, m.h - 0.6), (0, 0.25, m.h - 0.1), (0, LAMP_ARM, m.h)]
    yield tube(bend, [0.075, 0.055, 0.045, 0.035], m.body, 8)
    yield box(0.22, 0.7, 0.12, m.body, m.h - 0.05).moved(y=LAMP_ARM + 0.2)
    yield box(0.18, 0.5, 0.04, head, m.h - 0.085).moved(y=LAMP_ARM + 0.2)


def _pole(m: _Make) -> Iterator[Mesh]:
    yield cylinder(0.06, m.h, m.body, 8, taper=0.8)


def _power_pole(m: _Make) -> Iterator[Mesh]:
    timber = m.add(wood((0.13, 0.1, 0.07)))
    yield cylinder(0.16, m.h + 0.5, timber, 9, taper=0.7)
    for z in (m.h, m.h - 0.9)[: int(m.rng.integers(1, 3))]:
        yield box(0.12, 2.0, 0.12, timber, z - 0.15)
        for y in (-0.85, -0.4, 0.4, 0.85):
            yield cylinder(0.04, 0.14, m.dark, 6, z - 0.03).moved(y=y)
    if m.rng.random() < 0.4:
        yield cylinder(0.24, 0.7, m.body, 10, m.h - 1.9).moved(0.32, 0)


def _sign(m: _Make) -> Iterator[Mesh]:
    yield cylinder(0.035, m.h, m.body, 6)
    for number in range(int(m.rng.integers(1, 3))):
        z, choice, size = m.h - 0.35 - 0.75 * number, m.rng.random(), m.rng.uniform(0.28, 0.4)
        if choice < 0.4:
            face = m.add(sign_face((0.6, 0.6, 0.6), m.bright(), 2 * size, 2 * size))
            yield _plate(12, size, face, m.body).moved(-0.05, 0, z)
        elif choice < 0.6:
            face = m.add(sign_face((0.65, 0.64, 0.6), (0.55, 0.03, 0.03), 2 * size, 2 * size))
            yield _plate(3, size * 1.2, face, m.body).moved(-0.05, 0, z)
        else:
            wide, high = m.rng.uniform(0.3, 1.0), m.rng.uniform(0.25, 0.7)
            face = m.add(sign_face(m.bright(), (0.62, 0.62, 0.6), wide, high))
            yield box(0.03, wide, high, face).moved(-0.06, 0, z - high / 2)


def _plate(corners: int, radius: float, face: int, back: int) -> Mesh:
    """Return A thin regular polygon that faces -x."""
    angles = np.linspace(0, 2 * math.pi, corners, endpoint=False) + math.pi / 2
    outline = [(radius * math.cos(a), radius * math.sin(a)) for a in angles]
    upright = prism(outline, 0.0, 0.02, back, cap=face)
    # Its upper face, towards z, is turned to -x; x becomes -y.
    turn = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    # The texture of signs begins at their lower edge.
    return replace(upright.transformed(turn), uv=upright.uv + np.array([0.0, radius], np.float32))


def _traffic_light(m: _Make) -> Iterator[Mesh]:
    yield cylinder(0.06, m.h, m.body, 8)
    heads = [(0.0, m.h - 0.95)]
    if m.rng.random() < 0.5:
        reach = m.rng.uniform(2.5, 5.5)
        top = m.h + 2.0
        yield tube(
            [(0, 0, m.h - 0.1), (0, 0.0, top - 0.4), (0, 0.6, top), (0, reach, top)],
            [0.06, 0.06, 0.05, 0.04],
            m.body,
            7,
        )
        heads.append((reach, top - 0.55))
    on = int(m.rng.integers(3))
    colours = ((0.6, 0.02, 0.02), (0.6, 0.32, 0.02), (0.03, 0.5, 0.15))
    for y, z in heads:
        yield box(0.2, 0.3, 0.95, m.dark, z).moved(-0.12, y)
        for i, colour in enumerate(colours):
            face = m.add(lamp(colour if i == on else darker(colour, 0.12), 3.0 if i == on else 0.0))
            yield _plate(10, 0.1, face, m.dark).moved(-0.235, y, z + 0.78 - 0.29 * i)


def _bollard(m: _Make) -> Iterator[Mesh]:
    yield cylinder(0.08, m.h, m.body, 10)
    band = m.add(stripes((0.6, 0.05, 0.03), (0.7, 0.7, 0.7), 0.3))
    yield cylinder(0.083, 0.3, band, 10, m.h - 0.35)


def _bin(m: _Make) -> Iterator[Mesh]:
    if m.rng.random() < 0.5:
        yield cylinder(0.24, m.h, m.body, 12, 0.05)
        yield cylinder(0.26, 0.08, m.dark, 12, m.h)
    else:
        skin = m.add(plain(m.bright() if m.rng.random() < 0.6 else m.colour, 0.6, 0.1))
        yield box(0.55, 0.6, m.h, skin, 0.08, (1.15, 1.1))
        yield box(0.68, 0.7, 0.08, skin, m.h + 0.06)
        for y in (-0.25, 0.25):
            yield cylinder(0.1, 0.05, m.dark, 8).moved(0.28, y)


def _bench(m: _Make) -> Iterator[Mesh]:
    timber = m.add(wood((0.22, 0.14, 0.07)))
    for x in (-0.15, 0.0, 0.15):
        yield box(0.12, 1.7, 0.04, timber, m.h).moved(x)
    for z in (0.65, 0.8):
        yield box(0.04, 1.7, 0.11, timber, z).moved(0.25)
    for y in (-0.7, 0.7):
        yield box(0.45, 0.06, m.h, m.body, 0).moved(0, y)
        yield box(0.05, 0.06, 0.9, m.body, 0).moved(0.27, y)


def _cabinet(m: _Make) -> Iterator[Mesh]:
    width = m.rng.uniform(0.5, 1.4)
    yield box(0.4, width, m.h, m.body)
    yield box(0.46, width + 0.06, 0.05, m.dark, m.h)


def _hydrant(m: _Make) -> Iterator[Mesh]:
    red = m.add(plain((0.5, 0.05, 0.03), 0.5, 0.1))
    yield cylinder(0.11, m.h * 0.8, red, 10)
    yield sphere(0.12, red, 1).moved(0, 0, m.h * 0.85)
    yield tube([(0, -0.2, m.h * 0.6), (0, 0.2, m.h * 0.6)], [0.06, 0.06], red, 8)


def _shelter(m: _Make) -> Iterator[Mesh]:
    """Bus shelter, open to -y."""
    glass = m.add(window(0.12))
    advert = m.add(sign_face(m.bright(), (0.6, 0.6, 0.6), 1.4, 1.8))
    yield box(3.6, 1.5, 0.1, m.body, m.h - 0.1)
    for x in (-1.7, 1.7):
        for y in (-0.6, 0.65):
            yield box(0.08, 0.08, m.h - 0.1, m.body).moved(x, y)
    yield box(3.4, 0.03, m.h - 0.6, glass, 0.3).moved(0, 0.65)
    yield box(0.12, 1.2, 1.9, advert).moved(1.7, 0, 0.3)
    yield box(2.4, 0.35, 0.05, m.body, 0.45).moved(-0.3, 0.4)


def _billboard(m: _Make) -> Iterator[Mesh]:
    wide, high = m.rng.uniform(3.5, 9.0), m.rng.uniform(2.2, 3.8)
    face = m.add(sign_face(m.bright(), (0.7, 0.7, 0.68), wide, high))
    yield box(0.3, wide, high, face).moved(0, 0, m.h - high)
    for y in (-wide / 3, wide / 3):
        yield cylinder(0.16, m.h - high, m.body, 8).moved(0.1, y)


def _cone(m: _Make) -> Iterator[Mesh]:
    skin = m.add(stripes((0.75, 0.14, 0.02), (0.72, 0.72, 0.72), 0.36))
    yield cylinder(0.16, m.h - 0.04, skin, 10, 0.04, 0.2)
    yield box(0.42, 0.42, 0.05, m.dark)


def _barrel(m: _Make) -> Iterator[Mesh]:
    skin = m.add(stripes((0.75, 0.16, 0.02), (0.72, 0.72, 0.72), 0.4))
    yield cylinder(0.28, m.h, skin, 12, taper=0.9)


def _container(m: _Make) -> Iterator[Mesh]:
    skin = m.add(corrugated(darker(tuple(m.rng.uniform(0.03, 0.45, 3).tolist()), 1.0)))
    length = 12.2 if m.rng.random() < 0.5 else 6.1
    for level in range(max(1, round(m.h / 2.6))):
        yield box(length, 2.44, 2.58, skin, 2.6 * level)


def _planter(m: _Make) -> Iterator[Mesh]:
    tub = m.add(stone((0.32, 0.3, 0.28)))
    green = m.add(leaves((0.07, 0.13, 0.03)))
    yield box(1.0, 1.0, m.h, tub)
    rough = 1.0 + 0.2 * m.rng.normal(size=len(sphere_vertices(2)))
    yield sphere(0.5, green, 2, rough).scaled(1.0, 1.0, m.rng.uniform(0.7, 1.6)).moved(0, 0, m.h + 0.25)


def _rock(m: _Make) -> Iterator[Mesh]:
    rough = 1.0 + 0.13 * m.rng.normal(size=len(sphere_vertices(2)))
    skin = m.add(stone((0.22, 0.21, 0.19)))
    yield (
        sphere(m.h * 0.7, skin, 2, rough)
        .scaled(float(m.rng.uniform(0.8, 1.3)), float(m.rng.uniform(0.8, 1.3)), 0.9)
        .moved(0, 0, m.h * 0.35)
    )


def _pallets(m: _Make) -> Iterator[Mesh]:
    timber = m.add(wood((0.3, 0.22, 0.13), upright=False))
    for i in range(max(1, round(m.h / 0.16))):
        yield box(1.2, 0.8, 0.03, timber, 0.16 * i + 0.12).moved(*m.rng.normal(0, 0.02, 2).tolist())
        for y in (-0.35, 0, 0.35):
            yield box(1.2, 0.1, 0.11, timber, 0.16 * i).moved(0, y)


def _skip(m: _Make) -> Iterator[Mesh]:
    skin = m.add(plain(m.bright(), 1.5))
    yield box(2.6, 1.6, m.h, skin, 0.0, (1.35, 1.1))


def _parasol(m: _Make) -> Iterator[Mesh]:
    cloth = m.add(plain(m.bright(), 0.6))
    timber = m.add(wood((0.2, 0.13, 0.07)))
    yield cylinder(0.03, m.h, timber, 6)
    yield cylinder(1.5, 0.5, cloth, 8, m.h - 0.5, 0.03)
    yield cylinder(0.4, 0.03, timber, 10, 0.7)
    yield cylinder(0.03, 0.7, timber, 6)
    for angle in (0.5, 2.6, 4.4):
        x, y = 0.75 * math.cos(angle), 0.75 * math.sin(angle)
        yield box(0.4, 0.4, 0.04, timber, 0.43).moved(x, y)
        yield box(0.35, 0.35, 0.43, timber).moved(x, y)


def _post_box(m: _Make) -> Iterator[Mesh]:
    skin = m.add(paint(m.bright()))
    yield box(0.45, 0.5, m.h, skin)
    yield box(0.03, 0.35, 0.05, m.dark, m.h * 0.75).moved(-0.225)


def _crate(m: _Make) -> Iterator[Mesh]:
    size = m.rng.uniform(0.4, 1.2, 2)
    skin = m.add(wood((0.3, 0.22, 0.13)) if m.rng.random() < 0.5 else plain((0.35, 0.26, 0.16)))
    yield box(float(size[0]), float(size[1]), m.h, skin)


_MAKERS: dict[FurnitureKind, Callable[[_Make], Iterator[Mesh]]] = {
    "lamp": _lamp,
    "pole": _pole,
    "power_pole": _power_pole,
    "sign": _sign,
    "traffic_light": _traffic_light,
    "bollard": _bollard,
    "bin": _bin,
    "bench": _bench,
    "cabinet": _cabinet,
    "hydrant": _hydrant,
    "shelter": _shelter,
    "billboard": _billboard,
    "cone": _cone,
    "barrel": _barrel,
    "container": _container,
    "planter": _planter,
    "rock": _rock,
    "pallets": _pallets,
    "skip": _skip,
    "parasol": _parasol,
    "post_box": _post_box,
    "crate": _crate,
}
