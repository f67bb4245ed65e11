# SPDX-License-Identifier: Apache-2.0
"""What only some kinds of places have: tunnels, parking decks, bridges, gantries, car parks and lawns."""

from __future__ import annotations

from dataclasses import dataclass

from cvcdepth_core.worlds.description import (
    Patch,
    Structure,
    StructureKind,
    SurfaceKind,
    Vehicle,
    VehicleKind,
    WorldSpec,
)
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.generation.layout import Layout
from cvcdepth_core.worlds.generation.traffic import LENGTHS


@dataclass
class Special:
    """Parts of a world."""

    patches: tuple[Patch, ...] = ()
    structures: tuple[Structure, ...] = ()
    vehicles: tuple[Vehicle, ...] = ()


def special_places(world: WorldSpec, layout: Layout, dice: Dice) -> Special:
    """Return what belongs to the kind of place, and what any road may have."""
    special = Special()
    if world.kind == "tunnel":
        special.structures += (_tunnel(layout, dice),)
    elif world.kind == "parking_deck":
        _parking_deck(world, layout, dice, special)
    elif world.kind in ("city", "suburb", "industrial", "yard", "highway"):
        _lots(layout, dice, special)
    if world.kind in ("highway", "city", "rural", "industrial") and dice.chance(0.16):
        special.structures += _bridges(layout, dice)
    if world.kind == "highway" and dice.chance(0.5):
        width = layout.edge(1.0) + layout.edge(-1.0) + 1.2
        at = (layout.start + dice.between(20, 90, 0), round((layout.edge(1.0) - layout.edge(-1.0)) / 2, 2))
        special.structures += (Structure(kind="gantry", at=at, size=(1.0, width, 5.5)),)
    if world.kind in ("city", "industrial", "yard") and dice.chance(0.15):
        at = (layout.start + dice.between(20, 120, 0), dice.pick(-1, 1) * dice.between(45, 90, 0))
        kind: StructureKind = dice.pick("crane", "tower")
        size = (40.0, 1.0, dice.between(25, 50, 0)) if kind == "crane" else (8.0, 8.0, dice.between(12, 30, 0))
        special.structures += (Structure(kind=kind, at=at, yaw=dice.between(0, 360, 0), size=size, seed=dice.seed()),)
    return special


def _tunnel(layout: Layout, dice: Dice) -> Structure:
    width = layout.edge(1.0) + layout.edge(-1.0) + 0.1
    middle = (layout.edge(1.0) - layout.edge(-1.0)) / 2
    length = dice.between(80, 200, 0)
    at = (layout.start + dice.between(-40, 30, 0) + length / 2 - 30, round(middle, 2))
    return Structure(
        kind="tunnel", at=at, size=(length, round(width, 2), dice.between(4.6, 6.2, 1)), colour=dice.natural("concrete")
    )


def _parking_deck(world: WorldSpec, layout: Layout, dice: Dice, special: Special) -> None:
    first, last = layout.span()
    width = round(layout.kerb(1.0) + layout.kerb(-1.0), 1)
    height = dice.between(2.4, 3.4, 1)
    size = (round(last - first - 10), width, height)
    colour = dice.natural("concrete")
    special.structures += (Structure(kind="deck", at=(round((first + last) / 2), 0.0), size=size, colour=colour),)
    share = dice.between(0.2, 0.9)
    for row in (-1, 1):
        lateral = row * (width / 2 - 3.2)
        patch = Patch(
            at=(round((first + last) / 2), round(lateral, 1)), size=(size[0] - 2, 5.2), surface=world.roads[0].surface,
            colour=world.roads[0].colour, bays=2.5,
        )  # fmt: skip
        special.patches += (patch,)
        s = first + 7.0
        while s < last - 7:
            kind: VehicleKind = dice.pick("hatchback", "saloon", "suv", "estate")
            at = (round(s, 2), round(lateral, 2))
            if dice.chance(share) and layout.take(at, (LENGTHS[kind], 2.2), 90.0, 0, None):
                yaw = dice.pick(90.0, 270.0) + dice.normal(1.0)
                special.vehicles += (
                    Vehicle(kind=kind, at=at, yaw=round(yaw % 360, 1), colour=dice.paint(), seed=dice.seed()),
                )
            s += 2.5


def _lots(layout: Layout, dice: Dice, special: Special) -> None:
    """Car parks, lawns and gravel beside the road."""
    surfaces: tuple[SurfaceKind, ...] = ("asphalt", "gravel", "grass", "concrete", "dirt")
    for _ in range(dice.whole(0, 4)):
        side, size = dice.pick(-1.0, 1.0), (dice.between(12, 45, 0), dice.between(8, 20, 0))
        first, last = layout.span()
        at = (dice.between(first, last, 0), round(side * (layout.edge(side) + size[1] / 2 + dice.between(0.6, 8.0)), 1))
        surface = dice.pick(*surfaces)
        if not layout.take(at, size, 0.0, 0, 0.5, pavements=True):
            continue
        lot = surface in ("asphalt", "concrete") and dice.chance(0.7)
        names = {"asphalt": "asphalt", "gravel": "gravel", "grass": "grass", "concrete": "concrete", "dirt": "dirt"}
        colour = dice.natural(names[surface])
        special.patches += (
            Patch(
                at=at, size=size, surface=surface, colour=colour, second=dice.natural("dirt"), bays=2.6 if lot else None
            ),
        )
        if lot:
            share = dice.between(0.1, 0.9)
            for i in range(int(size[0] / 2.6)):
                kind: VehicleKind = dice.pick("hatchback", "saloon", "suv", "estate", "van")
                s = at[0] - size[0] / 2 + 0.5 + 1.3 + 2.6 * i
                if dice.chance(share):
                    place = (round(s, 2), round(at[1] + dice.normal(0.2), 2))
                    special.vehicles += (
                        Vehicle(kind=kind, at=place, yaw=dice.pick(90.0, 270.0), colour=dice.paint(), seed=dice.seed()),
                    )


def _bridges(layout: Layout, dice: Dice) -> tuple[Structure, ...]:
    width = round(layout.edge(1.0) + layout.edge(-1.0) + 16.0 + dice.between(0, 12), 1)
    at = (layout.start + dice.between(15, 100, 0), round((layout.edge(1.0) - layout.edge(-1.0)) / 2, 1))
    size = (dice.between(5, 15, 1), width, dice.between(4.7, 6.5, 1))
    return (Structure(kind="bridge", at=at, size=size, colour=dice.natural("concrete"), seed=dice.seed()),)
