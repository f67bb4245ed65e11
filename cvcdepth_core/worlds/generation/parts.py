# SPDX-License-Identifier: Apache-2.0
"""Everything that stands and moves beside the roads of a world that is thought up."""

from __future__ import annotations

from cvcdepth_core.worlds.description import WorldSpec
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.generation.green import barriers, trees
from cvcdepth_core.worlds.generation.houses import houses, skyline
from cvcdepth_core.worlds.generation.kinds import Kind
from cvcdepth_core.worlds.generation.layout import Layout
from cvcdepth_core.worlds.generation.places import special_places
from cvcdepth_core.worlds.generation.street import furniture, wires
from cvcdepth_core.worlds.generation.traffic import parked_vehicles, people, traffic


def furnish(world: WorldSpec, kind: Kind, layout: Layout, dice: Dice) -> WorldSpec:
    """Return the world with all that such a place has; large things take their places first."""
    special = special_places(world, layout, dice)
    moving = traffic(world, kind, layout, dice)
    buildings = houses(kind, layout, dice)
    far = skyline(kind, layout, dice)
    lines, poles = wires(kind, layout, dice)
    parked = parked_vehicles(world, kind, layout, dice)
    street = furniture(world, kind, layout, dice)
    walkers = people(world, kind, layout, dice)
    edges = barriers(kind, layout, dice)
    green = trees(kind, layout, dice)
    return world.model_copy(
        update={
            "patches": special.patches,
            "buildings": (*buildings, *far),
            "structures": special.structures,
            "barriers": edges,
            "trees": green,
            "furniture": (*poles, *street),
            "wires": lines,
            "vehicles": (*moving.vehicles, *parked, *special.vehicles),
            "people": (*moving.people, *walkers),
        }
    )
