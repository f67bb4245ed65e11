# SPDX-License-Identifier: Apache-2.0
"""The loss terms of method section 6, one free function each; the photometric error is in `rendering.photometric`.

Images are [..., C, H, W] with any leading dimensions (samples, frames, cameras), which every reduction keeps: no term
mixes samples or cameras.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cvcdepth_core.rendering.projection import rotation_to_euler_xyz

_EPSILON = 1e-8
_EULER_WEIGHT = 10.0
_LEVER = 10.0  # metres ahead of a camera: what is there shall be seen where it is
_LEAST_WAY = 0.1  # metres

_OVER_IMAGE = (-3, -2, -1)


def auto_mask(reprojection_error: Tensor, identity_error: Tensor) -> Tensor:
    """Return 1 where warping explains a pixel at least as well as standing still does (Godard et al., 2019), else 0.

    Both errors are [..., 1, H, W], the least over the context frames.
    """
    return (reprojection_error <= identity_error).to(reprojection_error.dtype)


def smoothness(disparity: Tensor, image: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the edge-aware smoothness [...] of `disparity` [..., 1, H, W], relative to its mean.

    Gradients count less where `image` [..., C, H, W] has an edge. With a binary `mask` [..., 1, H, W], pixels that show
    nothing have no part in it.
    """
    if mask is not None:
        return _smoothness_within(disparity, image, mask)
    relative = disparity / (disparity.mean(dim=(-2, -1), keepdim=True) + _EPSILON)
    along_x = relative.diff(dim=-1).abs() * _edge_weight(image, dim=-1)
    along_y = relative.diff(dim=-2).abs() * _edge_weight(image, dim=-2)
    return along_x.mean(_OVER_IMAGE) + along_y.mean(_OVER_IMAGE)


def _smoothness_within(disparity: Tensor, image: Tensor, mask: Tensor) -> Tensor:
    shown = mask.sum(dim=(-2, -1), keepdim=True).clamp(min=1)
    relative = disparity / ((disparity * mask).sum(dim=(-2, -1), keepdim=True) / shown + _EPSILON)
    total = torch.zeros(disparity.shape[:-3]).to(disparity)
    for dim in (-1, -2):
        size = mask.shape[dim] - 1
        both = mask.narrow(dim, 0, size) * mask.narrow(dim, 1, size)
        change = relative.diff(dim=dim).abs() * _edge_weight(image, dim) * both
        total = total + change.sum(_OVER_IMAGE) / both.sum(_OVER_IMAGE).clamp(min=1)
    return total


def _edge_weight(image: Tensor, dim: int) -> Tensor:
    return torch.exp(-image.diff(dim=dim).abs().mean(dim=-3, keepdim=True))


def pose_consistency(anchor_motions: Tensor, anchor: int) -> Tensor:
    """Return how far each camera's motion, seen as the anchor (front) camera's, is from the anchor's own (FSM).

    `anchor_motions` [..., F, N, 4, 4] are the motions brought to camera `anchor`, for F context frames. Gives [..., N]:
    |t_0 - t_c| in metres + 10 |euler_XYZ(R_0) - euler_XYZ(R_c)| in radians, Euclidean norms, averaged over frames.
    """
    translation = anchor_motions[..., :3, 3]
    euler = rotation_to_euler_xyz(anchor_motions[..., :3, :3])
    apart = _distance_to(anchor, translation) + _EULER_WEIGHT * _distance_to(anchor, euler)
    return apart.mean(dim=-2)


def motion_error(motions: Tensor, true_motions: Tensor) -> Tensor:
    """Return how wrong motions [..., 4, 4] are, as a share of the way: (|t - t*| + 10 m |R - R*|) / max(|t*|, 0.1 m).

    |R - R*| is the chord, for small angles the angle in radians: with its lever, the error is about how far a point at
    10 m is misplaced. Gives [...].
    """
    way = torch.linalg.vector_norm(true_motions[..., :3, 3], dim=-1).clamp(min=_LEAST_WAY)
    apart = motions - true_motions
    chord = _length(apart[..., :3, :3].flatten(-2)) / 2**0.5
    error: Tensor = (_length(apart[..., :3, 3]) + _LEVER * chord) / way
    return error


def _length(vectors: Tensor) -> Tensor:
    """Return the Euclidean norm, whose gradient is finite at zero too."""
    length: Tensor = (vectors.square().sum(dim=-1) + _EPSILON).sqrt() - _EPSILON**0.5
    return length


def _distance_to(anchor: int, vectors: Tensor) -> Tensor:
    apart: Tensor = torch.linalg.vector_norm(vectors - vectors[..., anchor, None, :], dim=-1)
    return apart
