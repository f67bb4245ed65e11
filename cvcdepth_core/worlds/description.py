# SPDX-License-Identifier: Apache-2.0
"""A world in words and numbers: what its YAML file holds. `build_world` makes it, `random_world` thinks one up.

Lengths are metres, angles degrees (counter-clockwise), speeds metres per second, times seconds. Colours are linear
reflectances of red, green and blue. Most parts stand beside a road: `at` is then (s, l), metres along the road's centre
line and to its left, and yaw 0 the road's direction; with `road: null` it is (x, y) in the world.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

_FASTEST = 60  # m/s


class Part(BaseModel):
    """Immutable; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)


def _reflectance(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    if not all(0.0 <= channel <= 1.0 for channel in colour):
        raise ValueError(f"colour {colour}: want three numbers from 0 to 1")
    return colour


def _increasing(speeds: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    times = [time for time, _ in speeds]
    if not times or times != sorted(set(times)):
        raise ValueError(f"speeds: times {times} do not increase")
    if any(abs(speed) > _FASTEST for _, speed in speeds):
        raise ValueError(f"speeds: {speeds}: nothing moves faster than {_FASTEST} m/s")
    return speeds


Colour = Annotated[tuple[float, float, float], AfterValidator(_reflectance)]
Speeds = Annotated[tuple[tuple[float, float], ...], AfterValidator(_increasing)]
Point = tuple[float, float]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Length = Annotated[float, Field(gt=0.0, le=2000.0)]

Weather = Literal["clear", "cloudy", "overcast", "dusk", "night"]
SurfaceKind = Literal["asphalt", "concrete", "cobbles", "slabs", "gravel", "dirt", "grass", "sand", "snow", "planks"]
WallKind = Literal["plaster", "brick", "panels", "boards", "metal", "glass"]
Line = Literal["none", "dashed", "solid", "double"]
BarrierKind = Literal["wall", "brick_wall", "fence", "railing", "mesh", "hedge", "guard_rail", "concrete_barrier"]
TreeKind = Literal["broadleaf", "conifer", "poplar", "bare", "palm", "bush"]
FurnitureKind = Literal[
    "lamp", "pole", "power_pole", "sign", "traffic_light", "bollard", "bin", "bench", "cabinet", "hydrant", "shelter",
    "billboard", "cone", "barrel", "container", "planter", "rock", "pallets", "skip", "parasol", "post_box", "crate",
]  # fmt: skip
StructureKind = Literal["bridge", "tunnel", "deck", "gantry", "crane", "tower"]
VehicleKind = Literal[
    "hatchback", "saloon", "estate", "suv", "van", "minibus", "pickup", "truck", "tanker", "bus", "tractor", "trailer"
]
PersonKind = Literal["pedestrian", "child", "cyclist", "motorcyclist", "parked_bicycle", "pushchair"]


class Sky(Part):
    """Weather, sun and air."""

    weather: Weather = "clear"
    sun_azimuth: float = 40.0
    """0 is the world's x axis."""
    sun_elevation: float = Field(default=40.0, ge=-20.0, le=90.0)
    clouds: Share = 0.3
    """Share of the sky that is covered."""
    visibility: float = Field(default=2500.0, ge=20.0)
    """Metres after which 1 / e of the contrast is left."""
    wet: Share = 0.0
    """How wet roads and pavements are."""
    brightness: float = Field(default=1.0, gt=0.0, le=10.0)
    """Of the sky's light, against that of the sun."""
    seed: int = 0
    """Of the clouds."""


class Wave(Part):
    """A wave of the ground."""

    height: float
    """From the middle to the crest."""
    wavelength: float = Field(ge=20.0)
    direction: float = 0.0
    phase: float = 0.0


class Bank(Part):
    """Ground that rises or falls beside a road."""

    setback: float = Field(default=1.0, ge=0.0)
    """Level strip between the paved part and the bank."""
    gradient: float = Field(default=0.0, ge=-1.0, le=1.0)
    """Rise per metre; negative falls."""
    height: float = Field(default=3.0, ge=0.0)
    """Where it ends."""


class Horizon(Part):
    """What closes the view far away."""

    kind: Literal["hills", "woods", "town"]
    distance: float = Field(default=250.0, ge=100.0, le=3000.0)
    """From the roads."""
    height: Length = 15.0
    colour: Colour = (0.06, 0.09, 0.03)
    seed: int = 0


class Ground(Part):
    """The ground between and beyond roads."""

    surface: SurfaceKind = "grass"
    colour: Colour = (0.1, 0.13, 0.05)
    second: Colour = (0.16, 0.15, 0.07)
    """Colour of its other patches."""
    waves: tuple[Wave, ...] = ()
    rough: Share = 0.0
    """Small unevenness, as a share of 0.3 m."""
    tall: Share = 0.0
    """How much grass stands beside the roads, and how high, as a share of 0.7 m."""
    margin: Length = 110.0
    """How far it is modelled beyond the roads; then it goes on flat."""


class Road(Part):
    """A road; its middle runs from `start` through `bends`."""

    start: tuple[float, float, float] = (-120.0, 0.0, 0.0)
    """x, y, direction."""
    bends: tuple[Point, ...] = ((300.0, 0.0),)
    """Length and curvature (1/m, positive to the left) of each piece."""
    lanes: int = Field(default=2, ge=0, le=10)
    one_way: bool = False
    lane_width: Length = 3.3
    edge: tuple[float, float] = (0.3, 0.3)
    """Paved width beyond the outer lanes, left and right: shoulders, parking."""
    surface: SurfaceKind = "asphalt"
    colour: Colour = (0.1, 0.1, 0.105)
    wear: Share = 0.4
    kerb: float = Field(default=0.12, ge=0.0, le=0.5)
    """Height; 0 for none."""
    pavement: tuple[float, float] = (2.5, 2.5)
    """Width, left and right; 0 for none."""
    pavement_surface: SurfaceKind = "slabs"
    pavement_colour: Colour = (0.3, 0.29, 0.27)
    centre_line: Line = "dashed"
    centre_colour: Colour = (0.7, 0.7, 0.68)
    edge_lines: bool = False
    markings_wear: Share = 0.3
    crossings: tuple[float, ...] = ()
    """s of each zebra crossing."""
    arrows: tuple[float, ...] = ()
    """s at which arrows are painted on the lanes."""
    banks: tuple[Bank | None, Bank | None] = (None, None)
    """Left and right."""

    @model_validator(mode="after")
    def _check(self) -> Road:
        if not self.bends:
            raise ValueError("bends: a road needs at least one piece")
        tight = [curvature for _, curvature in self.bends if abs(curvature) > 0.2]
        if tight:
            raise ValueError(f"bends: curvature {tight[0]} is tighter than a radius of 5 m")
        if any(length <= 0 for length, _ in self.bends):
            raise ValueError(f"bends: {min(self.bends)[0]} m is no length")
        return self


class Placed(Part):
    """Something that stands somewhere."""

    at: Point
    """Along a road and to its left, or x and y."""
    yaw: float = 0.0
    road: int | None = 0
    """Number of the road that `at` and `yaw` refer to."""


class Patch(Placed):
    """A piece of ground of another surface, as wide as `size` around `at`."""

    size: tuple[Length, Length]
    surface: SurfaceKind = "asphalt"
    colour: Colour = (0.12, 0.12, 0.12)
    second: Colour = (0.16, 0.15, 0.12)
    bays: Length | None = None
    """Width of parking bays that are painted on it."""


class Building(Placed):
    """A building; yaw 0 has its front, which faces -y, along the road's right side."""

    size: tuple[Length, Length, Length]
    """Front's length, depth, height of the walls."""
    wall: WallKind = "plaster"
    colour: Colour = (0.5, 0.46, 0.4)
    trim: Colour = (0.55, 0.53, 0.5)
    glass: Colour = (0.04, 0.05, 0.06)
    storey: Length = 3.2
    bay: Length = 3.0
    window: tuple[Share, Share] = (0.45, 0.5)
    """Width and height of windows as shares of bay and storey."""
    windows: Literal["single", "divided", "bands", "curtain"] = "single"
    ground_floor: Literal["same", "shop", "gates", "blind", "arcade"] = "same"
    roof: Literal["flat", "gable", "hip", "shed", "saw"] = "flat"
    roof_height: float = Field(default=0.4, ge=0.0, le=20.0)
    roof_colour: Colour = (0.15, 0.1, 0.08)
    balconies: bool = False
    seed: int = 0
    """Of its details."""


class Barrier(Part):
    """A wall, fence or hedge along a line."""

    kind: BarrierKind
    line: tuple[Point, ...] = Field(min_length=2)
    """Corner points, as `at` of other parts."""
    road: int | None = 0
    height: Length = 1.5
    colour: Colour = (0.3, 0.28, 0.25)
    seed: int = 0


class Tree(Placed):
    """A tree or bush."""

    kind: TreeKind = "broadleaf"
    height: Length = 8.0
    width: Length = 5.0
    """Of the crown."""
    trunk: Share = 0.3
    """Share of the height that is bare."""
    colour: Colour = (0.07, 0.12, 0.03)
    seed: int = 0


class Furniture(Placed):
    """Something that stands in a street."""

    kind: FurnitureKind
    height: Length | None = None
    """Without it, what is usual."""
    colour: Colour = (0.25, 0.25, 0.25)
    seed: int = 0


class Wires(Part):
    """Wires from pole to pole."""

    line: tuple[Point, ...] = Field(min_length=2)
    road: int | None = 0
    height: Length = 8.0
    sag: float = Field(default=0.5, ge=0.0)
    count: int = Field(default=3, ge=1, le=12)


class Structure(Placed):
    """A large structure over or beside a road."""

    kind: StructureKind
    size: tuple[Length, Length, Length]
    """Along x, along y, and the clear height."""
    colour: Colour = (0.3, 0.29, 0.28)
    seed: int = 0


class Motion(Part):
    """How a road user moves; by default along its road, at its own distance from the middle."""

    speeds: Speeds = ((0.0, 8.0),)
    """Time and speed; in between the speed changes evenly, before and after it stays."""
    bends: tuple[Point, ...] | None = None
    """Length and curvature of each piece of its own way."""


class Vehicle(Placed):
    """A parked or moving vehicle; yaw 0 drives in the road's direction."""

    kind: VehicleKind = "saloon"
    colour: Colour = (0.3, 0.3, 0.32)
    motion: Motion | None = None
    """None is parked."""
    seed: int = 0


class Person(Placed):
    """Somebody on foot or on two wheels."""

    kind: PersonKind = "pedestrian"
    colour: Colour = (0.1, 0.12, 0.2)
    second: Colour = (0.05, 0.05, 0.08)
    motion: Motion | None = None
    """None stands."""
    seed: int = 0


class Drive(Placed):
    """How the vehicle that carries the sensors drives through this world."""

    speeds: Speeds = ((0.0, 8.0),)
    """As for `Motion`; negative speeds drive backwards."""
    bends: tuple[Point, ...] | None = None
    """Its own way; without it, along its road at its own distance from the middle."""


class WorldSpec(Part):
    """The content of a world file."""

    name: str = "world"
    kind: str = "own"
    seed: int = 0
    """Of every detail that has none of its own."""
    sky: Sky = Sky()
    ground: Ground = Ground()
    roads: tuple[Road, ...] = ()
    horizon: tuple[Horizon, ...] = ()
    patches: tuple[Patch, ...] = ()
    buildings: tuple[Building, ...] = ()
    barriers: tuple[Barrier, ...] = ()
    trees: tuple[Tree, ...] = ()
    furniture: tuple[Furniture, ...] = ()
    wires: tuple[Wires, ...] = ()
    structures: tuple[Structure, ...] = ()
    vehicles: tuple[Vehicle, ...] = ()
    people: tuple[Person, ...] = ()
    drive: Drive = Drive(at=(0.0, 0.0), road=None)

    @model_validator(mode="after")
    def _check(self) -> WorldSpec:
        placed = {name: getattr(self, name) for name in type(self).model_fields if name != "roads"}
        lists = {name: parts for name, parts in placed.items() if isinstance(parts, tuple) and name != "horizon"}
        for name, parts in (lists | {"drive": (self.drive,)}).items():
            for number, part in enumerate(parts):
                road = part.road
                if road is not None and not 0 <= road < len(self.roads):
                    raise ValueError(f"{name}.{number}.road: there is no road {road}, only {len(self.roads)} in all")
        return self
