# SPDX-License-Identifier: Apache-2.0
"""Trees, bushes and hedges: trunks and branches, and crowns of many leaves."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from cvcdepth_core.worlds.description import Tree
from cvcdepth_core.worlds.shapes.meshes import Floats, Mesh, joined, sphere, sphere_vertices, tube
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.palette import bark, darker, leaves

_VARIANTS = 4  # shapes of each kind of tree; size, turn and colour differ besides
_BARK = (0.1, 0.08, 0.062)
_WOOD, _LEAF = 0, 1  # materials of a template
_NEAR, _FAR = 7.0, 25.0  # metres from a road: nearer trees have more and smaller leaves
_AT_START = 30.0  # metres from where the drive begins, within which trees near a road have the smallest leaves


def build_trees(site: Site) -> None:
    """Add all trees."""
    for tree in site.spec.trees:
        detail = _detail(site, tree)
        template = _template(tree.kind, tree.seed % _VARIANTS, detail)
        shade = float(np.random.default_rng([site.spec.seed, tree.seed, 5]).uniform(0.8, 1.2))
        materials = np.array([site.material(bark(_BARK)), site.material(leaves(darker(tree.colour, shade)))])
        mesh = Mesh(
            template.vertices,
            template.faces,
            template.uv,
            template.normals,
            materials[template.materials].astype(np.int32),
        )
        mesh = _trunk_stretched(mesh, tree.trunk).scaled(tree.width, tree.width, tree.height)
        stretch = np.array([tree.width, tree.height])
        mesh = Mesh(mesh.vertices, mesh.faces, mesh.uv * stretch.astype(np.float32), mesh.normals, mesh.materials)
        site.stand(tree.kind, mesh.turned(float(tree.seed % 628) / 100), tree, sink=0.05)


def _detail(site: Site, tree: Tree) -> int:
    """3 for trees beside the way where the drive begins, 2 beside the rest of it, 1 behind, 0 far off."""
    x, y = site.xy(tree.at, tree.road)
    outside = min((-float(c.depth(np.array([[x, y]]))[0]) for c in site.corridors), default=0.0)
    begin = site.xy(site.spec.drive.at, site.spec.drive.road)
    if outside < _NEAR:
        return 3 if math.dist((x, y), begin) < _AT_START else 2
    return 1 if outside < _FAR else 0


def _trunk_stretched(mesh: Mesh, trunk: float) -> Mesh:
    """Templates have their crown between 0.3 and 1; move its lower end to `trunk`."""
    z = mesh.vertices[:, 2]
    moved = np.where(z < 0.3, z * trunk / 0.3, 1.0 - (1.0 - z) * (1.0 - trunk) / 0.7)
    return Mesh(np.c_[mesh.vertices[:, :2], moved], mesh.faces, mesh.uv, mesh.normals, mesh.materials)


@lru_cache(maxsize=128)
def _template(kind: str, variant: int, detail: int) -> Mesh:
    """Return A tree one metre high and wide, the crown's middle above the trunk."""
    rng = np.random.default_rng([17, variant, sum(kind.encode())])
    if kind == "bush":
        return _bush(rng, detail)
    if kind == "conifer":
        return _conifer(rng, detail)
    if kind == "palm":
        return _palm(rng, detail)
    skeleton, tips = _branches(rng, narrow=kind == "poplar", twigs=kind == "bare")
    if kind == "bare":
        return joined([skeleton])
    return joined([skeleton, _crown(rng, tips, detail, narrow=kind == "poplar")])


def _branches(rng: np.random.Generator, narrow: bool, twigs: bool) -> tuple[Mesh, Floats]:
    """Trunk and branches, and where leaves grow, [N, 3]."""
    lean = rng.normal(0, 0.015, 2)
    heights = np.linspace(0, 0.8, 6)
    trunk = np.c_[lean[0] * heights * 3, lean[1] * heights * 3, heights]
    parts = [tube(trunk, 0.028 * (1 - 0.75 * heights / 0.8), _WOOD, 7, closed=False)]
    tips = []
    for i in range(22 if twigs else 11):
        start = rng.uniform(0.28, 0.7)
        angle = i * 2.4 + rng.uniform(-0.4, 0.4)
        reach = (0.16 if narrow else 0.42) * rng.uniform(0.6, 1.0) * math.sqrt(max(0.1, 1.15 - start))
        rise = rng.uniform(0.12, 0.3)
        base = np.array([*(lean * start * 3), start])
        tip = base + np.array([reach * math.cos(angle), reach * math.sin(angle), rise])
        middle = (base + tip) / 2 + (0, 0, -0.03)
        parts.append(tube([base, middle, tip], [0.012, 0.008, 0.003], _WOOD, 5, closed=False))
        tips += [tip, middle + (tip - middle) * 0.4]
        if twigs:
            for _ in range(3):
                end = tip + rng.normal(0, 0.08, 3) + (0, 0, 0.08)
                parts.append(
                    tube(
                        [middle, (middle + end) / 2 + rng.normal(0, 0.02, 3), end],
                        [0.006, 0.004, 0.002],
                        _WOOD,
                        3,
                        False,
                    )
                )
    tips.append(np.array([0.0, 0.0, 0.82]))
    return joined(parts), np.array(tips)


def _crown(rng: np.random.Generator, tips: Floats, detail: int, narrow: bool) -> Mesh:
    """Clumps of leaves around the branches' tips, dark inside."""
    wide = 0.09 if narrow else 0.17
    clumps = []
    count = (24, 45, 110, 340)[detail]
    for tip in tips:
        centre = np.clip(tip, (-0.38, -0.38, 0.36), (0.38, 0.38, 0.9))
        radius = wide * rng.uniform(0.7, 1.15)
        flat = np.array([radius, radius, radius * rng.uniform(0.5, 0.8)])
        clumps.append(_leaves(rng, centre, flat, count, 0.34 * radius * (1.1, 0.85, 0.55, 0.28)[detail]))
        clumps.append(_core(rng, centre, 0.66 * flat, max(detail - 1, 0)))
    return joined(clumps)


def _leaves(rng: np.random.Generator, centre: Floats, radii: Floats, count: int, size: float) -> Mesh:
    """Triangles on and in an ellipsoid; their normals point mostly outwards, as light falls on a crown."""
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    places = way * radii * rng.uniform(0.55, 1.1, (count, 1))
    corners = places[:, None] + rng.normal(0, size, (count, 3, 3)) * (1, 1, 0.7)
    outward = way + 0.35 * rng.normal(size=(count, 3)) + (0, 0, 0.25)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    faces = np.arange(3 * count).reshape(-1, 3).astype(np.int32)
    normals = np.repeat(outward[:, None], 3, axis=1).astype(np.float32)
    uv = (corners[..., :2] + corners[..., 2:]).astype(np.float32)
    materials = np.full(count, _LEAF, np.int32)
    return Mesh(corners.reshape(-1, 3) + centre, faces, uv, normals, materials)


def _core(rng: np.random.Generator, centre: Floats, radii: Floats, subdivisions: int = 1) -> Mesh:
    rough = 1.0 + 0.16 * rng.normal(size=len(sphere_vertices(subdivisions)))
    return sphere(1.0, _LEAF, subdivisions, rough).scaled(*radii.tolist()).moved(*centre.tolist())


def _bush(rng: np.random.Generator, detail: int) -> Mesh:
    parts = []
    count = (30, 70, 150, 450)[detail]
    for _ in range(6):
        centre = np.array([*rng.uniform(-0.28, 0.28, 2), rng.uniform(0.22, 0.62)])
        radii = rng.uniform(0.2, 0.34, 3)
        parts.append(_leaves(rng, centre, radii, count, 0.07 * (1.0, 0.8, 0.6, 0.33)[detail]))
        parts.append(_core(rng, centre, 0.8 * radii, max(detail - 1, 0)))
    return joined(parts)


def _conifer(rng: np.random.Generator, detail: int) -> Mesh:
    parts = [tube([(0, 0, 0), (0, 0, 0.95)], [0.022, 0.004], _WOOD, 6, closed=False)]
    levels = (8, 12, 18, 22)[detail]
    for i in range(levels):
        z = 0.28 + 0.7 * (i + 0.3) / levels
        radius = 0.5 * (1.02 - z) / 0.75
        count = max(4, round(13 * radius / 0.5))
        for k in range(count):
            angle = 2 * math.pi * (k + rng.uniform(0, 0.6)) / count
            parts.append(_bough(rng, z, angle, radius * rng.uniform(0.75, 1.1), (6, 9, 16, 34)[detail]))
    return joined(parts)


def _bough(rng: np.random.Generator, z: float, angle: float, reach: float, count: int) -> Mesh:
    """Needles along a drooping branch."""
    along = rng.uniform(0.1, 1.0, (count, 1))
    way = np.array([math.cos(angle), math.sin(angle), 0.0])
    places = way * along * reach + (0, 0, z) + np.c_[np.zeros((count, 2)), -0.16 * along * reach + 0.01]
    spread = (0.05 + 0.16 * reach * (1.15 - along)) * (0.6 if count > 20 else 1.0)
    corners = places[:, None] + rng.normal(size=(count, 3, 3)) * spread[:, None] * (0.8, 0.8, 0.28)
    normal = np.array([0.6 * way[0], 0.6 * way[1], 0.75])
    normals = np.broadcast_to(normal / np.linalg.norm(normal), (count, 3, 3)).astype(np.float32)
    faces = np.arange(3 * count).reshape(-1, 3).astype(np.int32)
    return Mesh(
        corners.reshape(-1, 3), faces, corners[..., :2].astype(np.float32), normals, np.full(count, _LEAF, np.int32)
    )


def _palm(rng: np.random.Generator, detail: int) -> Mesh:
    z = np.linspace(0, 0.86, 6)
    parts = [tube(np.c_[0.05 * z**2, 0 * z, z], 0.03 - 0.012 * z, _WOOD, 8, closed=False)]
    for i in range((9, 13, 18, 22)[detail]):
        angle, droop = i * 2.4, rng.uniform(0.1, 0.9)
        t = np.linspace(0, 1, 6)
        out = 0.48 * t
        spine = np.c_[out * math.cos(angle), out * math.sin(angle), 0.86 + 0.13 * np.sin(2.2 * t) - 0.28 * droop * t**2]
        across = np.array([-math.sin(angle), math.cos(angle), -0.35])
        width = 0.075 * np.sin(math.pi * np.clip(t * 0.9 + 0.1, 0, 1))[:, None]
        parts.append(_ribbon(spine - across * width, spine))
        parts.append(_ribbon(spine, spine + np.array([across[0], across[1], -across[2]]) * width * (1, 1, -1)))
    return joined(parts)


def _ribbon(left: Floats, right: Floats) -> Mesh:
    count = len(left)
    i = np.arange(count - 1)
    faces = np.r_[np.c_[i, i + count, i + 1], np.c_[i + 1, i + count, i + count + 1]].astype(np.int32)
    vertices = np.r_[left, right]
    uv = vertices[faces][..., :2].astype(np.float32)
    normals = np.zeros((len(faces), 3, 3), np.float32)
    return Mesh(vertices, faces, uv, normals, np.full(len(faces), _LEAF, np.int32))
