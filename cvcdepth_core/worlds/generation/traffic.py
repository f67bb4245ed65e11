# SPDX-License-Identifier: Apache-2.0
"""Moving and parked vehicles, and people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from cvcdepth_core.worlds.description import Motion, Person, PersonKind, Vehicle, VehicleKind, WorldSpec
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.generation.kinds import Kind
from cvcdepth_core.worlds.generation.layout import Layout

_KINDS: dict[VehicleKind, float] = {
    "hatchback": 0.26, "saloon": 0.22, "estate": 0.13, "suv": 0.2, "van": 0.08, "minibus": 0.03, "pickup": 0.05,
    "truck": 0.05, "bus": 0.02, "tanker": 0.01,
}  # fmt: skip
_PARKED: dict[VehicleKind, float] = {
    "hatchback": 0.3, "saloon": 0.23, "estate": 0.13, "suv": 0.2, "van": 0.07, "minibus": 0.03, "pickup": 0.05,
    "trailer": 0.01,
}  # fmt: skip
_WORKS: dict[VehicleKind, float] = {
    "truck": 0.3, "van": 0.2, "pickup": 0.1, "trailer": 0.12, "hatchback": 0.1, "suv": 0.1, "tanker": 0.04,
    "tractor": 0.04,
}  # fmt: skip
LENGTHS: dict[VehicleKind, float] = {
    "hatchback": 4.3, "saloon": 5.0, "estate": 5.0, "suv": 4.9, "van": 5.8, "minibus": 5.4, "pickup": 5.8,
    "truck": 12.8, "tanker": 12.2, "bus": 13.2, "tractor": 3.8, "trailer": 7.5,
}  # fmt: skip
"""The longest of each kind, metres."""
_OWN_ROOM = 7.0  # metres before and behind the vehicle that carries the sensors
_WIDTH = 2.1


class Moving(NamedTuple):
    """Road users that move."""

    vehicles: tuple[Vehicle, ...]
    people: tuple[Person, ...]


def traffic(world: WorldSpec, kind: Kind, layout: Layout, dice: Dice) -> Moving:
    """Vehicles in all lanes, as fast as the others of their lane, and cyclists at the edges."""
    vehicles: list[Vehicle] = []
    share = dice.between(*kind.traffic)
    turns = world.drive.bends is not None
    for road in range(len(layout.corridors)):
        # Whoever turns off would cross the others' ways.
        if not (turns and road):
            for lane in range(world.roads[road].lanes):
                vehicles += _lane(world, layout, dice, road, lane, share)
    cyclists = [] if turns else [*_cyclists(kind, layout, dice)]
    return Moving(tuple(vehicles), tuple(cyclists))


def _lane(world: WorldSpec, layout: Layout, dice: Dice, road: int, lane: int, share: float) -> Iterator[Vehicle]:
    spec, drive = world.roads[road], world.drive
    lateral = (lane + 0.5 - spec.lanes / 2) * spec.lane_width
    forward = spec.one_way or lateral < 0 or spec.lanes == 1
    own = road == 0 and abs(lateral - drive.at[1]) < spec.lane_width / 2
    crossing = len(world.roads) > 1
    speeds = _speeds(world, dice, own, crossing and road == 1)
    if own and drive.bends is not None:
        return
    s, last = layout.span(road)
    s += dice.between(0, 20)
    while s < last:
        name: VehicleKind = dice.weighted(_KINDS)
        length = LENGTHS[name]
        gap = dice.scale(2.5, 25.0) if speeds == ((0.0, 0.0),) else dice.scale(6.0, 40.0)
        middle = s + length / 2
        ahead = abs(middle - drive.at[0])
        room = (not own or ahead > length / 2 + _OWN_ROOM) and not (crossing and _near_crossing(world, middle, road))
        if room and dice.chance(share):
            at = (round(middle, 2), round(lateral + dice.normal(0.15), 2))
            motion = Motion(speeds=speeds)
            yield Vehicle(
                kind=name,
                at=at,
                yaw=0.0 if forward else 180.0,
                road=road,
                colour=dice.paint(),
                motion=motion,
                seed=dice.seed(),
            )
        s += length + gap


def _near_crossing(world: WorldSpec, s: float, road: int) -> bool:
    """Nobody is on the crossing at the beginning; lanes that cross are never busy at once."""
    middle = -world.roads[1].start[1] if road else world.roads[1].start[0]
    return abs(s - middle) < 14.0


def _speeds(world: WorldSpec, dice: Dice, own: bool, waits: bool) -> tuple[tuple[float, float], ...]:
    if own:
        return tuple((t, max(0.0, v)) for t, v in world.drive.speeds)
    if waits:
        return ((0.0, 0.0),)
    top = max(1.5, max(abs(v) for _, v in world.drive.speeds))
    return dice.pick(
        ((0.0, round(top * dice.between(0.7, 1.3), 1)),), ((0.0, round(top, 1)), (6.0, round(top * 0.6, 1)))
    )


def _cyclists(kind: Kind, layout: Layout, dice: Dice) -> Iterator[Person]:
    first, last = layout.span()
    for _ in range(dice.whole(*(int(n) for n in kind.cyclists))):
        side = dice.pick(-1.0, 1.0)
        at = (dice.between(first, last, 1), round(side * (layout.kerb(side) - dice.between(0.4, 0.8)), 2))
        name: PersonKind = dice.pick("cyclist", "cyclist", "cyclist", "motorcyclist")
        if layout.take(at, (2.0, 0.8), 0.0, 0, None):
            speed = dice.between(2.0, 6.5, 1)
            yaw = 0.0 if side < 0 else 180.0
            yield Person(
                kind=name, at=at, yaw=yaw, colour=dice.any_colour(), second=dice.any_colour(0.5, 0.02, 0.2),
                motion=Motion(speeds=((0.0, speed),)), seed=dice.seed(),
            )  # fmt: skip


def parked_vehicles(world: WorldSpec, kind: Kind, layout: Layout, dice: Dice) -> tuple[Vehicle, ...]:
    """Vehicles at the kerb where the edge is wide, on open places, and in front of houses."""
    found: list[Vehicle] = []
    share = dice.between(*kind.parked)
    for road, spec in enumerate(world.roads):
        for side, edge in zip((1.0, -1.0), spec.edge, strict=True):
            if spec.lanes and edge > 1.9:
                found += _at_kerb(layout, dice, road, side, share, edge)
        if not spec.lanes:
            found += _on_place(world, layout, dice, share)
    if kind.setback[1] > 5:
        found += _off_road(world, layout, dice, share)
    return tuple(found)


def _at_kerb(layout: Layout, dice: Dice, road: int, side: float, share: float, edge: float) -> Iterator[Vehicle]:
    s, last = layout.span(road)
    while s < last:
        name: VehicleKind = dice.weighted(_PARKED)
        length = LENGTHS[name]
        away = layout.kerb(side, road) - min(edge / 2, 1.1) + dice.normal(0.06)
        at = (round(s + length / 2, 2), round(side * away, 2))
        if (
            dice.chance(share)
            and layout.take(at, (length, _WIDTH - 0.1), 0.0, road, None)
            and not _junction(layout, at, road)
        ):
            yaw = dice.pick(0.0, 180.0) if dice.chance(0.2) else (0.0 if side < 0 else 180.0)
            yield _parked(dice, name, at, yaw + dice.normal(1.5), road)
        s += length + dice.scale(0.4, 2.5)


def _junction(layout: Layout, at: tuple[float, float], road: int) -> bool:
    """Whether a place lies near another road."""
    import numpy as np

    point = np.array([layout.xy(at, road)])
    return any(float(c.depth(point)[0]) > -5.0 for i, c in enumerate(layout.corridors) if i != road)


def _on_place(world: WorldSpec, layout: Layout, dice: Dice, share: float) -> Iterator[Vehicle]:
    first, last = layout.span()
    half = layout.kerb(1.0)
    kinds = _WORKS if world.kind == "yard" else _PARKED
    for _ in range(int(70 * share)):
        name: VehicleKind = dice.weighted(kinds)
        lateral = dice.pick(-1, 1) * dice.between(4.5, max(4.6, half - 2.0))
        at, yaw = (
            (dice.between(first, last, 1), round(lateral, 1)),
            dice.pick(0.0, 90.0, 180.0, 270.0, dice.between(0, 360, 0)),
        )
        if layout.take(at, (LENGTHS[name] + 0.4, _WIDTH + 0.7), yaw, 0, None):
            yield _parked(dice, name, at, yaw, 0)


def _off_road(world: WorldSpec, layout: Layout, dice: Dice, share: float) -> Iterator[Vehicle]:
    """In drives and yards beside the road."""
    first, last = layout.span()
    kinds = _WORKS if world.kind in ("industrial", "yard") else _PARKED
    for _ in range(int(14 * share)):
        name: VehicleKind = dice.weighted(kinds)
        side = dice.pick(-1.0, 1.0)
        at = (dice.between(first, last, 1), round(side * (layout.edge(side) + dice.between(2.0, 8.0)), 1))
        yaw = dice.pick(90.0, 270.0, 0.0)
        if layout.take(at, (LENGTHS[name], _WIDTH), yaw, 0, 0.1, pavements=True):
            yield _parked(dice, name, at, yaw, 0)


def _parked(dice: Dice, name: VehicleKind, at: tuple[float, float], yaw: float, road: int) -> Vehicle:
    return Vehicle(kind=name, at=at, yaw=round(yaw % 360, 1), road=road, colour=dice.paint(), seed=dice.seed())


def people(world: WorldSpec, kind: Kind, layout: Layout, dice: Dice) -> tuple[Person, ...]:
    """People on pavements and open places, walking or standing, some in groups."""
    found: list[Person] = []
    first, last = layout.span()
    for _ in range(dice.whole(*(int(n) for n in kind.people))):
        side = dice.pick(1.0, -1.0)
        kerb, edge = layout.kerb(side), layout.edge(side)
        inside = not world.roads[0].lanes
        away = dice.between(3.0, kerb) if inside else dice.between(kerb + 0.5, max(edge, kerb + 1.0) + 0.4)
        s = dice.between(first, last, 1)
        walks = dice.chance(0.6)
        yaw = dice.pick(0.0, 180.0) if walks else dice.between(0, 360, 0)
        speed = dice.between(0.8, 1.8, 1)
        for i in range(dice.whole(1, 3) if dice.chance(0.25) else 1):
            at = (round(s + 0.3 * i, 2), round(side * (away + 0.55 * i), 2))
            if layout.take(at, (0.45, 0.45), 0.0, 0, None if inside else 0.2):
                found.append(_person(dice, at, yaw, speed if walks else 0.0))
    return tuple(found)


def _person(dice: Dice, at: tuple[float, float], yaw: float, speed: float) -> Person:
    name: PersonKind = dice.weighted({"pedestrian": 0.84, "child": 0.08, "parked_bicycle": 0.04, "pushchair": 0.04})
    moves = speed > 0 and name != "parked_bicycle"
    return Person(
        kind=name,
        at=at,
        yaw=yaw,
        colour=dice.any_colour(0.8, 0.02, 0.6),
        second=dice.any_colour(0.5, 0.015, 0.25),
        motion=Motion(speeds=((0.0, speed),)) if moves else None,
        seed=dice.seed(),
    )
