# SPDX-License-Identifier: Apache-2.0
"""Materials of the things of a street, from a few words and colours."""

from __future__ import annotations

import numpy as np

from cvcdepth_core.worlds.description import BarrierKind, Colour, Road, SurfaceKind
from cvcdepth_core.worlds.surfaces.materials import Layer, Material, Pattern
from cvcdepth_core.worlds.surfaces.noise import Noise

_GROUNDS: dict[SurfaceKind, Material] = {
    "asphalt": Material((0, 0, 0), coarse=Layer(Noise.CLOUDY, 4.0, 0.09), fine=Layer(Noise.ROUGH, 60.0, 0.1)),
    "concrete": Material(
        (0, 0, 0),
        pattern=Pattern.SLABS,
        coarse=Layer(Noise.CLOUDY, 5.0, 0.07),
        fine=Layer(Noise.ROUGH, 50.0, 0.06),
        parameters=(3.0, 3.0, 0.02, 0.0),
    ),
    "cobbles": Material(
        (0, 0, 0),
        pattern=Pattern.SLABS,
        coarse=Layer(Noise.CLOUDY, 4.0, 0.12),
        fine=Layer(Noise.PEBBLES, 90.0, 0.16),
        parameters=(0.17, 0.11, 0.016, 0.5),
    ),
    "slabs": Material(
        (0, 0, 0),
        pattern=Pattern.SLABS,
        coarse=Layer(Noise.CLOUDY, 5.0, 0.08),
        fine=Layer(Noise.ROUGH, 80.0, 0.07),
        parameters=(0.5, 0.5, 0.012, 0.5),
    ),
    "gravel": Material((0, 0, 0), coarse=Layer(Noise.CLOUDY, 5.0, 0.12), fine=Layer(Noise.PEBBLES, 420.0, 0.2)),
    "dirt": Material(
        (0, 0, 0), pattern=Pattern.MOTTLED, coarse=Layer(Noise.CLOUDY, 4.0, 0.2), fine=Layer(Noise.ROUGH, 60.0, 0.16)
    ),
    "grass": Material(
        (0, 0, 0), pattern=Pattern.MOTTLED, coarse=Layer(Noise.CLOUDY, 6.0, 0.18), fine=Layer(Noise.ROUGH, 80.0, 0.26)
    ),
    "sand": Material((0, 0, 0), coarse=Layer(Noise.CLOUDY, 5.0, 0.1), fine=Layer(Noise.GRAIN, 90.0, 0.06)),
    "snow": Material((0, 0, 0), coarse=Layer(Noise.SMOOTH, 8.0, 0.05), fine=Layer(Noise.ROUGH, 30.0, 0.03)),
    "planks": Material(
        (0, 0, 0),
        pattern=Pattern.PLANKS,
        coarse=Layer(Noise.STREAKS, 30.0, 0.14),
        fine=Layer(Noise.ROUGH, 90.0, 0.05),
        parameters=(0.14, 0.0),
    ),
}
_RIPPLE = 0.05
_SEALED = ("asphalt", "concrete", "cobbles", "slabs", "planks")


def ground_material(kind: SurfaceKind, colour: Colour, second: Colour, wet: float = 0.0) -> Material:
    """Ground that is walked or driven on; sealed ones shine when they are wet."""
    if wet and kind in _SEALED:
        colour = darker(colour, 1.0 - 0.45 * wet)
    gloss = 0.75 * wet if kind in _SEALED else 0.0
    return _recoloured(_GROUNDS[kind], colour, second, gloss)


def road_material(road: Road, wet: float) -> Material:
    """Surface of a carriageway, with the tracks of its lanes."""
    if road.surface not in ("asphalt", "concrete"):
        return ground_material(road.surface, road.colour, darker(road.colour, 0.75), wet)
    base = _GROUNDS["asphalt"]
    first = road.lane_width / 2 if road.lanes % 2 == 0 else 0.0
    colour = darker(road.colour, 1.0 - 0.45 * wet)
    return Material(
        colour,
        pattern=Pattern.ROAD,
        coarse=base.coarse,
        fine=base.fine,
        gloss=0.75 * wet,
        ripple=_RIPPLE,
        parameters=(road.lane_width if road.lanes else 0.0, first, road.wear),
    )


def marking(colour: Colour, under: Colour, wear: float) -> Material:
    """Paint on a road, through which the road shows."""
    coarse, fine = Layer(Noise.CLOUDY, 12.0, 0.08), Layer(Noise.ROUGH, 90.0, 0.12)
    return Material(colour, under, Pattern.MARKING, coarse, fine, parameters=(wear,))


def plain(colour: Colour, rough: float = 1.0, gloss: float = 0.0) -> Material:
    """One colour, a little uneven."""
    coarse, fine = Layer(Noise.CLOUDY, 9.0, 0.07 * rough), Layer(Noise.ROUGH, 70.0, 0.05 * rough)
    return Material(colour, coarse=coarse, fine=fine, gloss=gloss)


def stone(colour: Colour) -> Material:
    """Concrete and plaster with stains."""
    return Material(colour, coarse=Layer(Noise.CLOUDY, 12.0, 0.1), fine=Layer(Noise.ROUGH, 60.0, 0.07))


def bricks(colour: Colour) -> Material:
    """Masonry."""
    mortar = lighter(darker(colour, 0.6), 0.16)
    coarse, fine = Layer(Noise.CLOUDY, 6.0, 0.1), Layer(Noise.ROUGH, 90.0, 0.1)
    return Material(colour, mortar, Pattern.BRICK, coarse, fine, parameters=(0.24, 0.077, 0.011))


def wood(colour: Colour, upright: bool = True, width: float = 0.12) -> Material:
    """Boards."""
    coarse, fine = Layer(Noise.STREAKS, 40.0, 0.14), Layer(Noise.ROUGH, 90.0, 0.06)
    return Material(colour, pattern=Pattern.PLANKS, coarse=coarse, fine=fine, parameters=(width, float(upright)))


def bark(colour: Colour) -> Material:
    """Trunks and branches."""
    return Material(colour, coarse=Layer(Noise.STREAKS, 60.0, 0.22), fine=Layer(Noise.ROUGH, 90.0, 0.15))


def leaves(colour: Colour) -> Material:
    """Crowns and hedges."""
    # Cells of 7 cm with dark borders: close by, the triangles that carry them look like many leaves.
    coarse, fine = Layer(Noise.CLOUDY, 20.0, 0.2), Layer(Noise.PEBBLES, 230.0, 0.3)
    return Material(lighter(colour, 0.015), darker(colour, 0.6), Pattern.MOTTLED, coarse, fine, leafy=1.0)


def paint(colour: Colour) -> Material:
    """Car body."""
    return Material(colour, coarse=Layer(Noise.SMOOTH, 20.0, 0.015), fine=Layer(Noise.ROUGH, 40.0, 0.012), gloss=0.75)


def window(tint: float = 0.02) -> Material:
    """Dark glass of vehicles."""
    still = Layer(Noise.SMOOTH, 8.0, 0.1)
    return Material((tint, tint, tint * 1.1), coarse=still, fine=still, gloss=1.0)


def metal(colour: Colour) -> Material:
    """Galvanised or painted steel."""
    return Material(colour, coarse=Layer(Noise.CLOUDY, 15.0, 0.06), fine=Layer(Noise.ROUGH, 60.0, 0.04), gloss=0.25)


def rubber() -> Material:
    """Tyres and trims."""
    return plain((0.018, 0.018, 0.019))


def lamp(colour: Colour, emission: float) -> Material:
    """Something that shines by itself."""
    return Material(colour, emission=emission, gloss=0.4)


def corrugated(colour: Colour) -> Material:
    """Sheet metal with a period of 0.25 m."""
    return Material(
        colour, darker(colour, 0.72), Pattern.STRIPES, Layer(Noise.CLOUDY, 8.0, 0.08), Layer(Noise.STREAKS, 40.0, 0.05),
        parameters=(0.25, 1.0, 0.5, 0.0),
    )  # fmt: skip


def roof_tiles(colour: Colour) -> Material:
    """Rows of tiles."""
    coarse, fine = Layer(Noise.CLOUDY, 7.0, 0.12), Layer(Noise.ROUGH, 60.0, 0.1)
    return Material(colour, darker(colour, 0.4), Pattern.BRICK, coarse, fine, parameters=(0.25, 0.33, 0.02))


def sign_face(colour: Colour, second: Colour, width: float, height: float) -> Material:
    """Board with a border and lines that look like writing."""
    still = Layer(Noise.CLOUDY, 10.0, 0.04)
    return Material(colour, second, Pattern.SIGN, still, still, parameters=(width, height, 0.04 * min(width, height)))


def stripes(first: Colour, second: Colour, period: float, upright: bool = False, slant: float = 0.0) -> Material:
    """Two colours in turn."""
    return Material(first, second, Pattern.STRIPES, parameters=(period, float(upright), 0.5, slant))


def barrier_material(kind: BarrierKind, colour: Colour) -> Material:
    """Return what a wall, fence or hedge is made of."""
    if kind == "brick_wall":
        return bricks(colour)
    if kind == "hedge":
        return leaves(colour)
    if kind == "fence":
        return wood(colour)
    return metal(colour) if kind in ("railing", "mesh", "guard_rail") else stone(colour)


def darker(colour: Colour, factor: float) -> Colour:
    """Return the colour times a factor."""
    r, g, b = (np.clip(np.array(colour) * factor, 0.0, 0.95)).tolist()
    return r, g, b


def lighter(colour: Colour, amount: float) -> Colour:
    """Return the colour with some white added."""
    r, g, b = (np.clip(np.array(colour) + amount, 0.0, 0.95)).tolist()
    return r, g, b


def _recoloured(material: Material, colour: Colour, second: Colour, gloss: float) -> Material:
    m = material
    return Material(colour, second, m.pattern, m.coarse, m.fine, gloss, _RIPPLE, parameters=m.parameters)
