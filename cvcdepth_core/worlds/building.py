# SPDX-License-Identifier: Apache-2.0
"""From a world's description to the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.worlds.description import Sky, Weather, WorldSpec
from cvcdepth_core.worlds.rendering.light import Lamps, Light, sun_direction, sunlight
from cvcdepth_core.worlds.shapes.barriers import build_barriers, build_wires
from cvcdepth_core.worlds.shapes.buildings import build_buildings
from cvcdepth_core.worlds.shapes.furniture import LAMP_ARM, build_furniture, furniture_height
from cvcdepth_core.worlds.shapes.ground import build_ground, build_patches
from cvcdepth_core.worlds.shapes.horizon import build_horizon, build_tall_grass
from cvcdepth_core.worlds.shapes.meshes import Mesh
from cvcdepth_core.worlds.shapes.own_body import BodyKind, own_body
from cvcdepth_core.worlds.shapes.people import build_people, person_mesh
from cvcdepth_core.worlds.shapes.roads import build_roads
from cvcdepth_core.worlds.shapes.structures import build_structures, ceiling_lamps
from cvcdepth_core.worlds.shapes.trees import build_trees
from cvcdepth_core.worlds.shapes.vehicles import build_vehicles, vehicle_mesh
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.trajectories import Trajectory, person_trajectory, vehicle_trajectory
from cvcdepth_core.worlds.world import Mover, World

_SKY_LIGHT: dict[Weather, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "clear": ((0.22, 0.4, 0.82), (0.72, 0.82, 0.95)),
    "cloudy": ((0.3, 0.45, 0.8), (0.75, 0.82, 0.92)),
    "overcast": ((0.95, 1.0, 1.08), (0.85, 0.89, 0.95)),
    "dusk": ((0.07, 0.1, 0.2), (0.3, 0.24, 0.24)),
    "night": ((0.006, 0.007, 0.012), (0.02, 0.018, 0.018)),
}
_LAMP_COLOUR, _LAMP_HEAD = np.array([1.0, 0.78, 0.5]), 0.9


class Built(NamedTuple):
    """A world and the vehicle that drives through it."""

    world: World
    way: Trajectory
    """Of the vehicle's base frame, which is on the ground."""
    body: Mesh | None
    """Of that vehicle, in its base frame."""


def build_world(
    spec: WorldSpec, body: BodyKind = "none", base_T_cameras: Sequence[Pose] = (), body_seed: int = 0
) -> Built:
    """Build a world, and the vehicle's body so that the cameras are outside of it."""
    site = Site(spec)
    build_ground(site)
    build_roads(site)
    build_patches(site)
    build_horizon(site)
    build_tall_grass(site)
    for build in (build_buildings, build_structures, build_barriers, build_wires, build_trees, build_furniture):
        build(site)
    build_vehicles(site)
    build_people(site)
    movers = (*_moving_vehicles(site), *_moving_people(site))
    own = own_body(site, body, base_T_cameras, body_seed)
    mesh, objects = site.mesh()
    light = build_light(spec.sky, _lamps(site))
    world = World(mesh, objects, tuple(site.names), movers, site.table.array(), light)
    return Built(world, vehicle_trajectory(site, spec.drive, spec.drive), own)


def build_light(sky: Sky, lamps: Lamps) -> Light:
    """Sky, sun and haze."""
    zenith, horizon = (np.array(colour) * sky.brightness for colour in _SKY_LIGHT[sky.weather])
    direct = np.zeros(3)
    if sky.weather in ("clear", "cloudy") or (sky.weather == "dusk" and sky.sun_elevation > 0):
        direct = sunlight(sky.sun_elevation)
    low = np.clip(1.0 - sky.sun_elevation / 25.0, 0.0, 1.0) * (sky.weather in ("clear", "cloudy"))
    horizon = horizon * (1.0 - low * np.array([0.05, 0.2, 0.42]))
    zenith = zenith * (1.0 - 0.4 * low)
    sun = sun_direction(sky.sun_azimuth, sky.sun_elevation)
    above = 0.5 * (zenith + horizon)
    rng = np.random.default_rng([sky.seed, 37])
    u, v = rng.uniform(0, 256, 2).tolist()
    return Light(
        sun=sun,
        sunlight=direct,
        zenith=zenith,
        horizon=horizon,
        ground=0.16 * (above + direct * max(float(sun[2]), 0.0)),
        glow=1.0,
        cloud=0.85 * above + 0.15 * direct,
        cover=sky.clouds,
        cloud_scale=float(rng.uniform(25.0, 60.0)),
        cloud_offset=(u, v),
        visibility=sky.visibility,
        lamps=lamps,
        dark=sky.weather in ("dusk", "night"),
    )


def _moving_vehicles(site: Site) -> list[Mover]:
    found = []
    for vehicle in site.spec.vehicles:
        if vehicle.motion is not None:
            mesh = vehicle_mesh(site, vehicle)
            length = float(np.ptp(mesh.vertices[:, 0]))
            way = vehicle_trajectory(site, vehicle, vehicle.motion, length)
            found.append(Mover(site.new_object(vehicle.kind), mesh, way, headlights=True))
    return found


def _moving_people(site: Site) -> list[Mover]:
    return [
        Mover(site.new_object(person.kind), person_mesh(site, person), person_trajectory(site, person, person.motion))
        for person in site.spec.people
        if person.motion is not None
    ]


def _lamps(site: Site) -> Lamps:
    """Street lamps when it is dark, and lamps under ceilings at any time."""
    positions, strengths = [], []
    for structure in site.spec.structures:
        place = site.place(structure)
        c, s = math.cos(place.yaw), math.sin(place.yaw)
        for x, y, z in ceiling_lamps(structure):
            positions.append((place.x + c * x - s * y, place.y + s * x + c * y, place.z + z - 0.15))
            strengths.append(3.2)
    if site.spec.sky.weather in ("dusk", "night"):
        for item in site.spec.furniture:
            if item.kind == "lamp":
                place = site.place(item)
                reach = LAMP_ARM + 0.2
                x, y = place.x - math.sin(place.yaw) * reach, place.y + math.cos(place.yaw) * reach
                height = furniture_height(item)
                positions.append((x, y, place.z + height - 0.25))
                strengths.append(0.22 * height * height)
    if not positions:
        return Lamps.none()
    count = len(positions)
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    return Lamps(np.array(positions), np.outer(strengths, _LAMP_COLOUR), down, np.full(count, _LAMP_HEAD))
