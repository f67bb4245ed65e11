# SPDX-License-Identifier: Apache-2.0
"""How cameras are really turned: small rotations that make neighbours' pictures agree where they overlap.

Of every pair of neighbours, in both directions, the turn is looked for that makes patches of one picture, taken over by
depth, correlate best with the other picture. The turns of all pairs together give one correction per camera, chained
from the anchor, which keeps its mount. Pairs that do not carry a turn, or contradict the others, are left out by name.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.errors import RigError
from cvcdepth_core.refinement.moments import SurroundMoment, to_grid
from cvcdepth_core.rendering.projection import axis_angle_to_rotation
from cvcdepth_core.rig.poses import inverse

Turn = NDArray[np.float64]
"""[3] rotation vector in degrees."""

_MOST_PATCHES = 400  # of a pair in one set
_LEAST_PATCHES = 100  # of a pair in all sets
_SPACING = 2  # pixels between patches, and between the samples of a patch
_OFFSETS = list(itertools.product((-3, -1, 1, 3), repeat=2))
_LEAST_DEVIATION = 4.0  # grey levels of a patch
_NOISE = 1.1  # grey levels
_STEEPEST = 1.3  # ratio of the depths in a patch
_NEAREST, _FARTHEST = 0.3, 60.0  # metres
_OUTSIDE = 8  # pixels that a patch may lie outside of the other picture, which a turn may bring in
_FARTHEST_TURN, _COARSE_STEP, _FINEST_STEP = 1.5, 0.3, 0.02  # degrees
_CURVATURE_STEP = 0.15
_LEAST_SCORE = 0.3
_UNSEEN = -1.0  # the least that a correlation can be
_LEAST_INFORMATION = 400.0  # per square degree: patches times the bend of their correlation
_CONTRADICTION = 0.3  # degrees


class PairTurn(NamedTuple):
    """What the pictures of one camera and its neighbour say."""

    camera: int
    neighbour: int
    turn: Turn
    """That takes points in the neighbour's frame to where it sees them."""
    information: NDArray[np.float64]
    """[3, 3] per square degree: how sharply the pictures tell it."""
    patches: int
    before: float
    """Mean ZNCC of the patches as mounted; NaN where too few are seen."""
    after: float
    """The same after the turn."""
    problem: str | None
    """Why the pair is left out; None: it counts."""


@dataclass(frozen=True, eq=False)
class RefinedMounts:
    """A rig's corrected mounts."""

    base_T_camera: NDArray[np.float64]
    """[N, 4, 4]; a camera without a correction keeps its mount."""
    turns: NDArray[np.float64]
    """[N, 3] degrees about each camera's own x, y and z; 0 for the anchor, NaN where no pair leads to the anchor."""
    pairs: tuple[PairTurn, ...]
    """Every ordered pair of neighbours."""


class MountSearch:
    """Collects sets of a drive, then finds how the cameras are turned."""

    def __init__(self, neighbours: Sequence[tuple[int, int]], anchor: int, max_width: int = 320) -> None:
        """`neighbours` are the rig's (camera, neighbour) indices, `anchor` the camera whose mount is kept."""
        self._patches: dict[tuple[int, int], list[_Patches]] = {pair: [] for pair in neighbours}
        self._anchor = anchor
        self._max_width = max_width
        self._base_T_camera: NDArray[np.float64] | None = None

    def add(self, moment: SurroundMoment, trusted_depth: NDArray[np.float32]) -> None:
        """Take a set, with depth [N, H, W] that is NaN where it is not to be trusted."""
        self._base_T_camera = moment.base_T_camera
        grid = to_grid(moment.with_depth(trusted_depth), self._max_width)
        poses = grid.world_T_camera
        for (camera, neighbour), found in self._patches.items():
            if moment.present[[camera, neighbour]].all():
                neighbour_T_camera = inverse(poses[neighbour]) @ poses[camera]
                found.append(
                    _Patches.of(
                        grid.inner[[camera, neighbour]],
                        grid.depth[camera],
                        grid.intrinsics[[camera, neighbour]],
                        neighbour_T_camera,
                    )
                )

    def result(self) -> RefinedMounts:
        """Search every pair and make the turns consistent around the rig; RigError before the first set."""
        if self._base_T_camera is None:
            raise RigError("mounts: no set was added to look for turned cameras in")
        pairs = [_pair_turn(*pair, patches) for pair, patches in self._patches.items()]
        return consistent_mounts(self._base_T_camera, self._anchor, pairs)


def consistent_mounts(base_T_camera: NDArray[np.float64], anchor: int, pairs: Iterable[PairTurn]) -> RefinedMounts:
    """Find the corrections that fit all pairs best; pairs that contradict the others are left out, worst first."""
    judged = list(pairs)
    while True:
        turns = _corrections(base_T_camera, anchor, [pair for pair in judged if pair.problem is None])
        misfits = [_misfit(base_T_camera, turns, pair) for pair in judged]
        worst = int(np.argmax(misfits)) if judged else 0
        if not judged or misfits[worst] <= _CONTRADICTION:
            break
        both = {judged[worst].camera, judged[worst].neighbour}
        reason = f"contradicts the other pairs, or itself the other way round, by {misfits[worst]:.2f} degrees"
        judged = [
            pair._replace(problem=pair.problem or reason) if {pair.camera, pair.neighbour} == both else pair
            for pair in judged
        ]
    corrected = base_T_camera.copy()
    for camera, turn in enumerate(turns):
        if np.isfinite(turn).all():
            corrected[camera, :3, :3] = corrected[camera, :3, :3] @ _rotation(turn)
    return RefinedMounts(corrected, turns, tuple(judged))


@dataclass(frozen=True, eq=False)
class _Patches:
    """Patches of a camera's picture in one set, and the neighbour's picture."""

    points: Tensor
    """[M, 16, 3] metres in the neighbour's frame as mounted."""
    grey: Tensor
    """[M, 16] grey levels around their mean, of length 1."""
    picture: Tensor
    """[h, w] of the neighbour."""
    intrinsics: Tensor
    """[3, 3] of the neighbour."""

    @classmethod
    def of(
        cls, grey: Tensor, depth: Tensor, intrinsics: NDArray[np.float64], neighbour_T_camera: NDArray[np.float64]
    ) -> _Patches:
        """Choose patches of the first of `grey` [2, h, w] that the second may show."""
        own, other = torch.from_numpy(intrinsics).float()
        v, u = _patch_pixels(depth.shape[0], depth.shape[1])
        shown, distance = grey[0][v, u], depth[v, u]
        pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).float() * distance[..., None]
        pose = torch.from_numpy(neighbour_T_camera).float()
        points = pixels @ torch.linalg.inv(own).T @ pose[:3, :3].T + pose[:3, 3]
        good = (shown.std(1) > _LEAST_DEVIATION) & (distance.amax(1) < _STEEPEST * distance.amin(1))
        good &= (distance[:, 0] < _FARTHEST) & _nearly_inside(points, other, grey.shape[1:])
        chosen = good.nonzero().squeeze(1)
        if len(chosen) > _MOST_PATCHES:
            chosen = chosen[torch.arange(_MOST_PATCHES) * len(chosen) // _MOST_PATCHES]
        return cls(points[chosen], _normalised(shown[chosen]), grey[1], other)

    def scores(self, turns: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sum of the patches' ZNCC [T] after each of `turns` [T, 3] (degrees), and how many were seen."""
        turned = self.points.flatten(0, 1) @ axis_angle_to_rotation(torch.deg2rad(turns)).float().mT
        homogeneous = turned @ self.intrinsics.T
        height, width = self.picture.shape
        half = torch.tensor([(width - 1) / 2, (height - 1) / 2])
        grid = (homogeneous[..., :2] / homogeneous[..., 2:] / half - 1).view(len(turns), *self.grey.shape, 2)
        inside = ((grid.abs() <= 1).all(-1)).all(-1)
        sampled = F.grid_sample(
            self.picture.expand(len(turns), 1, -1, -1), grid.flatten(1, 2)[:, None], align_corners=True
        ).view(len(turns), *self.grey.shape)
        inside &= ~torch.isnan(sampled).any(-1)
        likeness = (_normalised(sampled) * self.grey).sum(-1)
        return torch.where(inside, likeness, 0.0).sum(1), inside.sum(1)


def _patch_pixels(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return rows and columns [M, 16] of the samples of all patches of a picture."""
    margin = max(row for row, _ in _OFFSETS) + 1
    rows, columns = (torch.arange(margin, size - margin, _SPACING) for size in (height, width))
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    offsets = torch.tensor(_OFFSETS)
    return v.reshape(-1, 1) + offsets[:, 0], u.reshape(-1, 1) + offsets[:, 1]


def _nearly_inside(points: Tensor, intrinsics: Tensor, size: torch.Size) -> Tensor:
    """Return which patches [M] of `points` [M, 16, 3] lie in a picture of `size`, or a little outside of it."""
    homogeneous = points @ intrinsics.T
    pixels = homogeneous[..., :2] / homogeneous[..., 2:]
    largest = pixels.new_tensor([size[1] - 1, size[0] - 1])
    inside = (pixels > -_OUTSIDE) & (pixels < largest + _OUTSIDE) & (homogeneous[..., 2:] > _NEAREST)
    whole: Tensor = inside.all(-1).all(-1)
    return whole


def _normalised(patches: Tensor) -> Tensor:
    """Return patches [..., 16] around their mean, scaled to length 1, flat ones to less."""
    centred: Tensor = patches - patches.mean(-1, keepdim=True)
    least = _NOISE * math.sqrt(len(_OFFSETS))
    normalised: Tensor = centred / centred.norm(dim=-1, keepdim=True).clamp(min=least)
    return normalised


def _pair_turn(camera: int, neighbour: int, patches: Sequence[_Patches]) -> PairTurn:
    count = sum(len(part.points) for part in patches)
    if count < _LEAST_PATCHES:
        problem = f"{count} textured patches of known depth in the overlap, {_LEAST_PATCHES} are needed"
        return PairTurn(camera, neighbour, np.zeros(3), np.zeros((3, 3)), count, math.nan, math.nan, problem)
    turn = _best_turn(patches)
    before, after = (_known(score) for score in _mean_scores(patches, np.stack([np.zeros(3), turn])).tolist())
    information = count * _curvature(patches, turn)[0]
    return PairTurn(
        camera, neighbour, turn, information, count, before, after, _pair_problem(before, after, information)
    )


def _pair_problem(before: float, after: float, information: NDArray[np.float64]) -> str | None:
    if math.isnan(before):
        return f"fewer than {_LEAST_PATCHES // 2} textured patches lie in the overlap as mounted"
    if not after >= _LEAST_SCORE:
        return f"the pictures correlate by {after:.2f} at best, {_LEAST_SCORE} are needed"
    if np.linalg.eigvalsh(information)[1] < _LEAST_INFORMATION:
        return "the overlap's texture does not tell where the neighbour looks"
    return None


def _known(score: float) -> float:
    return math.nan if score == _UNSEEN else score


def _mean_scores(patches: Sequence[_Patches], turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean ZNCC [T] after each of `turns` [T, 3]; `_UNSEEN` where too few patches are seen to tell."""
    found = [part.scores(torch.from_numpy(turns)) for part in patches if len(part.points)]
    total, seen = (torch.stack(parts).sum(0).double().numpy() for parts in zip(*found, strict=True))
    return np.where(seen >= _LEAST_PATCHES / 2, total / np.maximum(seen, 1), _UNSEEN)


def _best_turn(patches: Sequence[_Patches]) -> Turn:
    """Search a grid of the two turns that move a picture most, then all three in ever smaller steps."""
    steps = np.arange(-_FARTHEST_TURN, _FARTHEST_TURN + _COARSE_STEP / 2, _COARSE_STEP)
    candidates = np.array([(pitch, yaw, 0.0) for pitch in steps for yaw in steps])
    best = candidates[_mean_scores(patches, candidates).argmax()]
    around = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    step = _COARSE_STEP
    while step > _FINEST_STEP:
        chosen = int(_mean_scores(patches, best + step * around).argmax())
        best = best + step * around[chosen]
        step = step if chosen else step / 2
    bend, slope = _curvature(patches, best)
    offset = np.linalg.solve(bend + 1e-3 * np.eye(3), slope)
    return np.asarray(best + np.clip(offset, -_CURVATURE_STEP, _CURVATURE_STEP))


def _curvature(patches: Sequence[_Patches], turn: Turn) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how the mean score bends down around `turn` [3, 3], at least 0 along every axis, and its slope [3]."""
    axes = np.eye(3)
    offsets = [np.zeros(3), *axes, *-axes]
    mixed = [(i, j) for i in range(3) for j in range(i)]
    offsets += [a * axes[i] + b * axes[j] for i, j in mixed for a, b in ((1, 1), (-1, -1), (1, -1), (-1, 1))]
    middle, *others = _mean_scores(patches, turn + _CURVATURE_STEP * np.array(offsets))
    plus, minus, corners = np.array(others[:3]), np.array(others[3:6]), np.array(others[6:]).reshape(-1, 4)
    bend = np.diag(2 * middle - plus - minus)
    for (i, j), (both, neither, one, other) in zip(mixed, corners, strict=True):
        bend[i, j] = bend[j, i] = (one + other - both - neither) / 4
    values, vectors = np.linalg.eigh(bend / _CURVATURE_STEP**2)
    return vectors @ np.diag(values.clip(min=0)) @ vectors.T, (plus - minus) / (2 * _CURVATURE_STEP)


def _corrections(base_T_camera: NDArray[np.float64], anchor: int, pairs: Sequence[PairTurn]) -> NDArray[np.float64]:
    """Return the turns [N, 3] of least squares; NaN for cameras that no chain of pairs connects with the anchor."""
    cameras = len(base_T_camera)
    normal, right = np.zeros((3 * cameras, 3 * cameras)), np.zeros(3 * cameras)
    for pair in pairs:
        rows = _equation(base_T_camera, pair)
        normal += rows.T @ pair.information @ rows
        right += rows.T @ pair.information @ pair.turn
    connected = _connected(anchor, pairs)
    unknown = [3 * camera + axis for camera in sorted(connected - {anchor}) for axis in range(3)]
    turns = np.full(3 * cameras, np.nan)
    turns[3 * anchor : 3 * anchor + 3] = 0.0
    damping = 1e-3 * _LEAST_INFORMATION * np.eye(len(unknown))
    turns[unknown] = np.linalg.solve(normal[np.ix_(unknown, unknown)] + damping, right[unknown])
    return turns.reshape(cameras, 3)


def _equation(base_T_camera: NDArray[np.float64], pair: PairTurn) -> NDArray[np.float64]:
    """Return [3, 3 N]: the pair's turn as a linear function of all cameras' (small) corrections."""
    rows = np.zeros((3, 3 * len(base_T_camera)))
    neighbour_R_camera = base_T_camera[pair.neighbour, :3, :3].T @ base_T_camera[pair.camera, :3, :3]
    rows[:, 3 * pair.camera : 3 * pair.camera + 3] = neighbour_R_camera
    rows[:, 3 * pair.neighbour : 3 * pair.neighbour + 3] = -np.eye(3)
    return rows


def _connected(anchor: int, pairs: Sequence[PairTurn]) -> set[int]:
    found = {anchor}
    while True:
        more = {camera for pair in pairs for camera in pair[:2] if found & set(pair[:2])}
        if more <= found:
            return found
        found |= more


def _misfit(base_T_camera: NDArray[np.float64], turns: NDArray[np.float64], pair: PairTurn) -> float:
    """Return by how many degrees a pair's turn differs from the cameras', along axes that it tells; 0 when left out."""
    if pair.problem is not None:
        return 0.0
    difference = _equation(base_T_camera, pair) @ np.nan_to_num(turns.ravel()) - pair.turn
    values, vectors = np.linalg.eigh(pair.information)
    told = vectors.T @ difference
    return float(np.abs(told[values >= _LEAST_INFORMATION]).max(initial=0.0))


def _rotation(turn: Turn) -> NDArray[np.float64]:
    return axis_angle_to_rotation(torch.deg2rad(torch.from_numpy(turn))).numpy()
