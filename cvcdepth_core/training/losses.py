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

_OVER_IMAGE = (-3, -2, -1)


def auto_mask(reprojection_error: Tensor, identity_error: Tensor) -> Tensor:
    """Return 1 where warping explains a pixel at least as well as standing still does (Godard et al., 2019), else 0.

    Both errors are [..., 1, H, W], the least over the context frames.
    """
    return (reprojection_error <= identity_error).to(reprojection_error.dtype)


def smoothness(disparity: Tensor, image: Tensor) -> Tensor:
    """Return the edge-aware smoothness [...] of `disparity` [..., 1, H, W], relative to its mean.

    Gradients count less where `image` [..., C, H, W] has an edge.
    """
    relative = disparity / (disparity.mean(dim=(-2, -1), keepdim=True) + _EPSILON)
    along_x = relative.diff(dim=-1).abs() * _edge_weight(image, dim=-1)
    along_y = relative.diff(dim=-2).abs() * _edge_weight(image, dim=-2)
    return along_x.mean(_OVER_IMAGE) + along_y.mean(_OVER_IMAGE)


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


def _distance_to(anchor: int, vectors: Tensor) -> Tensor:
    apart: Tensor = torch.linalg.vector_norm(vectors - vectors[..., anchor, None, :], dim=-1)
    return apart
