# SPDX-License-Identifier: Apache-2.0
"""The ground between and beyond the roads, and pieces of other surface on it."""

from __future__ import annotations

import numpy as np

from cvcdepth_core.worlds.description import Patch
from cvcdepth_core.worlds.shapes.meshes import Floats, Mesh, flat_mesh, grid, joined
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.palette import ground_material, marking

_FINE, _COARSE = 2.5, 9.0  # metres
_FINE_AROUND = 22.0  # metres around roads
_BELOW_ROADS = 0.35
_BELOW = 0.02  # metres that the ground lies below what is laid on it
_HORIZON = (350.0, 700.0, 1500.0, 3500.0)
_ON_GROUND = 0.025


def build_ground(site: Site) -> None:
    """Add the ground; it has to be there before the roads."""
    ground = site.spec.ground
    number = site.new_object("ground")
    material = site.material(ground_material(ground.surface, ground.colour, ground.second, site.spec.sky.wet))
    site.add(number, _terrain(site, material))


def build_patches(site: Site) -> None:
    """Add yards, lawns and parking places."""
    for patch in site.spec.patches:
        site.add(site.new_object("patch"), _patch(site, patch))


def _terrain(site: Site, material: int) -> Mesh:
    low, high = _extent(site)
    x, y = (_lines(low[i], high[i], site.spec.ground.margin) for i in (0, 1))
    grid_x, grid_y = np.meshgrid(x, y)
    points = np.c_[grid_x.reshape(-1), grid_y.reshape(-1)]
    depth = np.full(len(points), -np.inf)
    for corridor in site.corridors:
        depth = np.maximum(depth, corridor.depth(points))
    far = np.maximum(np.abs(points - (low + high) / 2) - (high - low) / 2, 0.0).max(axis=1)
    level = np.clip(1.0 - (far - site.spec.ground.margin) / 400.0, 0.0, 1.0)
    z = site.terrain.height(points) * level - _BELOW - _BELOW_ROADS * (depth > 0)
    mesh = grid(np.c_[points, z].reshape(*grid_x.shape, 3), points.reshape(*grid_x.shape, 2), material)
    # What lies under roads on all sides is never seen.
    seen = (depth[mesh.faces] < 3.0).any(axis=1)
    return Mesh(mesh.vertices, mesh.faces[seen], mesh.uv[seen], mesh.normals[seen], mesh.materials[seen])


def _extent(site: Site) -> tuple[Floats, Floats]:
    """Corners of the rectangle around all roads, or around the place where the drive begins."""
    stations = [c.path.points(np.linspace(0.0, c.path.length, 50)) for c in site.corridors]
    points = np.concatenate([*stations, [site.xy(site.spec.drive.at, site.spec.drive.road)]])
    return points.min(axis=0) - _FINE_AROUND, points.max(axis=0) + _FINE_AROUND


def _lines(low: float, high: float, margin: float) -> Floats:
    fine = np.arange(low, high + _FINE, _FINE)
    coarse = np.arange(_COARSE, margin, _COARSE)
    outward = np.r_[coarse, margin + np.array(_HORIZON)]
    found: Floats = np.r_[low - outward[::-1], fine, fine[-1] + outward]
    return found


def _patch(site: Site, patch: Patch) -> Mesh:
    place = site.place(patch)
    (length, width), c, s = patch.size, np.cos(place.yaw), np.sin(place.yaw)
    counts = [max(2, round(size / 2.0) + 1) for size in patch.size]
    u, v = np.meshgrid(np.linspace(-length / 2, length / 2, counts[0]), np.linspace(-width / 2, width / 2, counts[1]))
    material = site.material(ground_material(patch.surface, patch.colour, patch.second, site.spec.sky.wet))

    def laid(x: Floats, y: Floats, lift: float) -> Floats:
        points = np.stack([place.x + c * x - s * y, place.y + s * x + c * y], axis=-1).reshape(-1, 2)
        found: Floats = np.c_[points, site.terrain.height(points) + lift]
        return found

    parts = [grid(laid(u, v, _ON_GROUND).reshape(*u.shape, 3), np.stack([u, v], axis=-1), material)]
    if patch.bays:
        paint = site.material(marking((0.66, 0.66, 0.64), patch.colour, 0.4))
        for x in np.arange(-length / 2 + 0.5, length / 2, patch.bays):
            corners = laid(np.array([x, x + 0.1, x + 0.1, x]), np.array([-1, -1, 1, 1]) * (width / 2 - 0.3), 0.035)
            parts.append(flat_mesh(corners, [(0, 1, 2), (0, 2, 3)], paint))
    return joined(parts)
