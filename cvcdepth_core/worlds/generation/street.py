# SPDX-License-Identifier: Apache-2.0
"""Lamps, poles with wires, signs and all that stands about in streets."""

from __future__ import annotations

from collections.abc import Iterator

from cvcdepth_core.worlds.description import Furniture, FurnitureKind, Wires, WorldSpec
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.generation.kinds import Kind
from cvcdepth_core.worlds.generation.layout import Layout

_OWN_WIDTH = 1.6  # metres beside the drive's middle that cones keep free
_CLUTTER: dict[FurnitureKind, float] = {
    "bollard": 0.14, "bin": 0.16, "bench": 0.08, "cabinet": 0.1, "hydrant": 0.06, "shelter": 0.05, "planter": 0.09,
    "rock": 0.04, "post_box": 0.06, "parasol": 0.05, "crate": 0.07, "pole": 0.06, "billboard": 0.04,
}  # fmt: skip
_WORKS: dict[FurnitureKind, float] = {
    "container": 0.28, "pallets": 0.2, "skip": 0.12, "crate": 0.16, "bin": 0.1, "barrel": 0.08, "cone": 0.06,
}  # fmt: skip
_ROOM: dict[FurnitureKind, tuple[float, float]] = {
    "container": (12.4, 2.6), "pallets": (1.4, 1.0), "skip": (3.6, 2.0), "shelter": (4.0, 2.0), "bench": (0.8, 2.0),
    "billboard": (0.6, 6.0), "parasol": (2.6, 2.6), "planter": (1.2, 1.2), "cabinet": (0.6, 1.4),
}  # fmt: skip


def furniture(world: WorldSpec, kind: Kind, layout: Layout, dice: Dice) -> tuple[Furniture, ...]:
    """Everything but what carries wires."""
    parts = [*_lamps(kind, layout, dice), *_signs(kind, layout, dice), *_lights(kind, layout, dice)]
    return (*parts, *_clutter(world, kind, layout, dice), *_road_works(world, layout, dice))


def _beside(layout: Layout, side: float, dice: Dice, road: int = 0) -> float:
    """Return l of something on the pavement near the kerb, or beyond the edge where there is none."""
    kerb, edge = layout.kerb(side, road), layout.edge(side, road)
    return round(side * (kerb + 0.5 if edge - kerb > 1.0 else edge + dice.between(0.3, 1.2)), 2)


def _lamps(kind: Kind, layout: Layout, dice: Dice) -> Iterator[Furniture]:
    for road in range(len(layout.corridors)):
        if not dice.chance(kind.lamps):
            continue
        gap, height = dice.between(14, 38, 0), dice.between(4.0, 10.0, 1)
        colour, sides = (
            dice.pick(dice.natural("metal"), dice.any_colour(0.3, 0.02, 0.3)),
            dice.pick((1.0, -1.0), (1.0,), (-1.0,)),
        )
        for side in sides:
            lateral = _beside(layout, side, dice, road)
            s, last = layout.span(road)
            while s < last:
                if layout.take((s, lateral), (0.4, 0.4), 0.0, road, 0.15):
                    yield Furniture(
                        kind="lamp",
                        at=(round(s, 1), lateral),
                        yaw=0.0 if side < 0 else 180.0,
                        road=road,
                        height=height,
                        colour=colour,
                    )
                s += gap


def wires(kind: Kind, layout: Layout, dice: Dice) -> tuple[tuple[Wires, ...], tuple[Furniture, ...]]:
    """Rows of poles with wires between them, and some across the road."""
    if not dice.chance(kind.wires):
        return (), ()
    side, gap, height = dice.pick(1.0, -1.0), dice.between(22, 42, 0), dice.between(7.0, 10.5, 1)
    lateral = _beside(layout, side, dice)
    s, last = layout.span()
    line, poles = [], []
    while s < last:
        at = (round(s, 1), lateral)
        if layout.take(at, (0.5, 0.5), 0.0, 0, 0.15):
            line.append(at)
            poles.append(Furniture(kind="power_pole", at=at, height=height, seed=dice.seed()))
        s += gap
    if len(line) < 2:
        return (), tuple(poles)
    along = Wires(line=tuple(line), height=height, sag=dice.between(0.2, 0.9), count=dice.whole(2, 6))
    across = [
        Wires(
            line=(at, (round(at[0] + dice.normal(4.0), 1), round(-at[1] * 1.6, 1))),
            height=round(height - 1.2, 1),
            sag=0.3,
            count=dice.whole(1, 3),
        )
        for at in line
        if dice.chance(0.35)
    ]
    return (along, *across), tuple(poles)


def _signs(kind: Kind, layout: Layout, dice: Dice) -> Iterator[Furniture]:
    first, last = layout.span()
    for _ in range(dice.whole(*(int(n) for n in kind.signs))):
        side = dice.pick(1.0, -1.0)
        at = (dice.between(first, last, 1), _beside(layout, side, dice))
        if layout.take(at, (0.4, 0.4), 0.0, 0, 0.2):
            yaw = dice.pick(0.0, 0.0, 180.0) + dice.normal(6)
            yield Furniture(
                kind="sign", at=at, yaw=round(yaw % 360, 1), height=dice.between(2.1, 3.2, 1), seed=dice.seed()
            )


def _lights(kind: Kind, layout: Layout, dice: Dice) -> Iterator[Furniture]:
    """Traffic lights at a crossing."""
    if len(layout.corridors) < 2 or not dice.chance(0.6):
        return
    crossing = layout.start + kind.crossing_at
    half = layout.kerb(1.0, 1) + 2.5
    for s, side, yaw in ((crossing - half, -1.0, 0.0), (crossing + half, 1.0, 180.0), (crossing + half, -1.0, 0.0)):
        at = (round(s, 1), _beside(layout, side, dice))
        if layout.take(at, (0.5, 0.5), 0.0, 0, 0.1):
            yield Furniture(kind="traffic_light", at=at, yaw=yaw, seed=dice.seed())


def _clutter(world: WorldSpec, kind: Kind, layout: Layout, dice: Dice) -> Iterator[Furniture]:
    first, last = layout.span()
    works = world.kind in ("yard", "industrial")
    open_place = not world.roads[0].lanes
    for _ in range(dice.whole(*(int(n) for n in kind.clutter))):
        name: FurnitureKind = dice.weighted(_WORKS if works and dice.chance(0.7) else _CLUTTER)
        side = dice.pick(1.0, -1.0)
        kerb, edge = layout.kerb(side), layout.edge(side)
        inside = open_place and dice.chance(0.6)
        away = dice.between(4.0, max(4.1, kerb - 1.0)) if inside else dice.between(kerb + 0.3, edge + 4.0)
        at = (dice.between(first, last, 1), round(side * away, 2))
        size = _ROOM.get(name, (0.8, 0.8))
        yaw = (
            dice.pick(0.0, 90.0, 180.0, dice.between(0, 360, 0)) if name != "shelter" else (0.0 if side < 0 else 180.0)
        )
        if layout.take(at, size, yaw, 0, None if inside else 0.15):
            height = dice.pick(2.6, 2.6, 5.2) if name == "container" else None
            yield Furniture(
                kind=name, at=at, yaw=yaw, height=height, colour=dice.any_colour(0.6, 0.03, 0.5), seed=dice.seed()
            )


def _road_works(world: WorldSpec, layout: Layout, dice: Dice) -> Iterator[Furniture]:
    """Return A row of cones or barrels along a lane's edge."""
    if not dice.chance(0.15):
        return
    name: FurnitureKind = dice.pick("cone", "barrel")
    s, step = layout.start + dice.between(8, 40), dice.between(1.5, 5.0)
    side = dice.pick(1.0, -1.0)
    if abs(side * (layout.kerb(side) - 0.5) - world.drive.at[1]) < _OWN_WIDTH:
        return
    for i in range(dice.whole(4, 12)):
        at = (round(s + i * step, 2), round(side * (layout.kerb(side) - 0.5), 2))
        if layout.take(at, (0.5, 0.5), 0.0, 0, None):
            yield Furniture(kind=name, at=at, seed=dice.seed())
