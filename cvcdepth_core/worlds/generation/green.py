# SPDX-License-Identifier: Apache-2.0
"""Trees, woods and bushes, and the fences and walls along roads."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from cvcdepth_core.worlds.description import Barrier, BarrierKind, Colour, Tree, TreeKind
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.generation.kinds import Kind
from cvcdepth_core.worlds.generation.layout import Layout


class _Species(NamedTuple):
    kind: TreeKind
    size: float
    slender: float
    colour: Colour


def trees(kind: Kind, layout: Layout, dice: Dice) -> tuple[Tree, ...]:
    """All trees and bushes."""
    species = [_species(dice) for _ in range(3)]
    found = [*_along_streets(kind, layout, dice, species)]
    found += _scattered(layout, dice, species, dice.whole(*_ints(kind.trees)), (0.8, 55.0))
    woods = dice.whole(*_ints(kind.woods))
    near = dice.between(1.5, 18.0)
    found += _scattered(layout, dice, species[:2], woods, (near, near + 60.0))
    found += _bushes(kind, layout, dice)
    return tuple(found)


def _ints(pair: tuple[float, float]) -> tuple[int, int]:
    return int(pair[0]), int(pair[1])


def _species(dice: Dice) -> _Species:
    kind: TreeKind = dice.weighted({"broadleaf": 0.55, "conifer": 0.17, "poplar": 0.1, "bare": 0.12, "palm": 0.06})
    slender = {"conifer": 0.35, "poplar": 0.28, "palm": 0.55}.get(kind, dice.between(0.5, 0.95))
    autumn = dice.chance(0.1)
    colour = (dice.between(0.1, 0.3), dice.between(0.06, 0.14), 0.02) if autumn else dice.natural("leaf")
    return _Species(kind, dice.between(0.7, 1.4), slender, colour)


def _tree(dice: Dice, species: _Species, at: tuple[float, float], road: int, height: float) -> Tree:
    trunk = dice.between(0.04, 0.15) if species.kind == "conifer" else dice.between(0.16, 0.42)
    return Tree(
        at=at,
        road=road,
        kind=species.kind,
        height=round(height, 1),
        width=round(height * species.slender * dice.between(0.8, 1.2), 1),
        trunk=trunk,
        colour=species.colour,
        seed=dice.seed(),
    )


def _along_streets(kind: Kind, layout: Layout, dice: Dice, species: list[_Species]) -> Iterator[Tree]:
    for road in range(len(layout.corridors)):
        if not dice.chance(kind.street_trees):
            continue
        gap, chosen = dice.between(6.0, 20.0), dice.pick(*species)
        height = dice.between(3.5, 11.0) * chosen.size
        for side in (1.0, -1.0):
            kerb, edge = layout.kerb(side, road), layout.edge(side, road)
            lateral = kerb + 0.8 if edge - kerb > 1.7 else edge + dice.between(0.8, 3.0)
            s, last = layout.span(road)
            while s < last:
                at = (round(s + dice.normal(0.4), 2), round(side * lateral, 2))
                if dice.chance(0.85) and layout.take(at, (0.6, 0.6), 0.0, road, 0.3):
                    yield _tree(dice, chosen, at, road, height * dice.between(0.75, 1.15))
                s += gap


def _scattered(
    layout: Layout, dice: Dice, species: list[_Species], count: int, away: tuple[float, float]
) -> Iterator[Tree]:
    first, last = layout.span()
    for _ in range(count):
        side = dice.pick(-1.0, 1.0)
        at = (dice.between(first, last), round(side * (layout.edge(side) + dice.scale(max(0.5, away[0]), away[1])), 2))
        chosen = dice.pick(*species)
        if layout.take(at, (1.2, 1.2), 0.0, 0, 0.6, pavements=True):
            yield _tree(dice, chosen, at, 0, dice.scale(3.0, 17.0) * chosen.size)


def _bushes(kind: Kind, layout: Layout, dice: Dice) -> Iterator[Tree]:
    first, last = layout.span()
    colour = dice.natural("leaf")
    for _ in range(dice.whole(*_ints(kind.bushes))):
        side, height = dice.pick(-1.0, 1.0), dice.scale(0.5, 2.4, 1)
        at = (dice.between(first, last), round(side * (layout.edge(side) + dice.scale(0.5, 14.0)), 2))
        if layout.take(at, (height, height), 0.0, 0, 0.3, pavements=True):
            width = round(height * dice.between(0.8, 1.8), 1)
            yield Tree(at=at, kind="bush", height=height, width=width, trunk=0.3, colour=colour, seed=dice.seed())


_COLOURS: dict[BarrierKind, str] = {
    "wall": "plaster",
    "brick_wall": "brick",
    "fence": "wood",
    "railing": "slate",
    "mesh": "metal",
    "hedge": "leaf",
    "guard_rail": "metal",
    "concrete_barrier": "concrete",
}
_HEIGHTS: dict[BarrierKind, tuple[float, float]] = {
    "wall": (0.6, 3.5),
    "brick_wall": (0.6, 2.5),
    "fence": (0.8, 2.0),
    "railing": (0.9, 1.9),
    "mesh": (1.2, 3.0),
    "hedge": (0.7, 2.6),
    "guard_rail": (0.75, 0.8),
    "concrete_barrier": (0.8, 1.1),
}


def barriers(kind: Kind, layout: Layout, dice: Dice) -> tuple[Barrier, ...]:
    """Walls, fences and hedges along both sides of roads, piece by piece where there is room."""
    found: list[Barrier] = []
    for road in range(len(layout.corridors)):
        for side in (1.0, -1.0):
            if dice.chance(kind.barriers):
                found += _line(kind, layout, dice, road, side)
    return tuple(found)


def _line(kind: Kind, layout: Layout, dice: Dice, road: int, side: float) -> Iterator[Barrier]:
    """Return the same barrier, or with a change of owner another, in stretches that end where something else stands."""
    first, last = layout.span(road)
    s, away = first, dice.between(0.25, 1.2)
    run: list[float] = []
    barrier = _barrier(kind, dice)
    stop = dice.between(10, 90) + s
    while s < last:
        lateral = side * (layout.edge(side, road) + away)
        room = layout.take((s + 1.25, lateral), (2.4, 0.5), 0.0, road, 0.1, pavements=True)
        if room:
            run.append(s)
        if run and (not room or s > stop or s + 2.5 >= last):
            ends = ((round(run[0], 2), round(lateral, 2)), (round(run[-1] + 2.5, 2), round(lateral, 2)))
            yield barrier.model_copy(update={"line": ends, "road": road, "seed": dice.seed()})
            run = []
        if s > stop:
            barrier, stop = _barrier(kind, dice), s + dice.between(10, 90)
            s += dice.pick(0.0, 0.0, 5.0)
        s += 2.5


def _barrier(kind: Kind, dice: Dice) -> Barrier:
    name = dice.pick(*kind.barrier_kinds)
    colour = dice.any_colour() if dice.chance(0.15) and name != "hedge" else dice.natural(_COLOURS[name])
    return Barrier(kind=name, line=((0, 0), (1, 0)), height=dice.scale(*_HEIGHTS[name], digits=2), colour=colour)
