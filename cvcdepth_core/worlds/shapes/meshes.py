# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes with texture coordinates, and the primitives that everything is made of. Metres, z up."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]
Ints = NDArray[Any]

_FLAT = 0.9  # of a normal's z: a face that is level enough to be mapped from above
_MAX_AROUND_VERTEX = 24  # faces: those beyond do not take part in a smooth normal


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles. Faces are counter-clockwise seen from outside."""

    vertices: Floats
    """[V, 3] metres."""
    faces: Ints
    """[F, 3] indices of vertices."""
    uv: Floats
    """[F, 3, 2] metres: where each corner lies on its surface's texture."""
    normals: Floats
    """[F, 3, 3] unit normals at the corners, for shading; zeros where the face is flat."""
    materials: Ints
    """[F] indices into the world's materials."""

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
        """Return it shifted."""
        return replace(self, vertices=self.vertices + np.array([x, y, z]))

    def turned(self, yaw: float) -> Mesh:
        """Return it turned about the z axis, radians."""
        return self.transformed(yaw_rotation(yaw))

    def transformed(self, rotation: Floats, translation: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
        """Return it after a rotation [3, 3] and a translation."""
        turned = np.einsum("ij,...j->...i", rotation, self.normals)
        return replace(self, vertices=rotate(rotation, self.vertices) + translation, normals=turned)

    def scaled(self, x: float, y: float, z: float) -> Mesh:
        """Return it stretched along the axes by positive factors; textures stretch with it."""
        normals = self.normals / (x, y, z)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        return replace(self, vertices=self.vertices * (x, y, z), normals=normals / np.where(length > 0, length, 1.0))

    def smoothed(self, crease: float = 40.0) -> Mesh:
        """Return it with smooth normals over edges whose faces differ by less than `crease` degrees."""
        return replace(self, normals=_smooth_normals(self, math.cos(math.radians(crease))))


def joined(meshes: Iterable[Mesh]) -> Mesh:
    """Put meshes together; none give an empty one."""
    parts = list(meshes)
    if not parts:
        return flat_mesh(np.zeros((0, 3)), np.zeros((0, 3)), 0)
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]).astype(np.int32),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.materials for part in parts]).astype(np.int32),
    )


def yaw_rotation(yaw: float) -> Floats:
    """Return the rotation [3, 3] about the z axis, radians."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotate(rotation: Floats, points: Floats) -> Floats:
    """Rotate points [N, 3]; the same to the last bit whatever BLAS is installed and however many threads it takes."""
    x, y, z = points.T
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in rotation], axis=-1)


def cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products of vectors [N, 3]; numpy's own takes ten times as long for a few of them."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    product: Floats = np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]).T
    return product


def face_normals(vertices: Floats, faces: Ints) -> Floats:
    """Return unit normals [F, 3]; zeros for faces without area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0)


def flat_mesh(vertices: Any, faces: Any, material: int | Ints) -> Mesh:
    """Build a mesh of flat faces, each mapped by its own plane: u is level, v goes up (or along y on level faces)."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32).reshape(-1, 3)
    materials = np.broadcast_to(np.asarray(material, np.int32), len(faces)).copy()
    uv = _planar_uv(vertices, faces)
    return Mesh(vertices, faces, uv, np.zeros((len(faces), 3, 3), np.float32), materials)


def _planar_uv(vertices: Floats, faces: Ints) -> Floats:
    normals = face_normals(vertices, faces)
    level = np.hypot(normals[:, 0], normals[:, 1])
    safe = np.where(level > 0, level, 1.0)
    tangent = np.stack([-normals[:, 1] / safe, normals[:, 0] / safe, np.zeros_like(level)], axis=1)
    tangent[np.abs(normals[:, 2]) > _FLAT] = (1.0, 0.0, 0.0)
    upward = cross(normals, tangent)
    upward[np.abs(normals[:, 2]) > _FLAT] = (0.0, 1.0, 0.0)
    corners = vertices[faces]
    uv = [np.einsum("fcj,fj->fc", corners, axis) for axis in (tangent, upward)]
    return np.stack(uv, axis=-1).astype(np.float32)


def _smooth_normals(mesh: Mesh, cosine: float) -> Floats:
    """Average, at each corner, the normals of the vertex's faces that differ by little from the corner's own."""
    flat = face_normals(mesh.vertices, mesh.faces)
    corners = mesh.faces.reshape(-1)
    order = np.argsort(corners, kind="stable")
    sorted_vertices = corners[order]
    first = np.searchsorted(sorted_vertices, sorted_vertices, side="left")
    rank = np.minimum(np.arange(len(corners)) - first, _MAX_AROUND_VERTEX - 1)
    around = np.full((len(mesh.vertices), _MAX_AROUND_VERTEX), -1)
    around[sorted_vertices, rank] = order // 3
    others = around[corners]
    other_normals = np.where((others >= 0)[..., None], flat[others], 0.0)
    own = np.repeat(flat, 3, axis=0)
    alike = np.einsum("nkj,nj->nk", other_normals, own) > cosine
    total = (other_normals * alike[..., None]).sum(axis=1) + 1e-9 * own
    length = np.linalg.norm(total, axis=1, keepdims=True)
    found: Floats = (total / np.where(length > 0, length, 1.0)).reshape(-1, 3, 3).astype(np.float32)
    return found


_X, _Z = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
_BOX_FACES = np.array(
    [(0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7), (0, 1, 5), (0, 5, 4), (1, 2, 6), (1, 6, 5), (2, 3, 7), (2, 7, 6),
     (3, 0, 4), (3, 4, 7)]
)  # fmt: skip


def box(
    length: float,
    width: float,
    height: float,
    material: int,
    bottom: float = 0.0,
    top: tuple[float, float] = (1.0, 1.0),
) -> Mesh:
    """Box with x along `length`, centred at x = y = 0; its upper face is scaled by `top`."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (length / 2, width / 2)
    lower = np.c_[corners, np.full(4, bottom)]
    upper = np.c_[corners * top, np.full(4, bottom + height)]
    return flat_mesh(np.r_[lower, upper], _BOX_FACES, material)


def prism(
    outline: Sequence[tuple[float, float]], bottom: float, top: float, material: int, cap: int | None = None
) -> Mesh:
    """Upright prism over a convex, counter-clockwise outline of (x, y), open below; `cap` is its upper face's."""
    points = np.array(outline)
    count = len(points)
    i, j = np.arange(count), np.roll(np.arange(count), -1)
    vertices = np.r_[np.c_[points, np.full(count, bottom)], np.c_[points, np.full(count, top)]]
    sides = np.r_[np.c_[i, j, j + count], np.c_[i, j + count, i + count]]
    lid = np.array([(count, count + k, count + k + 1) for k in range(1, count - 1)])
    materials = np.r_[np.full(len(sides), material), np.full(len(lid), material if cap is None else cap)]
    return flat_mesh(vertices, np.r_[sides, lid], materials)


def extruded(
    profile: Sequence[tuple[float, float]], width: float, material: int, insets: Sequence[float] | None = None
) -> Mesh:
    """Return A side view, counter-clockwise outline of (x, z), drawn out along y by `width`.

    `insets` narrow each of its points on both sides, metres.
    """
    outline = np.array(profile, np.float64)[::-1]
    inset = np.zeros(len(outline)) if insets is None else np.array(insets, np.float64)[::-1]
    count = len(outline)
    half = width / 2 - inset
    near, far = np.c_[outline[:, 0], -half, outline[:, 1]], np.c_[outline[:, 0], half, outline[:, 1]]
    middle = outline.mean(axis=0)
    ends = [(middle[0], -half.mean(), middle[1]), (middle[0], half.mean(), middle[1])]
    i, j = np.arange(count), np.roll(np.arange(count), -1)
    hub = np.full(count, 2 * count)
    faces = np.r_[
        np.c_[i, j, j + count], np.c_[i, j + count, i + count], np.c_[j, i, hub], np.c_[i + count, j + count, hub + 1]
    ]
    return flat_mesh(np.r_[near, far, ends], faces, material)


def tube(points: Any, radii: Any, material: int, sides: int = 6, closed: bool = True) -> Mesh:
    """Return A round tube along points [M, 3] with the radii [M]; u runs around it, v along it."""
    points, radii = np.asarray(points, np.float64), np.asarray(radii, np.float64)
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    helper = np.where(np.abs(along[:, 2:]) > 0.9, _X, _Z)
    across = cross(helper, along)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    upward = cross(along, across)
    angle = np.linspace(0.0, 2 * math.pi, sides + 1)
    ring = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * upward[:, None]
    surface = points[:, None] + radii[:, None, None] * ring
    lengths = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    uv = np.stack(np.broadcast_arrays(angle * radii.max(), lengths[:, None]), axis=-1)
    body = grid(surface, uv, material, ring)
    if not closed:
        return body
    caps = [_fan(points[-1], surface[-1, :-1], material), _fan(points[0], surface[0, -2::-1], material)]
    return joined([body, *caps])


def cylinder(
    radius: float, height: float, material: int, sides: int = 8, bottom: float = 0.0, taper: float = 1.0
) -> Mesh:
    """Upright cylinder; its upper radius is `taper` times the lower one."""
    return tube([(0, 0, bottom), (0, 0, bottom + height)], [radius, radius * taper], material, sides)


def wheel(radius: float, width: float, tyre: int, rim: int, sides: int = 14, spokes: int | None = None) -> Mesh:
    """Wheel about the y axis, centred at the origin; between its spokes is the material `spokes`."""
    shoulder = 0.16 * width
    across = [-width / 2, -width / 2 + shoulder, width / 2 - shoulder, width / 2]
    round_part = tube([(0, y, 0) for y in across], radius * np.array([0.9, 1, 1, 0.9]), tyre, sides)
    hubs = []
    for y in (-width / 2, width / 2):
        hub = tube([(0, y, 0), (0, y * 1.02, 0)], [0.64 * radius, 0.2 * radius], rim, 10)
        if spokes is not None:
            hub.materials[:20:4] = hub.materials[1:20:4] = spokes
        hubs.append(hub)
    return joined([round_part, *hubs])


def grid(points: Any, uv: Any, material: Any, normals: Any = None) -> Mesh:
    """Surface through points [M, N, 3] with uv [M, N, 2]; `material` is one, or one per cell [M - 1, N - 1].

    Seen from outside the second index runs to the right where the first runs up. `normals` [M, N, 3] make it smooth.
    """
    points, uv = np.asarray(points, np.float64), np.asarray(uv, np.float32)
    m, n = points.shape[:2]
    start = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    quads = np.stack([start, start + 1, start + n + 1, start + n], axis=1)
    faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int32)
    cells = np.broadcast_to(np.asarray(material, np.int32), (m - 1, n - 1)).reshape(-1)
    corner_normals = np.zeros((len(faces), 3, 3), np.float32)
    if normals is not None:
        corner_normals = np.asarray(normals, np.float32).reshape(-1, 3)[faces]
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2)[faces], corner_normals, np.repeat(cells, 2))


def _fan(centre: Floats, ring: Floats, material: int) -> Mesh:
    count = len(ring)
    i = np.arange(count)
    faces = np.c_[i, np.roll(i, -1), np.full(count, count)]
    return flat_mesh(np.r_[ring, centre[None]], faces, material)


@lru_cache
def _icosphere(subdivisions: int) -> tuple[Floats, Ints]:
    """Return unit sphere of 20 * 4^subdivisions triangles."""
    p = (1 + 5**0.5) / 2
    corners = [
        *((x, y, 0.0) for y in (p, -p) for x in (-1.0, 1.0)),
        *((0.0, y, z) for z in (p, -p) for y in (-1.0, 1.0)),
        *((x, 0.0, z) for x in (p, -p) for z in (-1.0, 1.0)),
    ]
    faces = np.array(
        [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6),
         (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10),
         (8, 6, 7), (9, 8, 1)]
    )  # fmt: skip
    vertices = np.array(corners, np.float64) / math.hypot(1, p)
    for _ in range(subdivisions):
        vertices, faces = _subdivided(vertices, faces)
    return vertices, faces


def _subdivided(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middles = vertices[unique].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    ab, bc, ca = (inverse.reshape(-1, 3) + len(vertices)).T
    a, b, c = faces.T
    split = [np.c_[a, ab, ca], np.c_[b, bc, ab], np.c_[c, ca, bc], np.c_[ab, bc, ca]]
    return np.r_[vertices, middles], np.concatenate(split)


def sphere(radius: float, material: int, subdivisions: int = 2, roughness: Floats | None = None) -> Mesh:
    """Sphere of 20 * 4^subdivisions triangles about the origin, smooth; `roughness` scales each vertex's radius."""
    unit, faces = _icosphere(subdivisions)
    factors = np.ones(len(unit)) if roughness is None else roughness
    mesh = flat_mesh(radius * unit * factors[:, None], faces, material)
    return replace(mesh, normals=unit[faces].astype(np.float32)) if roughness is None else mesh.smoothed(60.0)


def sphere_vertices(subdivisions: int) -> Floats:
    """Return unit directions [V, 3] of the vertices of `sphere`, in their order."""
    return _icosphere(subdivisions)[0]
