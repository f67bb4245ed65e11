# SPDX-License-Identifier: Apache-2.0
"""Bridges, tunnels, parking decks, gantries, cranes and towers. x along the road."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from cvcdepth_core.worlds.description import Structure, StructureKind
from cvcdepth_core.worlds.shapes.meshes import Mesh, box, cylinder, joined, tube
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.palette import darker, lamp, metal, plain, sign_face, stone, stripes

CEILING_LAMPS = {"tunnel": 8.0, "deck": 7.0}
"""Metres between the lamps under the ceilings of these."""


def build_structures(site: Site) -> None:
    """Add all structures."""
    for structure in site.spec.structures:
        make = _Make(site, structure)
        site.stand(structure.kind, joined(list(_MAKERS[structure.kind](make))), structure)


def ceiling_lamps(structure: Structure) -> list[tuple[float, float, float]]:
    """Where lamps hang, in the structure's frame."""
    step = CEILING_LAMPS.get(structure.kind)
    if step is None:
        return []
    length, width, height = structure.size
    rows = (
        [-width / 4, width / 4]
        if structure.kind == "tunnel"
        else np.arange(-width / 2 + 4, width / 2 - 2, step).tolist()
    )
    return [(float(x), y, height - 0.2) for x in np.arange(-length / 2 + 2, length / 2 - 1, step) for y in rows]


class _Make:
    def __init__(self, site: Site, structure: Structure) -> None:
        self.site = site
        self.spec = structure
        self.rng = np.random.default_rng([site.spec.seed, structure.seed, 31])
        self.length, self.width, self.height = structure.size
        self.concrete = site.material(stone(structure.colour))
        self.dark = site.material(stone(darker(structure.colour, 0.6)))
        self.steel = site.material(metal((0.3, 0.3, 0.31)))


def _bridge(m: _Make) -> Iterator[Mesh]:
    """Build what runs across: its deck is `length` wide along the road below, and `width` long."""
    yield box(m.length, m.width, 1.1, m.concrete, m.height)
    for x in (-m.length / 2 + 0.15, m.length / 2 - 0.15):
        yield box(0.3, m.width, 1.0, m.dark, m.height + 1.1).moved(x)
    for y in (-m.width / 2 + 3.0, m.width / 2 - 3.0):
        yield box(m.length, 6.0, m.height + 3.0, m.concrete, -3.0).moved(0, y)
    if m.rng.random() < 0.5:
        for x in np.arange(-m.length / 2 + 1, m.length / 2, 3.5):
            yield cylinder(0.45, m.height + 1, m.concrete, 12, -1).moved(x, -m.width / 4 + 2.5)
            yield cylinder(0.45, m.height + 1, m.concrete, 12, -1).moved(x, m.width / 4 - 2.5)


def _tunnel(m: _Make) -> Iterator[Mesh]:
    light = m.site.material(lamp((0.7, 0.68, 0.62), 10.0))
    tiles = m.site.material(plain(darker(m.spec.colour, 1.4), 0.8))
    for side in (-1.0, 1.0):
        y = side * (m.width / 2 + 0.4)
        yield box(m.length, 0.8, m.height + 3.5, m.concrete, -3.0).moved(0, y)
        yield box(m.length - 0.4, 0.02, 2.6, tiles, 0.4).moved(0, y - side * 0.41)
    yield box(m.length, m.width + 1.6, 2.5, m.concrete, m.height)
    for x, y, z in ceiling_lamps(m.spec):
        yield box(1.4, 0.25, 0.08, light, z + 0.1).moved(x, y)


def _deck(m: _Make) -> Iterator[Mesh]:
    """One storey of a parking deck, and the one above."""
    light = m.site.material(lamp((0.7, 0.7, 0.66), 8.0))
    yield box(m.length, m.width, 0.35, m.concrete, m.height)
    yield box(m.length, m.width, 0.35, m.concrete, 2 * m.height + 0.35)
    band = m.site.material(stripes((0.6, 0.45, 0.02), (0.02, 0.02, 0.02), 0.3, slant=1.0))
    for x in np.arange(-m.length / 2 + 0.5, m.length / 2, 7.5):
        for y in np.arange(-m.width / 2 + 0.5, m.width / 2, 7.5):
            yield box(0.45, 0.45, 2 * m.height + 1.5, m.concrete, -1.0).moved(x, y)
            yield box(0.47, 0.47, 0.9, band, 0.1).moved(x, y)
    for x in np.arange(-m.length / 2 + 4, m.length / 2, 7.5):
        yield box(0.3, m.width, 0.4, m.concrete, m.height - 0.4).moved(x)
    for side in (-1.0, 1.0):
        yield box(m.length, 0.2, 1.0, m.concrete, m.height + 0.35).moved(0, side * m.width / 2)
        yield box(m.length, 0.2, 1.0, m.concrete, -0.05).moved(0, side * m.width / 2)
    for x, y, z in ceiling_lamps(m.spec):
        yield box(1.2, 0.15, 0.06, light, z + 0.1).moved(x, y)


def _gantry(m: _Make) -> Iterator[Mesh]:
    for side in (-1.0, 1.0):
        yield box(0.35, 0.35, m.height + 1.4, m.steel, -0.2).moved(0, side * m.width / 2)
    yield box(0.4, m.width, 0.5, m.steel, m.height + 0.7)
    face = m.site.material(sign_face((0.02, 0.1, 0.32), (0.65, 0.65, 0.65), 3.4, 2.0))
    for y in np.arange(-m.width / 2 + 2.6, m.width / 2 - 2.0, 4.4):
        yield box(0.15, 3.4, 2.0, face).moved(-0.3, y, m.height)


def _crane(m: _Make) -> Iterator[Mesh]:
    yellow = m.site.material(plain((0.6, 0.42, 0.03), 1.0))
    for x, y in ((-0.8, -0.8), (0.8, -0.8), (0.8, 0.8), (-0.8, 0.8)):
        yield box(0.14, 0.14, m.height, yellow).moved(x, y)
    for number, z in enumerate(np.arange(0, m.height - 2, 2.0)):
        side = -0.8 if number % 2 else 0.8
        yield tube([(-0.8, side, z), (0.8, side, z + 2)], [0.05, 0.05], yellow, 4)
        yield tube([(side, -0.8, z), (side, 0.8, z + 2)], [0.05, 0.05], yellow, 4)
    yield box(m.length, 0.15, 0.15, yellow, m.height).moved(m.length * 0.25)
    yield box(m.length, 0.15, 0.15, yellow, m.height + 1.2).moved(m.length * 0.25)
    for x in np.arange(-m.length * 0.25, m.length * 0.75, 1.5):
        yield tube([(x, 0, m.height), (x + 0.75, 0, m.height + 1.2)], [0.05, 0.05], yellow, 4)
    yield box(2.5, 1.6, 1.5, m.concrete, m.height - 0.6).moved(-m.length * 0.22)


def _tower(m: _Make) -> Iterator[Mesh]:
    """Return A silo or water tower."""
    radius = min(m.length, m.width) / 2
    yield cylinder(radius, m.height, m.concrete, 24)
    yield cylinder(radius * 1.02, 0.4, m.dark, 24, m.height * 0.5)
    yield cylinder(radius, radius * 0.5, m.steel, 24, m.height, 0.1)


_MAKERS: dict[StructureKind, Callable[[_Make], Iterator[Mesh]]] = {
    "bridge": _bridge,
    "tunnel": _tunnel,
    "deck": _deck,
    "gantry": _gantry,
    "crane": _crane,
    "tower": _tower,
}
