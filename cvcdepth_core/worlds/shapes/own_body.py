# SPDX-License-Identifier: Apache-2.0
"""The body of the vehicle that carries the sensors: below and between its cameras, never around them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.worlds.description import VehicleKind
from cvcdepth_core.worlds.generation.dice import Dice
from cvcdepth_core.worlds.rendering.ray_engine import Hits, TriangleScene
from cvcdepth_core.worlds.rendering.scene import Rays, Scene
from cvcdepth_core.worlds.shapes.meshes import Floats, Mesh, box, cylinder, joined
from cvcdepth_core.worlds.shapes.vehicles import car_mesh
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.palette import metal, paint, rubber
from cvcdepth_core.worlds.world import OWN_VEHICLE, Way

BodyKind = Literal["none", "car", "van", "robot"]
_CLEAR = 0.07  # metres between a camera and the body below it
_FLATTEST = 0.35
_FOOTPRINT = (4.4, 1.7)  # metres: what of a vehicle must not stand in anything
_HEIGHTS = (0.5, 1.0)
_MOSTLY = 6  # of eight directions


def own_body(site: Site, kind: BodyKind, base_T_cameras: Sequence[Pose], seed: int) -> Mesh | None:
    """Return the body in the base frame; None for none. Its roof is lowered until all cameras are outside.

    ConfigError says so where a camera is too low for such a body.
    """
    if kind == "none":
        return None
    dice = Dice(seed, 43)
    places = np.array([pose[:3, 3] for pose in base_T_cameras])
    middle = (places[:, 0].min() + places[:, 0].max()) / 2
    if kind == "robot":
        body = _robot(site, dice, places - (middle, 0, 0))
    else:
        model: VehicleKind = dice.pick("saloon", "estate", "suv", "hatchback") if kind == "car" else "van"
        body = car_mesh(site, model, dice.paint(), np.random.default_rng([seed, 47]))
    body = body.moved(x=middle)
    factor = _flattening(body, places)
    if factor < _FLATTEST:
        raise ConfigError(f"body {kind}: a camera {places[:, 2].min():.2f} m above the ground would be inside of it")
    return body.scaled(1.0, 1.0, factor)


def _flattening(body: Mesh, cameras: Floats) -> float:
    """Factor for the body's heights that leaves every camera above what is below it."""
    scene = TriangleScene(body.vertices[body.faces])
    above = np.c_[cameras[:, :2], np.full(len(cameras), 10.0)].astype(np.float32)
    down = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (len(cameras), 1))
    hits: Hits = scene.nearest(above, down)
    tops = 10.0 - hits.distances
    factors = np.where(hits.faces >= 0, (cameras[:, 2] - _CLEAR) / np.maximum(tops, 0.1), 1.0)
    return min(1.0, float(factors.min()))


def _robot(site: Site, dice: Dice, cameras: Floats) -> Mesh:
    """Return A low platform on four wheels with a mast."""
    skin, black = site.material(paint(dice.paint())), site.material(rubber())
    steel = site.material(metal((0.3, 0.3, 0.3)))
    length, width = 2 * max(0.3, np.abs(cameras[:, 0]).max() * 0.9), 2 * max(0.25, np.abs(cameras[:, 1]).max() * 0.8)
    parts = [box(length, width, 0.35, skin, 0.15, (0.9, 0.9)), cylinder(0.04, max(0.1, cameras[:, 2].min()), steel, 8)]
    for x in (-0.35, 0.35):
        for side in (-1.0, 1.0):
            wheel = cylinder(0.15, 0.1, black, 12).transformed(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]))
            parts.append(wheel.moved(x * length, side * width / 2 + 0.05, 0.15))
    return joined(parts)


def check_start(scene: Scene, way: Way) -> None:
    """Raise ConfigError, naming the object and the place, if the vehicle would begin its drive inside of something."""
    pose = way.pose(0.0)
    scene.set_moment(0.0, pose, 0.0)
    found = _standing_in(scene, pose)
    if found is None:
        found = _enclosing(scene, pose)
    if found is not None:
        x, y, _ = pose[:3, 3].tolist()
        name = scene.world.names[found]
        raise ConfigError(f"the vehicle starts inside of something: {name} at x {x:.1f}, y {y:.1f}")


def _standing_in(scene: Scene, pose: Pose) -> int | None:
    """Return the object that sides or diagonals of the vehicle's outline run through."""
    length, width = _FOOTPRINT
    corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) * (length / 2, width / 2) + (0.8, 0.0)
    lines = [(corners[a], corners[b]) for a, b in ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3))]
    starts = np.array([(*a, z) for z in _HEIGHTS for a, _ in lines])
    ends = np.array([(*b, z) for z in _HEIGHTS for _, b in lines])
    lengths = np.linalg.norm(ends - starts, axis=1)
    hits = scene.nearest(_placed(starts, (ends - starts) / lengths[:, None], pose))
    objects = scene.faces.objects[np.maximum(hits.faces, 0)]
    met = np.flatnonzero((hits.faces >= 0) & (hits.distances < lengths) & (objects != OWN_VEHICLE))
    return int(objects[met[0]]) if len(met) else None


def _enclosing(scene: Scene, pose: Pose) -> int | None:
    """Return the object whose walls are seen from behind all around."""
    angles = np.arange(8) * np.pi / 4
    ways = np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], axis=1)
    rays = _placed(np.tile([0.8, 0.0, 1.0], (8, 1)), ways, pose)
    hits = scene.nearest(rays)
    faces = np.maximum(hits.faces, 0)
    behind = np.einsum("ni,ni->n", scene.faces.plane[faces, :3], rays.directions) > 0
    seen = scene.faces.objects[faces][(hits.faces >= 0) & behind & (scene.faces.objects[faces] != OWN_VEHICLE)]
    return int(seen[0]) if len(seen) >= _MOSTLY and (seen == seen[0]).all() else None


def _placed(starts: Floats, ways: Floats, pose: Pose) -> Rays:
    return Rays(starts @ pose[:3, :3].T + pose[:3, 3], ways @ pose[:3, :3].T)
