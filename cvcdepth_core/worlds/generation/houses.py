# SPDX-License-Identifier: Apache-2.0
"""Buildings beside roads, and large ones farther off."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cvcdepth_core.worlds.description import Building, Colour, WallKind
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.generation.kinds import Kind
from cvcdepth_core.worlds.generation.layout import Layout

_COLOURS = {
    "plaster": "plaster",
    "brick": "brick",
    "panels": "concrete",
    "boards": "wood",
    "metal": "metal",
    "glass": "slate",
}


def houses(kind: Kind, layout: Layout, dice: Dice) -> tuple[Building, ...]:
    """Rows of buildings along both sides of every road."""
    rows = [
        building
        for road in range(len(layout.corridors))
        for side in (1.0, -1.0)
        for building in _row(kind, layout, dice, road, side)
    ]
    return tuple(rows)


def _row(kind: Kind, layout: Layout, dice: Dice, road: int, side: float) -> Iterator[Building]:
    first, last = layout.span(road)
    setback = dice.between(*kind.setback)
    typical = dice.scale(*kind.heights)
    s = first
    while s < last:
        length = dice.between(*kind.lengths, digits=1)
        depth = dice.between(8.0, 16.0, 1) if kind.lengths[1] < 35 else dice.between(12, 30, 1)
        own = setback + (dice.between(0, 0.25 * kind.setback[1]) if dice.chance(0.3) else 0.0)
        lateral = round(side * (layout.edge(side, road) + own + 0.15 + depth / 2), 2)
        at = (round(s + length / 2, 2), lateral)
        if dice.chance(kind.buildings) and layout.take(at, (length, depth), 0.0, road, 0.1, pavements=True):
            height = round(max(2.7, typical * dice.scale(0.65, 1.5)), 1)
            turn = 180.0 if side > 0 else 0.0
            # The front of a building looks to -y: towards the road on its left side, turned on its right.
            yield building(kind, dice, at, (length, depth, height), turn + 180.0, road)
        s += length + (dice.between(*kind.gap, digits=1) if kind.gap[1] else 0.02)


def building(
    kind: Kind, dice: Dice, at: tuple[float, float], size: tuple[float, float, float], yaw: float, road: int = 0
) -> Building:
    """Return A building of the kind of place."""
    wall: WallKind = dice.weighted(kind.walls)
    tall, height = size[2] > 9, size[2]
    pitched = (not tall and dice.chance(kind.pitched)) or dice.chance(kind.pitched * 0.3)
    return Building(
        at=at,
        yaw=yaw % 360,
        road=road,
        size=size,
        wall=wall,
        colour=_wall_colour(dice, wall),
        trim=dice.natural("concrete"),
        glass=dice.natural("slate", 0.6) if dice.chance(0.8) else dice.any_colour(0.5, 0.02, 0.12),
        seed=dice.seed(),
        balconies=wall in ("plaster", "panels", "brick") and tall and dice.chance(0.3),
        **_storeys(kind, dice, wall, height),
        **_roof(dice, wall, min(size[0], size[1]), pitched),
    )


def _wall_colour(dice: Dice, wall: WallKind) -> Colour:
    return dice.any_colour(0.6, 0.1, 0.7) if dice.chance(0.22) else dice.natural(_COLOURS[wall])


def _storeys(kind: Kind, dice: Dice, wall: WallKind, height: float) -> dict[str, Any]:
    hall = kind.lengths[1] > 35
    storey = dice.between(2.7, 4.2) if not hall else dice.between(3.5, 6.0)
    if wall == "glass":
        return {"windows": "curtain", "storey": storey, "bay": dice.between(1.5, 4.0), "window": (0.9, 0.9)}
    style = dice.weighted({"single": 0.4, "divided": 0.4, "bands": 0.2 if height > 5 else 0.05})
    shops = {"shop": kind.shops, "arcade": 0.25 * kind.shops, "same": 1.0 - kind.shops}
    floors = {"gates": 0.5, "blind": 0.25, "same": 0.25} if hall else shops | {"gates": 0.12, "blind": 0.05}
    return {
        "windows": style,
        "storey": storey,
        "bay": dice.between(1.8, 5.0),
        "window": (dice.between(0.25, 0.8), dice.between(0.3, 0.7)),
        "ground_floor": dice.weighted(floors) if height > 4.5 or hall else "same",
    }


def _roof(dice: Dice, wall: WallKind, width: float, pitched: bool) -> dict[str, Any]:
    if wall == "metal" and dice.chance(0.3):
        return {"roof": "saw", "roof_height": dice.between(1.5, 3.0), "roof_colour": dice.natural("metal")}
    if not pitched:
        return {"roof": "flat", "roof_height": dice.between(0.15, 1.1), "roof_colour": dice.natural("slate")}
    roof = dice.weighted({"gable": 0.6, "hip": 0.3, "shed": 0.1})
    rise = round(width / 2 * dice.between(0.25, 1.0), 1)
    return {"roof": roof, "roof_height": rise, "roof_colour": dice.natural(dice.pick("tiles", "tiles", "slate"))}


def skyline(kind: Kind, layout: Layout, dice: Dice) -> tuple[Building, ...]:
    """Large buildings behind the first row."""
    found = []
    first, last = layout.span()
    for _ in range(dice.whole(*(int(n) for n in kind.skyline))):
        size = (dice.between(12, 40, 0), dice.between(12, 30, 0), dice.scale(8, 70 if kind.shops else 25, 0))
        at = (dice.between(first - 40, last + 60, 0), dice.pick(-1, 1) * dice.between(45, 105, 0))
        yaw = dice.pick(0.0, 90.0, 180.0, 270.0)
        if layout.take(at, (size[0], size[1]), yaw, 0, 1.0, pavements=True):
            found.append(building(kind, dice, at, size, yaw))
    return tuple(found)
