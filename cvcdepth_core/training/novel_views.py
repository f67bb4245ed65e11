# SPDX-License-Identifier: Apache-2.0
"""Depth at turned cameras, which a network with a volume gives, as a loss (VFDepth's depth synthesis).

All pairs of a turned camera and a camera that it is compared with go through one warp; samples and cameras are reduced
on their own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from cvcdepth_core.rendering.projection import Reprojection, axis_angle_to_rotation, rigid, rigid_inverse
from cvcdepth_core.rendering.view_synthesis import Warp, warp_by_depth
from cvcdepth_core.training.batch import RigBatch

_EPSILON = 1e-8


class NovelViewsConfig(BaseModel):
    """How cameras are turned for the synthesis of depth."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    max_turn: tuple[float, float, float] = Field(default=(7.5, 7.5, 20.0))
    """Degrees about the vehicle's x, y and z (roll, pitch, yaw), up to which cameras are turned either way about its
    origin."""
    radians: bool = False
    """Take `max_turn` for radians, as the published program does: the cameras then look anywhere, and half of what they
    see has nothing to be compared with."""


@dataclass(frozen=True)
class NovelViews:
    """What turned cameras would see, by the network; mirrored back if it saw the world mirrored."""

    disparity: Tensor
    """[B, N, 1, H, W] in (0, 1)."""
    depth: Tensor
    """[B, N, 1, H, W] metres."""
    base_T_camera: Tensor
    """[B, N, 4, 4] the turned cameras."""
    depth_range: tuple[float, float]
    """Metres, least and greatest, of a camera with a focal length of `focal_scale` pixels."""
    focal_scale: float


def draw_turns(config: NovelViewsConfig, cameras: int, generators: Sequence[torch.Generator]) -> Tensor:
    """Draw axis-angles [B, N, 3] in radians, uniformly; `generators` are CPU ones, one per sample."""
    drawn = torch.stack([torch.rand(cameras, 3, generator=generator) for generator in generators])
    return turns_of(config, drawn)


def turns_of(config: NovelViewsConfig, drawn: Tensor) -> Tensor:
    """Return the axis-angles [..., 3] in radians of numbers [..., 3] in [0, 1)."""
    unit = 1.0 if config.radians else math.pi / 180
    turns: Tensor = (2 * drawn - 1) * drawn.new_tensor(config.max_turn) * unit
    return turns


def novel_poses(base_T_camera: Tensor, turns: Tensor) -> Tensor:
    """Return the cameras [B, N, 4, 4] turned by axis-angles [B, N, 3] about the vehicle's origin, and so moved too."""
    return rigid(axis_angle_to_rotation(turns), torch.zeros_like(turns)) @ base_T_camera


def consistency_of_views(batch: RigBatch, depth: Tensor, novel: NovelViews, corrected: bool) -> Tensor:
    """Return how much the turned cameras' depth differs from that of the real ones [B, N, 1, H, W], [B, N].

    Each turned camera is compared with itself as it was and with its neighbours: mean of |a - b| / (a + b) over what
    they see of its points. `corrected` asks for points in front of them, and takes each lens's own range of depth.
    """
    warp, pairs = warped_depth(batch, depth, novel, corrected)
    own = novel.depth[:, pairs[0]]
    error = ((own - warp.images).abs() / (own + warp.images + _EPSILON)).clamp(0, 1)
    sums = torch.stack([error * warp.masks, warp.masks]).sum((-3, -2, -1))
    of_cameras: Tensor = sums.new_zeros(2, len(depth), batch.cameras).index_add(-1, pairs[0], sums)
    return of_cameras[0] / (of_cameras[1] + _EPSILON)


def warped_depth(batch: RigBatch, depth: Tensor, novel: NovelViews, corrected: bool) -> tuple[Warp, Tensor]:
    """Render the real cameras' depth [B, N, 1, H, W] into the turned ones, and return (target, source) [2, P] too.

    The images [B, P, 1, H, W] are metres along the turned camera's axis. Gradients reach them by what was rendered and
    by the depth that says from where.
    """
    everyone = torch.arange(batch.cameras, device=batch.targets.device)
    pairs = torch.stack([torch.cat([batch.targets, everyone]), torch.cat([batch.sources, everyone])])
    targets, sources = pairs
    novel_T_source = rigid_inverse(novel.base_T_camera[:, targets]) @ batch.base_T_camera[:, sources]
    intrinsics, inverse = batch.intrinsics, batch.inverse_intrinsics
    to_novel = Reprojection.from_cameras(inverse[:, sources], novel_T_source, intrinsics[:, targets])
    to_source = Reprojection.from_cameras(inverse[:, targets], rigid_inverse(novel_T_source), intrinsics[:, sources])
    masks = batch.masks[:, sources]
    warp = warp_by_depth(novel.depth[:, targets], to_novel.z(depth[:, sources]), masks, to_source, corrected)
    nearest, farthest = _depth_range(batch, novel, targets, corrected)
    within = (warp.images > nearest) & (warp.images < farthest)
    clamped = torch.minimum(torch.maximum(warp.images, nearest), farthest)
    return Warp(clamped, warp.masks * within, warp.grid), pairs


def _depth_range(batch: RigBatch, novel: NovelViews, targets: Tensor, corrected: bool) -> tuple[Tensor, Tensor]:
    """Return least and greatest depth [B, P, 1, 1, 1], which the published program has the same for every lens."""
    focal = batch.intrinsics[:, targets, 0, 0, None, None, None] / novel.focal_scale
    reach = focal if corrected else torch.ones_like(focal)
    return novel.depth_range[0] * reach, novel.depth_range[1] * reach


def smoothness_of_views(disparity: Tensor) -> Tensor:
    """Return the smoothness [...] of disparity [..., 1, H, W] relative to its mean; there is no picture with edges."""
    relative = disparity / (disparity.mean(dim=(-2, -1), keepdim=True) + _EPSILON)
    changes: list[Tensor] = [relative.diff(dim=dim).abs().mean((-3, -2, -1)) for dim in (-1, -2)]
    return changes[0] + changes[1]
