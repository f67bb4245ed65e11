# SPDX-License-Identifier: Apache-2.0
"""The vehicle's motion between two sets, from all cameras' pictures and depth at once, where there is no odometry.

The six numbers of a constant motion are found by Gauss-Newton: points with texture and known depth are moved by them to
where each camera was at its own exposure of the set before, and small patches of grey levels have to agree there.
Coarse pictures come first. The scale is that of the depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.refinement.moments import SurroundMoment, reduced, reduced_depth, to_grid
from cvcdepth_core.rendering.projection import transform
from cvcdepth_core.rig.pinhole import scale_intrinsics
from cvcdepth_core.rig.poses import Pose, inverse

Twist = NDArray[np.float64]
"""[6] velocity (m/s) and turn rate (rad/s) of the base frame, in itself; constant between two sets."""

STANDSTILL: Twist = np.zeros(6)

_LEVELS = (4, 2, 1)  # by which the grid is reduced, coarse to fine
_STEPS = 6
_POINTS = {4: 100, 2: 150, 1: 250}  # of each camera
_LEAST_POINTS = 30  # for a camera to count
_LEAST_CAMERAS = 3
_LEAST_GRADIENT = 4.0  # grey levels per pixel
_NEAREST, _FARTHEST = 0.5, 60.0  # metres
_HUBER, _CUT = 6.0, 40.0  # grey levels
_IN_FRONT = 0.1
_LEAST_AGREEMENT = 0.5
_CONVERGED = 1e-4  # metres and radians
_SMALL_TURN = 1e-4  # radians below which powers take the place of sine and cosine
_PATCH = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)]


@dataclass(frozen=True, eq=False)
class AlignedMotion:
    """What alignment found."""

    twist: Twist
    covariance: NDArray[np.float64]
    """[6, 6] of the twist, by the pictures' noise as the residuals tell it; an error of depth's scale is not in it."""
    cost: float
    """Mean robust cost of the patches' grey levels."""
    cost_before: float
    """The same for the best of the motions that the search began with."""
    agreement: float
    """Correlation of the patches with what the pictures before show of them; 1 is perfect."""
    cameras: int
    """That contributed enough points."""
    problem: str | None
    """Why the motion must not be used; None: it may."""

    def pose(self, seconds: float) -> Pose:
        """Return base_T_base [4, 4] from so many seconds later (earlier where negative) to now."""
        return exponential(self.twist * seconds)


class AlignedSet(NamedTuple):
    """One set, as alignment looks at it."""

    grey: Tensor
    """[N, h, w] grey levels, NaN where there is no picture."""
    depth: Tensor
    """[N, h, w] metres, NaN where unknown or not trusted."""
    intrinsics: NDArray[np.float64]
    """[N, 3, 3]."""
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4]."""
    times: NDArray[np.float64]
    """[N] seconds of the exposures; of an absent camera, the others' mean."""

    @classmethod
    def of(cls, moment: SurroundMoment, max_width: int) -> AlignedSet:
        """Reduce a set to a grid of at most so many columns; times count from the epoch."""
        grid = to_grid(moment, max_width)
        times = moment.times_ns / 1e9
        mean = times[moment.present].mean() if moment.present.any() else 0.0
        return cls(grid.inner, grid.depth, grid.intrinsics, moment.base_T_camera, np.where(moment.present, times, mean))


def align(previous: AlignedSet, current: AlignedSet, starts: Sequence[Twist] = ()) -> AlignedMotion:
    """Return the motion that takes `previous` to `current`; the search begins at standstill and at each of `starts`."""
    seconds = torch.from_numpy(current.times - previous.times)
    pairs = {level: _Pair.of(previous, current, seconds, level) for level in _LEVELS}
    finest = pairs[_LEVELS[-1]]
    begun = [STANDSTILL, *starts]
    cost_before = min(_cost(finest, twist) for twist in begun)
    coarse = [_descended(pairs[_LEVELS[0]], twist) for twist in begun]
    twist = min(coarse, key=lambda found: _cost(pairs[_LEVELS[0]], found))
    for level in _LEVELS[1:]:
        twist = _descended(pairs[level], twist)
    # A start that is right already is not made better: the steps end within the pictures' noise of it.
    twist = min((twist, *begun), key=lambda found: _cost(finest, found))
    return _result(finest, twist, cost_before)


def exponential(motion: Twist) -> Pose:
    """Return the pose [4, 4] that a constant motion [6] (m, rad) reaches: exp of the twist."""
    return np.asarray(_exponentials(motion[None])[0])


def logarithm(pose: Pose) -> Twist:
    """Undo `exponential` for turns below half a turn."""
    rotation = pose[:3, :3]
    sine = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    angle = math.atan2(float(np.linalg.norm(sine)) / 2, (float(np.trace(rotation)) - 1) / 2)
    turn = sine / 2 * (1.0 if angle < 1e-9 else angle / math.sin(angle))
    skew = _skew(turn)
    beyond = 1 / 12 if angle < 1e-4 else (1 - angle / 2 / math.tan(angle / 2)) / angle**2
    return np.concatenate([(np.eye(3) - skew / 2 + beyond * skew @ skew) @ pose[:3, 3], turn])


@dataclass(frozen=True, eq=False)
class _Pair:
    """Patches of up to P points of the current set, and the pictures of the one before, at one level."""

    points: Tensor
    """[N, 3, P * 9] metres in the base frame at each camera's exposure; zero where there is none."""
    patches: Tensor
    """[N, P, 9] grey levels around their mean."""
    known: Tensor
    """[N, P] bool."""
    pictures: Tensor
    """[N, 3, h, w] grey levels before, and their slopes across and down."""
    camera_T_base: Tensor
    """[N, 4, 4]."""
    intrinsics: Tensor
    """[N, 3, 3]."""
    seconds: Tensor
    """[N] between the two exposures of each camera."""

    @classmethod
    def of(cls, previous: AlignedSet, current: AlignedSet, seconds: Tensor, level: int) -> _Pair:
        scale = (1 / level, 1 / level)
        before = reduced(previous.grey, level)
        return cls(
            *_textured_patches(current, level),
            torch.stack([before, *_gradients(before)], dim=1),
            torch.from_numpy(np.stack([inverse(pose) for pose in previous.base_T_camera])).float(),
            torch.from_numpy(np.stack([scale_intrinsics(K, scale) for K in previous.intrinsics])).float(),
            seconds,
        )


class _Residuals(NamedTuple):
    values: Tensor
    """[N, P, 9] grey levels."""
    seen: Tensor
    """[N, P] which patches lie inside of the picture before."""
    slopes: Tensor
    """[N, 3, P * 9] of the picture before, grey levels per metre of the point in the base frame."""
    points: Tensor
    """[N, 3, P * 9] metres, moved to the base frame of the picture before."""


def _textured_patches(current: AlignedSet, level: int) -> tuple[Tensor, Tensor, Tensor]:
    """Choose pixels evenly among those with texture and known depth; return points, patches and known of `_Pair`."""
    grey, depth = reduced(current.grey, level), reduced_depth(current.depth, level)
    across, down = _gradients(grey)
    good = (torch.hypot(across, down) > _LEAST_GRADIENT) & (depth > _NEAREST) & (depth < _FARTHEST)
    good[:, [0, -1]] = good[:, :, [0, -1]] = False
    offsets = torch.tensor(_PATCH)
    most = _POINTS[level]
    points, patches = torch.zeros(len(grey), 3, most, len(_PATCH)), torch.zeros(len(grey), most, len(_PATCH))
    for camera, K in enumerate(current.intrinsics):
        found = _evenly(good[camera].nonzero(), most)
        v, u = (found[:, axis, None] + offsets[:, axis] for axis in (0, 1))
        to_base = current.base_T_camera[camera, :3, :3] @ np.linalg.inv(scale_intrinsics(K, (1 / level, 1 / level)))
        pixels = torch.stack([u, v, torch.ones_like(u)]).float() * depth[camera][v, u]
        origin = torch.from_numpy(current.base_T_camera[camera, :3, 3]).float()
        in_base = torch.tensordot(torch.from_numpy(to_base).float(), pixels, dims=1) + origin[:, None, None]
        points[camera, :, : len(found)], patches[camera, : len(found)] = in_base, grey[camera][v, u]
    known = ~torch.isnan(points.sum((1, 3)) + patches.sum(2)) & points.any(3).any(1)
    patches = torch.where(known[..., None], patches - patches.mean(2, keepdim=True), 0.0)
    return torch.where(known[:, None, :, None], points, 0.0).flatten(2), patches, known


def _evenly(pixels: Tensor, most: int) -> Tensor:
    """Return at most so many of `pixels` [M, 2], evenly spaced in their order."""
    if len(pixels) <= most:
        return pixels
    return pixels[torch.arange(most) * len(pixels) // most]


def _gradients(grey: Tensor) -> tuple[Tensor, Tensor]:
    """Return the slopes of `grey` [N, h, w] across and down, grey levels per pixel; NaN at the border."""
    across, down = torch.full_like(grey, torch.nan), torch.full_like(grey, torch.nan)
    across[:, :, 1:-1] = (grey[:, :, 2:] - grey[:, :, :-2]) / 2
    down[:, 1:-1] = (grey[:, 2:] - grey[:, :-2]) / 2
    return across, down


def _residuals(pair: _Pair, twist: Twist) -> _Residuals:
    """Compare the patches with the pictures before, after the motion."""
    motions = torch.from_numpy(_exponentials(twist * pair.seconds.numpy()[:, None])).float()
    moved = transform(motions, pair.points)
    x, y, z = transform(pair.camera_T_base, moved).unbind(1)
    nearness = z.clamp(min=_IN_FRONT).reciprocal()
    fx, fy, cx, cy = (pair.intrinsics[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    a, b = x * nearness, y * nearness
    height, width = pair.pictures.shape[2:]
    grid = torch.stack([(fx * a + cx) * (2 / (width - 1)) - 1, (fy * b + cy) * (2 / (height - 1)) - 1], dim=-1)
    grid = grid.view(*pair.patches.shape, 2)
    sampled = F.grid_sample(pair.pictures, grid, align_corners=True)
    inside = (grid.abs() <= 1).all(-1) & (z > _IN_FRONT).view_as(pair.patches) & ~torch.isnan(sampled).any(1)
    seen = pair.known & inside.all(2)
    grey, across, down = torch.where(seen[:, None, :, None], sampled, 0.0).unbind(1)
    gx, gy = across.flatten(1) * fx * nearness, down.flatten(1) * fy * nearness
    in_camera = torch.stack([gx, gy, -(gx * a + gy * b)], dim=1)
    slopes = pair.camera_T_base[:, :3, :3].mT @ in_camera
    return _Residuals(grey - grey.mean(2, keepdim=True) - pair.patches, seen, slopes, moved)


def _descended(pair: _Pair, twist: Twist) -> Twist:
    """Take Gauss-Newton steps from `twist` until they are small."""
    for _ in range(_STEPS):
        step = -_solved(*_normal_equations(pair, _residuals(pair, twist)))
        # The step comes after the motion, seen from the frame before: exp(step) exp(twist).
        reference = float(pair.seconds.mean())
        twist = logarithm(exponential(step * reference) @ exponential(twist * reference)) / reference
        if np.abs(step * reference).max() < _CONVERGED:
            break
    return twist


def _normal_equations(pair: _Pair, residuals: _Residuals) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return J^T W J [6, 6] and J^T W r [6] of the robust least squares, float64."""
    turning = torch.linalg.cross(residuals.points, residuals.slopes, dim=1)
    cameras, points, samples = pair.patches.shape
    jacobian = torch.cat([residuals.slopes, turning], dim=1).view(cameras, 6, points, samples)
    jacobian = (jacobian - jacobian.mean(3, keepdim=True)) * pair.seconds.float()[:, None, None, None]
    magnitude = residuals.values.abs()
    weight = (_HUBER / magnitude.clamp(min=_HUBER)) * (magnitude < _CUT) * residuals.seen[..., None]
    weighted = (jacobian * weight[:, None]).flatten(2)
    matrix = (weighted @ jacobian.flatten(2).mT).sum(0)
    right = (weighted @ residuals.values.flatten(1)[..., None]).sum((0, 2))
    return matrix.double().numpy(), right.double().numpy()


def _solved(matrix: NDArray[np.float64], right: NDArray[np.float64]) -> Twist:
    """Solve, a little damped; what nothing determines stays as it is."""
    damping = 1e-6 * max(float(np.trace(matrix)), 1e-6) / 6
    return np.asarray(np.linalg.solve(matrix + damping * np.eye(6), right), np.float64)


def _cost(pair: _Pair, twist: Twist) -> float:
    """Return the mean robust cost over the patches that are seen; infinite for none."""
    residuals = _residuals(pair, twist)
    if not residuals.seen.any():
        return math.inf
    magnitude = residuals.values[residuals.seen].abs().clamp(max=_CUT)
    return float(torch.where(magnitude < _HUBER, magnitude.square() / 2, _HUBER * (magnitude - _HUBER / 2)).mean())


def _result(pair: _Pair, twist: Twist, cost_before: float) -> AlignedMotion:
    residuals = _residuals(pair, twist)
    matrix, _ = _normal_equations(pair, residuals)
    cost, agreement = _cost(pair, twist), _agreement(pair, residuals)
    cameras = int((residuals.seen.sum(1) >= _LEAST_POINTS).sum())
    damped = matrix + 1e-6 * np.eye(6) * max(float(np.trace(matrix)) / 6, 1e-6)
    # The nine grey levels of a patch are about three independent ones, and 2 cost their variance.
    variance = np.linalg.inv(damped) * 6 * cost if math.isfinite(cost) else np.diag(np.full(6, math.inf))
    covariance = np.asarray(variance, np.float64)
    problem = _problem(cameras, min(_LEAST_CAMERAS, len(pair.known)), agreement)
    return AlignedMotion(twist, covariance, cost, cost_before, agreement, cameras, problem)


def _agreement(pair: _Pair, residuals: _Residuals) -> float:
    """Return the correlation of all patches' grey levels with those before, each around its mean; 0 for none."""
    now = pair.patches[residuals.seen]
    before = residuals.values[residuals.seen] + now
    norm = float(now.norm() * before.norm())
    return float((now * before).sum()) / norm if norm > 0 else 0.0


def _problem(cameras: int, least: int, agreement: float) -> str | None:
    if cameras < least:
        return f"only {cameras} cameras see enough texture with known depth, {least} are needed"
    if agreement < _LEAST_AGREEMENT:
        return f"the pictures do not agree: correlation {agreement:.2f}, {_LEAST_AGREEMENT} is needed"
    return None


def _exponentials(motions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses [M, 4, 4] of motions [M, 6] (m, rad), in closed form (Rodrigues)."""
    squares = np.square(motions[:, 3:]).sum(1)[:, None, None]
    is_small = squares < _SMALL_TURN**2
    turn = np.sqrt(np.where(is_small, 1.0, squares))
    first = np.where(is_small, 1 - squares / 6, np.sin(turn) / turn)
    second = np.where(is_small, 1 / 2 - squares / 24, (1 - np.cos(turn)) / turn**2)
    third = np.where(is_small, 1 / 6 - squares / 120, (1 - first) / turn**2)
    skew, poses = _skew(motions[:, 3:]), np.tile(np.eye(4), (len(motions), 1, 1))
    square = skew @ skew
    poses[:, :3, :3] += first * skew + second * square
    poses[:, :3, 3:] = (np.eye(3) + second * skew + third * square) @ motions[:, :3, None]
    return poses


def _skew(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices [..., 3, 3] of the cross products with `vectors` [..., 3]."""
    found = np.zeros((*vectors.shape, 3))
    for axis, (row, column) in enumerate(((2, 1), (0, 2), (1, 0))):
        found[..., row, column], found[..., column, row] = vectors[..., axis], -vectors[..., axis]
    return found
