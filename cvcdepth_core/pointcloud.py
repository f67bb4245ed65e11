# SPDX-License-Identifier: Apache-2.0
"""Coloured point clouds from depth: float32 [..., 4] with x, y, z in metres and the colour packed as PCL packs it."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.surround_depth import SurroundDepth

Cloud = NDArray[np.float32]

_BLOCK_ROWS = 64
_POINT = np.complex128  # 16 bytes: numpy moves whole points as quickly as numbers
_BGR0 = [0, 2, 1, 1, 2, 0] if sys.byteorder == "little" else [0, 1, 1, 2, 2, 3]  # from channel, to byte, ...
_VOXEL_BITS = 21  # of each coordinate in a voxel's number
_TABLE_BITS = 20
_GOLDEN = 0x9E3779B97F4A7C15  # 2^64 over the golden ratio: Fibonacci hashing (Knuth, TAOCP 3, 6.4)


@dataclass(frozen=True)
class CloudLimits:
    """Which pixels become points of the merged cloud."""

    stride: int = 1
    """Every n-th row and column."""
    min_range: float = 0.0
    """Metres from the camera along its axis; nearer points are left out."""
    max_range: float = float("inf")
    """Metres from the camera along its axis; farther points are left out."""
    voxel: float = 0.0
    """Edge in metres of the cubes of which each keeps one point; 0 keeps every point."""
    min_confidence: float = 0.0
    """Pixels of less confidence make no points."""
    min_height: float = -float("inf")
    """z in the base frame, metres; lower points are left out."""
    max_height: float = float("inf")
    """z in the base frame, metres; higher points are left out."""
    edge_clearance: float = 0.0
    """Metres: pixels on a surface that would pass nearer than this by the camera are edges, and make no points."""

    @property
    def whole(self) -> "CloudLimits":
        """The same for points of any height, and all of them."""
        return replace(self, voxel=0.0, min_height=-np.inf, max_height=np.inf)


class CameraMoments(NamedTuple):
    """How points of cameras that do not fire together come to the moment of one cloud."""

    base_T_camera: NDArray[np.float64]
    """[N, 4, 4] each camera at its exposure, in the base frame at the cloud's moment."""
    seconds: NDArray[np.float64] | None = None
    """[N] by which each exposure is later than the cloud's moment; None: points do not tell it."""

    @classmethod
    def moved(cls, rig: Rig, world_T_base: NDArray[np.float64], anchor: int) -> "CameraMoments":
        """Return those of a rig whose vehicle was at `world_T_base` [N, 4, 4] at the exposures; `anchor`'s is meant."""
        poses = np.stack([camera.base_T_camera for camera in rig.cameras])
        return cls(np.linalg.inv(world_T_base[anchor]) @ world_T_base @ poses)

    @classmethod
    def unmoved(cls, rig: Rig) -> "CameraMoments":
        """Return those of a vehicle that stands."""
        return cls(np.stack([camera.base_T_camera for camera in rig.cameras]))


def organised_cloud(surround: SurroundDepth, camera: int, min_confidence: float = 0.0) -> Cloud:
    """Return one camera's cloud [H, W, 4] in its optical frame.

    x, y, z are NaN where depth is (REP 118), in the sky, and where confidence is below `min_confidence`.
    """
    depth = surround.sure_depth(camera, min_confidence)
    cloud = np.empty((*depth.shape, 4), dtype=np.float32)
    view = _View(depth, surround.pictures[camera], np.linalg.inv(surround.intrinsics[camera]), np.zeros(3), stride=1)
    for rows in view.blocks():
        view.project(rows, cloud[rows])
    return cloud


def merged_cloud(surround: SurroundDepth, rig: Rig, limits: CloudLimits, moments: CameraMoments | None = None) -> Cloud:
    """Return the points of all cameras with known depth inside `limits`, [M, 4] in the base frame; none of the sky.

    `moments` say where the cameras were at their exposures; without, the vehicle is taken to stand. Where these have
    seconds, there is a fifth column with those of each point's camera, float32.
    """
    moments = moments or CameraMoments.unmoved(rig)
    merged = np.empty((surround.depth[:, :: limits.stride, :: limits.stride].size, 4), dtype=np.float32)
    end, counts = 0, np.zeros(len(surround.present), dtype=np.int64)
    for camera in np.flatnonzero(surround.present).tolist():
        begin, base_T_camera = end, moments.base_T_camera[camera]
        rays = base_T_camera[:3, :3] @ np.linalg.inv(surround.intrinsics[camera])
        depth, picture = surround.sure_depth(camera, limits.min_confidence), surround.pictures[camera]
        view = _View(depth, picture, rays, base_T_camera[:3, 3], limits.stride)
        if limits.edge_clearance > 0:
            focal = float(surround.intrinsics[camera, 0, 0]) / limits.stride
            edges = on_edges(view.depth, focal, limits.edge_clearance)
            view.depth = np.where(edges, np.float32(np.nan), view.depth)
        for rows in view.blocks():
            end += _append(view, rows, limits, merged[end:])
        counts[camera] = end - begin
    points = merged[:end]
    if moments.seconds is not None:
        points = np.column_stack([points, np.repeat(moments.seconds.astype(np.float32), counts)])
    inside = banded(points, limits)
    return thinned(inside, limits.voxel) if limits.voxel else inside


def banded(points: Cloud, limits: CloudLimits) -> Cloud:
    """Return the points [M, 3 or more] of the base frame whose height is inside `limits`."""
    inside = (points[:, 2] >= limits.min_height) & (points[:, 2] <= limits.max_height)
    return points if inside.all() else points[inside]


def _append(view: "_View", rows: slice, limits: CloudLimits, free: Cloud) -> int:
    """Put the points of these rows that are inside the limits at the beginning of `free`; return how many they are."""
    depth = view.depth[rows]
    points = free[: depth.size]
    view.project(rows, points.reshape(*depth.shape, 4))
    inside = ((depth >= limits.min_range) & (depth <= limits.max_range)).ravel()
    count = int(np.count_nonzero(inside))
    if count < depth.size:
        points[:count] = points.view(_POINT)[inside].view(np.float32)
    return count


def on_edges(depth: NDArray[np.float32], focal: float, clearance: float) -> NDArray[np.bool_]:
    """Return which pixels [H, W] lie on a step of depth, where no surface is, but what joins two of them.

    Along a plane that passes `clearance` metres from the camera, inverse depth changes by 1 / (focal clearance) per
    pixel at most, however far away: what changes faster would pass nearer. `focal` is in pixels. NaN is no step.
    """
    nearness = 1 / depth
    steepest = np.float32(1 / (focal * clearance))
    edges = np.zeros(depth.shape, dtype=np.bool_)
    across = np.abs(nearness[:, 1:] - nearness[:, :-1]) > steepest
    down = np.abs(nearness[1:] - nearness[:-1]) > steepest
    for part, steps in ((np.s_[:, 1:], across), (np.s_[:, :-1], across), (np.s_[1:], down), (np.s_[:-1], down)):
        edges[part] |= steps
    return edges


class _View:
    """One camera's pixels, back-projected a few rows at a time, so that all steps stay in the cache."""

    def __init__(
        self,
        depth: NDArray[np.float32],  # [H, W]
        picture: NDArray[np.uint8],  # [H, W, 3]
        rays: NDArray[np.float64],  # [3, 3], takes a pixel (u, v, 1) to its ray in the cloud's frame
        origin: NDArray[np.float64],  # [3], the camera in the cloud's frame
        stride: int,
    ) -> None:
        v, u = np.arange(0, depth.shape[0], stride), np.arange(0, depth.shape[1], stride)
        self.depth = np.ascontiguousarray(depth[::stride, ::stride])
        self._picture = np.ascontiguousarray(picture[::stride, ::stride])
        self._across = (rays[:, :1] * u).astype(np.float32)[:, None, :]
        self._down = (rays[:, 1:2] * v + rays[:, 2:]).astype(np.float32)[:, :, None]
        self._origin = origin.astype(np.float32)[:, None, None]
        self._planes = np.empty((3, _BLOCK_ROWS, len(u)), dtype=np.float32)

    def blocks(self) -> Iterator[slice]:
        """Yield the rows of one block after the other."""
        return (slice(begin, begin + _BLOCK_ROWS) for begin in range(0, len(self.depth), _BLOCK_ROWS))

    def project(self, rows: slice, points: Cloud) -> None:
        """Write the points of these rows into `points` [rows, W, 4]."""
        depth = self.depth[rows]
        xyz = np.add(self._across, self._down[:, rows], out=self._planes[:, : len(depth)])
        np.multiply(xyz, depth, out=xyz)
        np.add(xyz, self._origin, out=xyz)
        cv2.merge([*xyz, pack_rgb(self._picture[rows])], dst=points)


def pack_rgb(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Pack RGB [H, W, 3] into float32 [H, W] whose bits are 0x00RRGGBB, the `rgb` field that RViz and PCL read."""
    packed = np.zeros((*picture.shape[:2], 4), dtype=np.uint8)
    cv2.mixChannels([picture], [packed], _BGR0)
    return packed.view(np.float32)[..., 0]


def thinned(points: Cloud, edge: float) -> Cloud:
    """Return the first of the points [M, 3 or more] in each cube of `edge` metres, in their order.

    A hash table without chains: in every round each slot goes to one voxel, and those that did not get one try again.
    """
    voxels = cube_numbers(points, edge)
    table = np.empty(1 << _TABLE_BITS, dtype=np.int64)
    first = np.zeros(len(points), dtype=np.bool_)
    left = np.arange(len(points))
    factor = _GOLDEN
    while left.size:
        slots = voxels[left] * np.uint64(factor) >> np.uint64(64 - _TABLE_BITS)
        table[slots[::-1]] = left[::-1]  # of equal slots the last assignment, the first point, stays
        holders = table[slots]
        first[holders] = True
        left = left[voxels[holders] != voxels[left]]
        factor = factor * _GOLDEN % 2**64
    return points[first]


def cube_numbers(
    points: Cloud, edge: float, origin: NDArray[np.int64] | tuple[int, int, int] = (0, 0, 0)
) -> NDArray[np.uint64]:
    """Return the number [M] of the cube of `edge` metres that each point lies in; `origin` counts cubes [3] too."""
    numbers = np.zeros(len(points), dtype=np.uint64)
    mask = np.uint64(2**_VOXEL_BITS - 1)
    for axis in range(3):
        cells = (np.floor(points[:, axis] * np.float32(1 / edge)).astype(np.int64) + origin[axis]).view(np.uint64)
        numbers = numbers << np.uint64(_VOXEL_BITS) | cells & mask
    return numbers
