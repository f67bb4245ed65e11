# SPDX-License-Identifier: Apache-2.0
"""Worlds thought up from a seed: streets, roads and places with everything that stands and moves there."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import get_args

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.worlds.description import (
    Bank,
    Drive,
    Ground,
    Horizon,
    Line,
    Road,
    Sky,
    SurfaceKind,
    Wave,
    Weather,
    WorldSpec,
)
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.generation.kinds import KINDS, Kind, WorldKind
from cvcdepth_core.worlds.generation.layout import Layout
from cvcdepth_core.worlds.generation.parts import furnish

_BEHIND, _AHEAD = 90.0, 110.0  # metres of world behind the start and beyond the end of the drive
_CROSS_HALF = 130.0  # metres of the crossing road on either side
_CROSS_LANE = 1.7  # metres from its middle to that of its lanes
_WEIGHTS: dict[WorldKind, float] = {name: kind.weight for name, kind in KINDS.items()}


def random_world(seed: int, kind: WorldKind | None = None, seconds: float = 10.0) -> WorldSpec:
    """Think up a world for a drive of so many seconds; without `kind`, any.

    The same arguments always give the same world.
    """
    name: WorldKind = Dice(seed, 101).weighted(_WEIGHTS) if kind is None else kind
    if name not in KINDS:
        raise ConfigError(f"world kind {name}: there is none; there are {', '.join(get_args(WorldKind))}")
    return _Author(seed, name, seconds).write()


@dataclass
class _Author:
    seed: int
    name: WorldKind
    seconds: float
    dice: Dice = field(init=False)
    kind: Kind = field(init=False)

    def __post_init__(self) -> None:
        self.dice = Dice(self.seed, 103)
        self.kind = KINDS[self.name]

    def write(self) -> WorldSpec:
        speeds = self._speeds()
        reach = _distance(speeds, self.seconds)
        roads = self._roads(_BEHIND + reach + _AHEAD)
        drive = self._drive(roads, speeds)
        layout = Layout(roads, drive, reach)
        sky = self._sky()
        base = WorldSpec(
            name=f"{self.name} {self.seed}",
            kind=self.name,
            seed=self.seed,
            sky=sky,
            ground=self._ground(),
            horizon=self._horizon(),
            roads=roads,
            drive=drive,
        )
        return furnish(base, self.kind, layout, Dice(self.seed, 107))

    # The drive.

    def _speeds(self) -> tuple[tuple[float, float], ...]:
        dice, top = self.dice, self.dice.between(*self.kind.speed, digits=1)
        manner = dice.weighted(
            {"steady": 0.5, "brakes": 0.14, "starts": 0.14, "stop and go": 0.12, "stands": 0.04, "reverses": 0.06}
        )
        if manner == "reverses" and self.kind.speed[1] > 9:
            manner = "brakes"
        t = dice.between(0.5, 2.5, 1)
        if manner == "brakes":
            return (0.0, top), (t, top), (round(t + top / 2.5, 1), 0.0)
        if manner == "starts":
            return (t, 0.0), (round(t + top / 1.8, 1), top)
        if manner == "stop and go":
            slow = min(top, 4.0)
            return (
                (0.0, slow),
                (t, 0.0),
                (t + 1.5, 0.0),
                (t + 3.5, slow),
                (t + 5.0, slow),
                (t + 7.0, 0.0),
                (t + 9.0, slow),
            )
        if manner == "stands":
            return ((0.0, 0.0),)
        if manner == "reverses":
            return (0.0, 0.0), (t, 0.0), (t + 1.5, -1.8), (t + 5.0, -1.8), (t + 6.0, 0.0)
        return (0.0, top), (5.0, round(top * dice.between(0.8, 1.15), 1))

    def _drive(self, roads: tuple[Road, ...], speeds: tuple[tuple[float, float], ...]) -> Drive:
        dice, road = self.dice, roads[0]
        own_lanes = road.lanes if road.one_way else max(1, road.lanes // 2)
        lane = dice.whole(0, own_lanes - 1) if road.lanes else 0
        lateral = -(road.lanes / 2 - lane - 0.5) * road.lane_width if road.lanes else 0.0
        lateral = round(lateral + dice.normal(0.2), 2)
        if not self.kind.lanes[0] and road.lanes == 0:
            lateral = dice.between(-3, 3)
        bends = self._turn() if len(roads) > 1 and dice.chance(0.35) else None
        return Drive(at=(_BEHIND, lateral), speeds=speeds, bends=bends)

    def _turn(self) -> tuple[tuple[float, float], ...]:
        """Turn into the crossing road, to the right or left, at the crossing's lane."""
        to_left = self.dice.chance(0.5)
        radius = 11.0 if to_left else 7.0
        lane = self.kind.crossing_at + (_CROSS_LANE if to_left else -_CROSS_LANE)
        straight = max(0.5, lane - radius)
        side = 1.0 if to_left else -1.0
        return (round(straight, 2), 0.0), (round(math.pi / 2 * radius, 2), round(side / radius, 4)), (200.0, 0.0)

    # The roads.

    def _roads(self, length: float) -> tuple[Road, ...]:
        dice, kind = self.dice, self.kind
        main = self._main_road(length)
        if not dice.chance(kind.crossing):
            return (main,)
        if len(main.bends) > 1 or main.bends[0][1] != 0.0:  # its place is that of a straight road
            return (main,)
        at, half = _BEHIND + kind.crossing_at, _CROSS_HALF
        cross = Road(
            start=(at, -half, 90.0),
            bends=((2 * half, 0.0),),
            lanes=2,
            lane_width=3.4,
            edge=main.edge,
            surface=main.surface,
            colour=main.colour,
            wear=main.wear,
            kerb=main.kerb,
            pavement=main.pavement,
            pavement_surface=main.pavement_surface,
            pavement_colour=main.pavement_colour,
            centre_line=main.centre_line,
            centre_colour=main.centre_colour,
            crossings=(half - self._half_width(main) - 4.0,) if dice.chance(0.5) and kind.pavement[1] else (),
        )
        own = self._half_width(cross)
        crossings = (round(at - own - 4.0, 1),) if dice.chance(0.6) and kind.pavement[1] else ()
        return replace_road(main, crossings=crossings), cross

    @staticmethod
    def _half_width(road: Road) -> float:
        return road.lanes * road.lane_width / 2 + max(road.edge)

    def _main_road(self, length: float) -> Road:
        dice, kind = self.dice, self.kind
        lanes = dice.pick(*kind.lanes)
        lane_width = dice.between(2.8, 3.7) if lanes else 3.3
        surface: SurfaceKind = dice.weighted(kind.surfaces)
        colours = {
            "asphalt": "asphalt",
            "concrete": "concrete",
            "cobbles": "concrete",
            "gravel": "gravel",
            "dirt": "dirt",
            "slabs": "concrete",
        }
        pavement = dice.between(*kind.pavement) if kind.pavement[1] else 0.0
        edges = (self._edge(), self._edge())
        wide = dice.between(*kind.open_width) / 2 if not lanes else 0.0
        marked = surface in ("asphalt", "concrete")
        return Road(
            start=(0.0, 0.0, 0.0),
            bends=self._bends(length),
            lanes=lanes,
            one_way=bool(kind.one_way and dice.chance(kind.one_way)),
            lane_width=lane_width,
            edge=edges if lanes else (wide, wide),
            surface=surface,
            colour=dice.natural(colours.get(surface, "concrete"), odd=0.0),
            wear=dice.between(0.05, 0.95),
            kerb=dice.between(0.05, 0.17) if pavement else 0.0,
            pavement=(pavement, pavement if dice.chance(0.85) else 0.0),
            pavement_surface=dice.pick("slabs", "slabs", "concrete", "asphalt", "cobbles"),
            pavement_colour=dice.natural("concrete"),
            centre_line=self._centre_line() if marked else "none",
            centre_colour=dice.pick((0.68, 0.68, 0.66), (0.68, 0.68, 0.66), (0.62, 0.42, 0.05)),
            edge_lines=marked and dice.chance(kind.edge_lines),
            markings_wear=dice.between(0.0, 0.75),
            arrows=(dice.between(100, 160), dice.between(170, 240))
            if marked and lanes > 2 and dice.chance(0.5)
            else (),
            banks=(self._bank(), self._bank()),
        )

    def _edge(self) -> float:
        dice = self.dice
        return dice.between(2.0, 2.7) if dice.chance(self.kind.parking) else dice.between(*self.kind.edge)

    def _centre_line(self) -> Line:
        return self.dice.weighted({"dashed": 0.5, "solid": 0.15, "double": 0.25, "none": 0.1})

    def _bends(self, length: float) -> tuple[tuple[float, float], ...]:
        dice, kind = self.dice, self.kind
        if not dice.chance(kind.curved):
            return ((round(length), 0.0),)
        bends, left = [], length
        while left > 0:
            piece = min(left, dice.between(40, 120, 0))
            curvature = dice.pick(-1, 1) / dice.scale(*kind.radius) if dice.chance(0.75) else 0.0
            bends.append((max(5.0, round(piece)), round(curvature, 5)))
            left -= piece
        return tuple(bends)

    def _bank(self) -> Bank | None:
        dice, kind = self.dice, self.kind
        if not dice.chance(kind.banks):
            return None
        gradient = dice.pick(1.0, 1.0, -1.0) * dice.scale(0.02, 0.45)
        return Bank(setback=dice.between(0.3, 6.0), gradient=round(gradient, 3), height=dice.scale(0.4, 9.0, 1))

    def _ground(self) -> Ground:
        dice, kind = self.dice, self.kind
        surface: SurfaceKind = dice.weighted(kind.grounds)
        if surface == "grass":
            first = dice.natural(dice.pick("grass", "grass", "dry_grass"))
            second = dice.natural(dice.pick("grass", "dry_grass", "dirt"))
        else:
            names = {"asphalt": "asphalt", "dirt": "dirt", "gravel": "gravel", "sand": "sand", "snow": "snow"}
            first, second = (dice.natural(names.get(surface, "concrete")) for _ in range(2))
        waves = tuple(self._wave() for _ in range(dice.whole(1, 3))) if dice.chance(kind.hilly) else ()
        waves += (self._crest(),) if kind.hilly and dice.chance(0.3) else ()
        rough = dice.between(0.0, 0.6) if surface in ("grass", "dirt", "sand", "snow") else 0.0
        tall = dice.between(0.1, 1.0) if surface in ("grass", "dirt") and dice.chance(kind.tall_grass) else 0.0
        return Ground(surface=surface, colour=first, second=second, waves=waves, rough=rough, tall=tall)

    def _horizon(self) -> tuple[Horizon, ...]:
        dice = self.dice
        heights = {"hills": (10.0, 90.0), "woods": (8.0, 20.0), "town": (8.0, 40.0)}
        far = {"hills": (220.0, 900.0), "woods": (110.0, 260.0), "town": (120.0, 350.0)}
        return tuple(
            Horizon(
                kind=name,
                distance=dice.scale(*far[name], digits=0),
                height=dice.scale(*heights[name], digits=0),
                colour=dice.natural("leaf" if name == "woods" else dice.pick("leaf", "grass", "dry_grass")),
                seed=dice.seed(),
            )
            for name, chance in self.kind.horizon.items()
            if dice.chance(chance)
        )

    def _wave(self) -> Wave:
        dice = self.dice
        wavelength = dice.scale(90, 420, 0)
        slope = dice.scale(0.004, 0.055)
        height = round(slope * wavelength / (2 * math.pi), 2)
        return Wave(
            height=height, wavelength=wavelength, direction=dice.between(-60, 60, 0), phase=dice.between(0, 360, 0)
        )

    def _crest(self) -> Wave:
        """Return what makes the road ahead rise or fall within tens of metres: ground that is not flat close by."""
        dice = self.dice
        wavelength = dice.scale(40, 90, 0)
        height = round(dice.scale(0.012, 0.05) * wavelength / (2 * math.pi), 2)
        direction, phase = dice.between(-30, 30, 0), dice.between(0, 360, 0)
        return Wave(height=height, wavelength=wavelength, direction=direction, phase=phase)

    def _sky(self) -> Sky:
        dice = self.dice
        weather: Weather = dice.weighted({"clear": 0.3, "cloudy": 0.33, "overcast": 0.25, "dusk": 0.06, "night": 0.06})
        elevation = {"dusk": dice.between(-4, 4), "night": -15.0}.get(weather, dice.scale(8, 65, 1))
        hazy = dice.chance(0.12)
        return Sky(
            weather=weather,
            sun_azimuth=dice.between(-180, 180, 0),
            sun_elevation=elevation,
            clouds={"clear": dice.between(0.0, 0.3), "overcast": 0.9}.get(weather, dice.between(0.3, 0.7)),
            visibility=dice.scale(70, 400, 0) if hazy else dice.scale(600, 6000, 0),
            wet=dice.between(0.25, 1.0) if dice.chance(0.12 if weather in ("clear", "cloudy") else 0.35) else 0.0,
            brightness=dice.scale(0.7, 1.35),
            seed=dice.seed(),
        )


def replace_road(road: Road, **changes: object) -> Road:
    """Return the road with some of its fields changed, and checked again."""
    return Road.model_validate(road.model_dump() | changes)


def _distance(speeds: tuple[tuple[float, float], ...], seconds: float) -> float:
    """How far a drive gets, at most, metres."""
    from cvcdepth_core.worlds.trajectories import SpeedProfile

    profile = SpeedProfile(speeds)
    return max(0.0, *(float(profile.distance(seconds * i / 20)) for i in range(21)))
