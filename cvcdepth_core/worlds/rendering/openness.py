# SPDX-License-Identifier: Apache-2.0
"""How much of the sky reaches each pixel's place: the soft shadows in corners and under vehicles."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cvcdepth_core.worlds.rendering.scene import Rays, Scene
from cvcdepth_core.worlds.shapes.meshes import Floats

if TYPE_CHECKING:
    from cvcdepth_core.worlds.rendering.renderer import Truth

_REACH = 5.0  # metres: what is farther away darkens nothing
_FARTHEST = 150.0  # metres from the camera: beyond, nothing is looked at
_SIDE = 4  # each pixel looks one of 4 x 4 ways, and takes the mean of those around it


def openness(scene: Scene, rays: Rays, distances: Floats, truth: Truth) -> Floats:
    """Share [H, W] of the hemisphere over each pixel's place that is open, float32.

    `distances` [N] are those along the rays, in the pixels' order.
    """
    shape = truth.depth.shape
    near = np.flatnonzero(distances < _FARTHEST)
    normals = truth.normals.reshape(-1, 3)[near].astype(np.float64)
    places = rays.origins[near] + rays.directions[near] * distances[near, None]
    lift = 2e-3 + 2e-4 * distances[near]
    directions = _hemisphere(normals, _pattern(*shape).reshape(-1, 3)[near])
    blocked = scene.blocked(places + normals * lift[:, None], directions, _REACH)
    open_ways = np.ones(distances.shape, np.float32)
    open_ways[near] = ~blocked
    return _mean_around(open_ways.reshape(shape), truth)


def _pattern(height: int, width: int) -> Floats:
    """Direction [H, W, 3] about the z axis that each pixel looks, weighted by the cosine as light is."""
    count = _SIDE * _SIDE
    order = np.array([0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5])
    radius = np.sqrt((order + 0.5) / count)
    angle = order * math.pi * (3 - math.sqrt(5))
    ways = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=-1)
    tile = ways.reshape(_SIDE, _SIDE, 3)
    return np.tile(tile, (-(-height // _SIDE), -(-width // _SIDE), 1))[:height, :width]


def _hemisphere(normals: Floats, ways: Floats) -> Floats:
    """Turn `ways` [N, 3] from about the z axis to about unit normals [N, 3] (Duff et al. 2017)."""
    x, y, z = normals.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    found: Floats = first * ways[:, :1] + second * ways[:, 1:2] + normals * ways[:, 2:]
    return found


def _mean_around(values: Floats, truth: Truth) -> Floats:
    """Mean [H, W] over 4 x 4 pixels, of those that lie on the same surface."""
    height, width = values.shape
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.where(np.isfinite(truth.depth), 1.0 / truth.depth, 0.0).astype(np.float32)
    pad = ((2, 1), (2, 1))
    wide = [np.pad(a, pad, mode="edge") for a in (values, inverse, truth.objects)]
    normals = np.pad(truth.normals, (*pad, (0, 0)), mode="edge")
    total, count = np.zeros_like(values), np.zeros_like(values)
    for dy in range(_SIDE):
        for dx in range(_SIDE):
            value, other, owner = (a[dy : dy + height, dx : dx + width] for a in wide)
            normal = normals[dy : dy + height, dx : dx + width]
            level = (normal * truth.normals).sum(axis=-1) > 0.9
            near = np.abs(other - inverse) < 0.06 * inverse
            weight = (near & (level | (owner == truth.objects))).astype(np.float32)
            total += value * weight
            count += weight
    return np.where(count > 0, total / np.maximum(count, 1.0), values).astype(np.float32)
