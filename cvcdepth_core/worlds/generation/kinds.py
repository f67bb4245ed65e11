# SPDX-License-Identifier: Apache-2.0
"""What kinds of places there are, and how often each thing is met in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from cvcdepth_core.worlds.description import BarrierKind, SurfaceKind, WallKind

WorldKind = Literal[
    "city", "suburb", "rural", "forest", "highway", "square", "yard", "industrial", "tunnel", "parking_deck"
]
Range = tuple[float, float]
HorizonKind = Literal["hills", "woods", "town"]


@dataclass(frozen=True)
class Kind:
    """One kind of place. Lengths in metres, speeds in m/s; shares are chances or densities from 0 to 1."""

    weight: float
    """How often it is chosen when nobody asks for a kind."""
    lanes: tuple[int, ...]
    speed: Range
    edge: Range = (0.2, 0.6)
    parking: float = 0.0
    """Chance, on each side, of an edge that is wide enough to park on."""
    open_width: Range = (20.0, 50.0)
    """Width of the paved place where there are no lanes."""
    one_way: float = 0.0
    surfaces: Mapping[SurfaceKind, float] = field(default_factory=dict)
    pavement: Range = (0.0, 0.0)
    edge_lines: float = 0.2
    curved: float = 0.4
    radius: Range = (60.0, 500.0)
    hilly: float = 0.6
    banks: float = 0.1
    grounds: Mapping[SurfaceKind, float] = field(default_factory=dict)
    crossing: float = 0.0
    """Chance of a crossing road."""
    crossing_at: float = 45.0
    """Metres ahead of the start."""
    buildings: float = 0.0
    """Share of the roadside that is built up."""
    setback: Range = (1.0, 6.0)
    heights: Range = (4.0, 10.0)
    lengths: Range = (8.0, 24.0)
    gap: Range = (0.0, 6.0)
    walls: Mapping[WallKind, float] = field(default_factory=dict)
    pitched: float = 0.3
    """Share of roofs that are pitched."""
    shops: float = 0.0
    skyline: Range = (0, 4)
    """How many large buildings stand farther off."""
    street_trees: float = 0.0
    trees: Range = (0, 10)
    """Single trees behind the road."""
    woods: Range = (0, 0)
    """Trees of a wood."""
    horizon: Mapping[HorizonKind, float] = field(default_factory=dict)
    """Chance of each thing far away."""
    tall_grass: float = 0.0
    """Chance of tall grass beside the road."""
    bushes: Range = (0, 10)
    barriers: float = 0.3
    barrier_kinds: tuple[BarrierKind, ...] = ("wall", "brick_wall", "fence", "railing", "mesh", "hedge")
    lamps: float = 0.7
    wires: float = 0.2
    signs: Range = (0, 8)
    clutter: Range = (0, 12)
    traffic: Range = (0.0, 0.7)
    """Share of the places in moving lanes that are taken."""
    parked: Range = (0.0, 0.8)
    people: Range = (0, 8)
    cyclists: Range = (0, 2)


_SEALED: Mapping[SurfaceKind, float] = {"asphalt": 0.85, "concrete": 0.1, "cobbles": 0.05}
_TOWN_GROUND: Mapping[SurfaceKind, float] = {"asphalt": 0.3, "concrete": 0.2, "slabs": 0.2, "gravel": 0.1, "grass": 0.2}
_GREEN: Mapping[SurfaceKind, float] = {"grass": 0.88, "dirt": 0.07, "sand": 0.02, "snow": 0.03}
_TOWN_WALLS: Mapping[WallKind, float] = {"plaster": 0.38, "brick": 0.28, "panels": 0.15, "glass": 0.14, "metal": 0.05}
_HOUSE_WALLS: Mapping[WallKind, float] = {"plaster": 0.4, "brick": 0.3, "boards": 0.3}

KINDS: Mapping[WorldKind, Kind] = {
    "city": Kind(
        horizon={"town": 0.9, "hills": 0.2},
        tall_grass=0.05,
        weight=0.27,
        lanes=(2, 2, 2, 3, 4, 4),
        speed=(3.0, 13.0),
        edge=(0.3, 0.8),
        parking=0.6,
        one_way=0.25,
        surfaces=_SEALED,
        pavement=(1.8, 5.0),
        edge_lines=0.15,
        curved=0.25,
        hilly=0.6,
        grounds=_TOWN_GROUND,
        crossing=0.6,
        buildings=0.92,
        setback=(0.0, 3.0),
        heights=(6.0, 26.0),
        lengths=(8.0, 30.0),
        gap=(0.0, 0.0),
        walls=_TOWN_WALLS,
        pitched=0.25,
        shops=0.5,
        skyline=(2, 10),
        street_trees=0.55,
        trees=(0, 6),
        bushes=(0, 6),
        barriers=0.2,
        lamps=0.85,
        wires=0.25,
        signs=(2, 14),
        clutter=(2, 26),
        traffic=(0.05, 0.9),
        parked=(0.0, 0.95),
        people=(0, 28),
        cyclists=(0, 4),
    ),
    "suburb": Kind(
        horizon={"town": 0.35, "woods": 0.45, "hills": 0.4},
        tall_grass=0.25,
        weight=0.25,
        lanes=(2,),
        speed=(4.0, 12.0),
        edge=(0.2, 0.6),
        parking=0.4,
        surfaces=_SEALED,
        pavement=(0.0, 2.8),
        curved=0.5,
        radius=(40.0, 300.0),
        hilly=0.8,
        banks=0.35,
        grounds={"grass": 0.8, "gravel": 0.1, "dirt": 0.06, "snow": 0.04},
        crossing=0.3,
        buildings=0.75,
        setback=(3.0, 14.0),
        heights=(2.8, 7.5),
        lengths=(8.0, 17.0),
        gap=(3.0, 14.0),
        walls=_HOUSE_WALLS,
        pitched=0.85,
        skyline=(0, 3),
        street_trees=0.4,
        trees=(6, 45),
        woods=(0, 60),
        bushes=(4, 40),
        barriers=0.55,
        barrier_kinds=("wall", "brick_wall", "fence", "fence", "railing", "mesh", "hedge", "hedge"),
        lamps=0.6,
        wires=0.5,
        signs=(0, 7),
        clutter=(0, 14),
        traffic=(0.0, 0.35),
        parked=(0.0, 0.8),
        people=(0, 9),
        cyclists=(0, 3),
    ),
    "rural": Kind(
        horizon={"town": 0.1, "woods": 0.65, "hills": 0.55},
        tall_grass=0.6,
        weight=0.12,
        lanes=(1, 2, 2, 2),
        speed=(6.0, 20.0),
        edge=(0.1, 0.8),
        surfaces={"asphalt": 0.75, "gravel": 0.12, "dirt": 0.13},
        edge_lines=0.4,
        curved=0.65,
        radius=(60.0, 500.0),
        hilly=0.9,
        banks=0.6,
        grounds=_GREEN,
        crossing=0.15,
        buildings=0.1,
        setback=(6.0, 25.0),
        heights=(3.0, 8.0),
        gap=(10.0, 40.0),
        walls={"plaster": 0.35, "brick": 0.25, "boards": 0.25, "metal": 0.15},
        pitched=0.9,
        skyline=(0, 2),
        street_trees=0.15,
        trees=(4, 50),
        woods=(0, 130),
        bushes=(2, 45),
        barriers=0.4,
        barrier_kinds=("fence", "mesh", "hedge", "guard_rail", "wall"),
        lamps=0.15,
        wires=0.55,
        signs=(0, 6),
        clutter=(0, 4),
        traffic=(0.0, 0.35),
        parked=(0.0, 0.05),
        people=(0, 2),
        cyclists=(0, 2),
    ),
    "forest": Kind(
        horizon={"woods": 0.95, "hills": 0.3},
        tall_grass=0.6,
        weight=0.07,
        lanes=(1, 2),
        speed=(3.0, 14.0),
        edge=(0.0, 0.6),
        surfaces={"asphalt": 0.5, "gravel": 0.25, "dirt": 0.25},
        curved=0.75,
        radius=(40.0, 300.0),
        hilly=0.9,
        banks=0.6,
        grounds={"grass": 0.55, "dirt": 0.4, "snow": 0.05},
        buildings=0.02,
        walls={"boards": 1.0},
        pitched=1.0,
        skyline=(0, 0),
        trees=(20, 60),
        woods=(120, 260),
        bushes=(20, 80),
        barriers=0.12,
        barrier_kinds=("fence", "guard_rail"),
        lamps=0.03,
        wires=0.15,
        signs=(0, 3),
        clutter=(0, 3),
        traffic=(0.0, 0.15),
        parked=(0.0, 0.03),
        people=(0, 3),
        cyclists=(0, 2),
    ),
    "highway": Kind(
        horizon={"town": 0.4, "woods": 0.5, "hills": 0.45},
        tall_grass=0.5,
        weight=0.09,
        lanes=(3, 4, 4, 5, 6),
        speed=(12.0, 28.0),
        edge=(1.0, 3.2),
        one_way=0.4,
        surfaces={"asphalt": 0.8, "concrete": 0.2},
        edge_lines=0.95,
        curved=0.4,
        radius=(250.0, 900.0),
        hilly=0.8,
        banks=0.75,
        grounds=_GREEN,
        buildings=0.12,
        setback=(12.0, 40.0),
        heights=(5.0, 18.0),
        gap=(10.0, 60.0),
        walls={"metal": 0.4, "panels": 0.3, "glass": 0.2, "brick": 0.1},
        pitched=0.1,
        skyline=(0, 8),
        trees=(5, 50),
        woods=(0, 120),
        bushes=(0, 40),
        barriers=0.8,
        barrier_kinds=("guard_rail", "guard_rail", "concrete_barrier", "wall", "mesh"),
        lamps=0.4,
        wires=0.15,
        signs=(0, 6),
        clutter=(0, 1),
        traffic=(0.1, 0.9),
        parked=(0.0, 0.0),
    ),
    "square": Kind(
        horizon={"town": 0.8},
        weight=0.05,
        lanes=(0,),
        speed=(1.5, 5.0),
        open_width=(24.0, 60.0),
        surfaces={"slabs": 0.4, "cobbles": 0.4, "concrete": 0.2},
        pavement=(0.0, 5.0),
        edge_lines=0.0,
        curved=0.0,
        hilly=0.4,
        grounds=_TOWN_GROUND,
        buildings=0.9,
        setback=(0.0, 4.0),
        heights=(6.0, 24.0),
        gap=(0.0, 2.0),
        walls=_TOWN_WALLS,
        pitched=0.4,
        shops=0.7,
        skyline=(1, 6),
        street_trees=0.5,
        trees=(0, 10),
        bushes=(0, 8),
        barriers=0.15,
        signs=(1, 8),
        clutter=(10, 45),
        traffic=(0.0, 0.0),
        parked=(0.0, 0.25),
        people=(6, 45),
        cyclists=(0, 6),
    ),
    "yard": Kind(
        horizon={"town": 0.6, "woods": 0.2},
        tall_grass=0.15,
        weight=0.04,
        lanes=(0,),
        speed=(1.0, 4.0),
        open_width=(18.0, 50.0),
        surfaces={"asphalt": 0.5, "concrete": 0.4, "gravel": 0.1},
        edge_lines=0.0,
        curved=0.0,
        hilly=0.3,
        grounds={"asphalt": 0.4, "concrete": 0.3, "gravel": 0.2, "grass": 0.1},
        buildings=0.7,
        setback=(0.0, 8.0),
        heights=(4.0, 13.0),
        lengths=(15.0, 45.0),
        gap=(0.0, 12.0),
        walls={"metal": 0.5, "panels": 0.25, "brick": 0.25},
        pitched=0.25,
        skyline=(0, 5),
        trees=(0, 10),
        bushes=(0, 10),
        barriers=0.6,
        barrier_kinds=("mesh", "wall", "railing", "concrete_barrier"),
        lamps=0.5,
        signs=(0, 3),
        clutter=(8, 40),
        traffic=(0.0, 0.0),
        parked=(0.1, 0.8),
        people=(0, 8),
    ),
    "industrial": Kind(
        horizon={"town": 0.7, "woods": 0.3, "hills": 0.3},
        tall_grass=0.25,
        weight=0.06,
        lanes=(2, 2, 3),
        speed=(4.0, 13.0),
        edge=(0.3, 1.0),
        parking=0.5,
        surfaces=_SEALED,
        pavement=(0.0, 3.0),
        curved=0.25,
        hilly=0.4,
        banks=0.15,
        grounds={"asphalt": 0.35, "concrete": 0.2, "gravel": 0.2, "grass": 0.25},
        crossing=0.4,
        buildings=0.65,
        setback=(3.0, 18.0),
        heights=(4.5, 13.0),
        lengths=(18.0, 50.0),
        gap=(3.0, 25.0),
        walls={"metal": 0.4, "panels": 0.25, "brick": 0.2, "plaster": 0.15},
        pitched=0.3,
        skyline=(1, 7),
        street_trees=0.2,
        trees=(0, 20),
        bushes=(0, 20),
        barriers=0.65,
        barrier_kinds=("mesh", "mesh", "railing", "wall", "brick_wall"),
        lamps=0.6,
        wires=0.6,
        signs=(1, 8),
        clutter=(4, 26),
        traffic=(0.0, 0.6),
        parked=(0.1, 0.9),
        people=(0, 5),
        cyclists=(0, 1),
    ),
    "tunnel": Kind(
        horizon={"hills": 0.9, "woods": 0.4},
        tall_grass=0.3,
        weight=0.03,
        lanes=(2, 2, 3, 4),
        speed=(8.0, 18.0),
        edge=(0.4, 1.2),
        surfaces=_SEALED,
        pavement=(0.8, 1.2),
        edge_lines=0.7,
        curved=0.0,
        hilly=0.0,
        grounds=_GREEN,
        walls=_TOWN_WALLS,
        trees=(0, 20),
        barriers=0.0,
        lamps=0.3,
        signs=(0, 3),
        clutter=(0, 1),
        traffic=(0.05, 0.7),
        parked=(0.0, 0.0),
    ),
    "parking_deck": Kind(
        horizon={"town": 0.7},
        weight=0.02,
        lanes=(0,),
        speed=(1.0, 3.5),
        open_width=(31.0, 46.0),
        surfaces={"concrete": 1.0},
        edge_lines=0.0,
        curved=0.0,
        hilly=0.0,
        grounds={"concrete": 0.5, "asphalt": 0.5},
        walls=_TOWN_WALLS,
        barriers=0.0,
        lamps=0.0,
        signs=(0, 2),
        clutter=(0, 5),
        traffic=(0.0, 0.0),
        parked=(0.2, 0.9),
        people=(0, 4),
    ),
}
