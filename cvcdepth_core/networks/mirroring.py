# SPDX-License-Identifier: Apache-2.0
"""The mirrored world: what a network sees of it (Hflip-S, method section 7), and its depth fused with the usual one."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cvcdepth_core.model_choices import FlipFusion
from cvcdepth_core.networks.rig_images import RigImages
from cvcdepth_core.surround_depth import SurroundPictures

LATERAL_AXIS = 1
"""Of the vehicle: y, to the left (REP 103)."""


def mirror(images: Tensor, flips: Tensor) -> Tensor:
    """Mirror the samples of `images` [B, ..., W] left to right where `flips` [B] says so."""
    return _where(flips, images.flip(-1), images)


def mirror_motion(motions: Tensor, flips: Tensor, axis: int = 0) -> Tensor:
    """Express motions [B, ..., 4, 4] in the mirrored world where `flips` [B] says so: T <- S T S.

    S negates `axis`, the one across the image: x = 0 in an optical frame, `LATERAL_AXIS` in the vehicle's.
    """
    return _where(flips, _negated(_negated(motions, -2, axis), -1, axis), motions)


def mirror_rig(rig: RigImages, flips: Tensor, offset: int = 0) -> RigImages:
    """Mirror the world of the samples where `flips` [B] says so: every picture, and the rig that took them.

    E -> S_v E S_c with S_v = diag(1, -1, 1, 1) across the vehicle and S_c = diag(-1, 1, 1, 1) across the image: a rig
    that could be built, so that a network which looks at the mounts can be trained with flips too. `offset` is the
    network's `mirror_offset`.
    """
    width = rig.images.shape[-1]
    mounts = _negated(_negated(rig.base_T_camera, -2, LATERAL_AXIS), -1, 0)
    return rig._replace(
        images=mirror(rig.images, flips),
        intrinsics=_where(flips, _mirrored_intrinsics(rig.intrinsics, width - offset), rig.intrinsics),
        base_T_camera=_where(flips, mounts, rig.base_T_camera),
        masks=mirror(rig.masks, flips),
    )


def _mirrored_intrinsics(intrinsics: Tensor, width: int) -> Tensor:
    """Return K [..., 3, 3] of the mirrored picture: the principal point changes sides, a skew its sign."""
    mirrored = intrinsics.clone()
    mirrored[..., 0, 1] *= -1
    mirrored[..., 0, 2] = width - 1 - intrinsics[..., 0, 2]
    return mirrored


def _negated(matrices: Tensor, dimension: int, index: int) -> Tensor:
    """Return [..., 4, 4] with one row (dimension -2) or column (-1) negated."""
    signs = matrices.new_ones(4)
    signs[index] = -1.0
    return matrices * (signs[:, None] if dimension == -2 else signs)


def _where(flips: Tensor, mirrored: Tensor, plain: Tensor) -> Tensor:
    """Choose sample by sample, [B, ...]."""
    return torch.where(_per_sample(flips, plain), mirrored, plain)


def _per_sample(flips: Tensor, like: Tensor) -> Tensor:
    return flips.to(like.device).view(-1, *[1] * (like.ndim - 1))


def mirrored_pictures(surround: SurroundPictures, offset: int = 0) -> SurroundPictures:
    """Return a set as `mirror_rig` has it: every picture mirrored, and the rig that took them."""
    rig = RigImages(
        images=torch.from_numpy(surround.pictures).permute(0, 3, 1, 2)[None],
        intrinsics=torch.tensor(surround.intrinsics)[None],
        base_T_camera=torch.tensor(surround.base_T_camera)[None],
        present=torch.tensor(surround.present)[None],
        masks=torch.tensor(surround.valid)[None, :, None],
    )
    mirrored = mirror_rig(rig, torch.tensor([True]), offset)
    return SurroundPictures(
        pictures=np.ascontiguousarray(mirrored.images[0].permute(0, 2, 3, 1).numpy()),
        present=surround.present,
        intrinsics=mirrored.intrinsics[0].numpy(),
        base_T_camera=mirrored.base_T_camera[0].numpy(),
        valid=mirrored.masks[0, :, 0].numpy(),
    )


def fuse_with_mirrored(depth: Tensor, depth_of_mirrored: Tensor, fusion: FlipFusion) -> Tensor:
    """Fuse `depth` [..., H, W] with that of the mirrored world, as it was seen there; without a fusion it stays."""
    if fusion == "none":
        return depth
    back = depth_of_mirrored.flip(-1)
    return fuse_flipped(depth, back) if fusion == "depth" else 1 / fuse_flipped(1 / depth, 1 / back)


def fuse_flipped(depth: Tensor, depth_of_flipped: Tensor) -> Tensor:
    """Fuse `depth` [..., H, W] with that of the mirrored image, mirrored back ("pp"; Godard et al., 2017).

    Each pass is trusted alone at one border, where it looked past occlusions; between them the mean counts.
    """
    u = torch.linspace(0, 1, depth.shape[-1], dtype=depth.dtype, device=depth.device)
    left = 1 - (20 * (u - 0.05)).clamp(0, 1)
    right = left.flip(-1)
    return right * depth + left * depth_of_flipped + (1 - left - right) * (depth + depth_of_flipped) / 2
