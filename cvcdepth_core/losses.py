# SPDX-License-Identifier: Apache-2.0
"""The loss terms of method section 6, one free function each.

Images are [..., C, H, W] with any leading dimensions (samples, frames, cameras), which every reduction keeps: no term
mixes samples or cameras.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.geometry import rotation_to_euler_xyz

_SSIM_C1, _SSIM_C2, _SSIM_EPSILON = 0.01**2, 0.03**2, 1e-8
_SSIM_SHARE = 0.85
_EPSILON = 1e-8
_EULER_WEIGHT = 10.0

_OVER_IMAGE = (-3, -2, -1)


def ssim_distance(prediction: Tensor, target: Tensor) -> Tensor:
    """Return clamp((1 - SSIM) / 2, 0, 1) per channel [..., C, H, W] over 3x3 windows (Wang et al., 2004)."""
    mean_p, mean_t = _local_mean(prediction), _local_mean(target)
    variance_p = _local_mean(prediction.square()) - mean_p.square()
    variance_t = _local_mean(target.square()) - mean_t.square()
    covariance = _local_mean(prediction * target) - mean_p * mean_t
    numerator = (2 * mean_p * mean_t + _SSIM_C1) * (2 * covariance + _SSIM_C2)
    denominator = (mean_p.square() + mean_t.square() + _SSIM_C1) * (variance_p + variance_t + _SSIM_C2)
    return ((1 - numerator / (denominator + _SSIM_EPSILON)) / 2).clamp(0, 1)


def _local_mean(images: Tensor) -> Tensor:
    padded = F.pad(images.flatten(0, -4), (1, 1, 1, 1), mode="reflect")
    return F.avg_pool2d(padded, kernel_size=3, stride=1).view(images.shape)


def photometric_error(prediction: Tensor, target: Tensor) -> Tensor:
    """Return the error map [..., 1, H, W]: 0.85 SSIM distance + 0.15 absolute difference, both averaged over channels.

    `prediction` and `target` [..., C, H, W] may be of different, broadcastable leading dimensions.
    """
    distance = ssim_distance(prediction, target).mean(dim=-3, keepdim=True)
    difference = (target - prediction).abs().mean(dim=-3, keepdim=True)
    return _SSIM_SHARE * distance + (1 - _SSIM_SHARE) * difference


def masked_mean(error: Tensor, mask: Tensor) -> Tensor:
    """Return the mean [...] of `error` [..., 1, H, W] weighted by `mask` [..., 1, H, W]; zero for an empty mask."""
    return (error * mask).sum(_OVER_IMAGE) / (mask.sum(_OVER_IMAGE) + _EPSILON)


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
