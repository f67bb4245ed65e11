# SPDX-License-Identifier: Apache-2.0
"""One camera's view rendered from another camera or another moment (method section 5).

Everything runs on stacks of views with any leading dimensions (samples, frames, cameras or camera pairs). Which camera
is rendered from which is a matter of index tensors, so there is no loop over cameras and any rig fits.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.rendering.projection import project, transform

_OUTSIDE = 2.0
_STD_EPSILON = 1e-8


@dataclass(frozen=True)
class Warp:
    """Rendered views."""

    images: Tensor
    """[..., 3, H, W] in [0, 1], zero where nothing was seen."""
    masks: Tensor
    """[..., 1, H, W], 0 where the source does not see the point, else the source's own mask there."""
    grid: Tensor
    """[..., H, W, 2] where each pixel was sampled, -1..1 over the source image."""


def warp_views(
    points: Tensor, images: Tensor, masks: Tensor, source_T_target: Tensor, intrinsics: Tensor, in_front_only: bool
) -> Warp:
    """Render each target view by sampling its source image where the target's points project.

    Leading dimensions of `images` and `masks` are those of the result; the others may broadcast to them.

    Args:
        points: [..., 3, H*W] metres in the target camera's frame.
        images: [..., 3, H, W] source images.
        masks: [..., 1, H, W] source masks, 1 = valid.
        source_T_target: [..., 4, 4].
        intrinsics: [..., 3, 3] of the source cameras.
        in_front_only: also call points behind the source camera invalid, which the release does not.

    """
    grid, z = sampling_grid(transform(source_T_target, points), intrinsics, images.shape[-2:])
    seen = (grid.detach().abs() <= 1.0).all(dim=-1).unsqueeze(-3)
    if in_front_only:
        seen &= z.detach().view(seen.shape) > 0
    return Warp(sample(images, grid), seen * sample(masks, grid.detach(), mode="nearest"), grid)


def sampling_grid(points: Tensor, intrinsics: Tensor, size: tuple[int, int] | torch.Size) -> tuple[Tensor, Tensor]:
    """Project source-frame `points` [..., 3, H*W] to a grid [..., H, W, 2], -1..1 over an image of `size` (H, W).

    Gives z [..., 1, H*W] in metres as well. The outermost pixel centres are at -1 and 1.
    """
    height, width = size
    pixels, z = project(points, intrinsics)
    half = pixels.new_tensor([[width - 1], [height - 1]]) / 2
    return (pixels / half - 1.0).mT.reshape(*pixels.shape[:-2], height, width, 2), z


def sample(images: Tensor, grid: Tensor, mode: str = "bilinear") -> Tensor:
    """Sample `images` [..., C, H, W] at `grid` [..., H, W, 2]; zero outside.

    Points near the source's focal plane project to very large coordinates; they are brought to a place that is outside
    as well, because interpolation weights of infinite coordinates are NaN.
    """
    flat_grid = grid.flatten(0, -4).clamp(-_OUTSIDE, _OUTSIDE)
    sampled = F.grid_sample(images.flatten(0, -4), flat_grid, mode, padding_mode="zeros", align_corners=True)
    return sampled.view(*images.shape[:-2], *sampled.shape[-2:])


def align_intensity(
    warped: Tensor, warp_mask: Tensor, target: Tensor, target_mask: Tensor, masked_deviation: bool
) -> Tensor:
    """Give `warped` [..., 3, H, W] the mean and deviation that `target` has where both are valid (method section 5).

    Cameras differ in exposure. Masks are [..., 1, H, W]; no gradient flows through the statistics. A view without
    overlap is left as it is. `masked_deviation` restricts the deviation to the overlap, the release takes all pixels.
    """
    both = (warp_mask * target_mask) > 0
    target_mean, target_std = overlap_statistics(target, both, masked_deviation)
    warp_mean, warp_std = overlap_statistics(warped, both, masked_deviation)
    gain = target_std / (warp_std + _STD_EPSILON)
    offset = target_mean - warp_mean * gain
    overlapping = both.any(dim=-1, keepdim=True).any(dim=-2, keepdim=True)
    slope = torch.where(overlapping, gain * warp_mask, 1.0)
    return torch.addcmul(torch.where(overlapping, offset * warp_mask, 0.0), warped, slope)


@torch.no_grad()
def overlap_statistics(images: Tensor, overlap: Tensor, masked_deviation: bool) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation [..., 1, 1, 1] of `images` [..., C, H, W] over `overlap` [..., 1, H, W].

    One number per view over channels and pixels. The deviation is around the masked mean, over all pixels unless
    `masked_deviation`.
    """
    over_view = (-3, -2, -1)
    weights = overlap.to(images.dtype)
    count = (weights.sum(over_view, keepdim=True) * images.shape[-3]).clamp(min=1)
    mean = _weighted_sum(images, weights) / count
    if masked_deviation:
        variance = _weighted_sum((images - mean).square(), weights) / count
    else:
        spread, center = torch.var_mean(images, over_view, correction=0, keepdim=True)
        variance = spread + (center - mean).square()
    return mean, (variance + _STD_EPSILON**2).sqrt()


def _weighted_sum(images: Tensor, weights: Tensor) -> Tensor:
    """Return the sum [..., 1, 1, 1] over channels and pixels, as a matrix product that needs no product image."""
    per_channel = images.flatten(-2) @ weights.flatten(-2).mT
    return per_channel.sum(dim=-2, keepdim=True).unsqueeze(-1)


def sum_by_target(views: Tensor, targets: Tensor, cameras: int) -> Tensor:
    """Add up `views` [B, ..., P, C, H, W] of the same target camera; `targets` [P] in 0..cameras-1.

    Gives [B, ..., cameras, C, H, W], zero for a camera that is no target.
    """
    summed = views.new_zeros(*views.shape[:-4], cameras, *views.shape[-3:])
    return summed.index_add(-4, targets, views)


def splat_depth(points: Tensor, valid: Tensor, intrinsics: Tensor, targets: Tensor, cameras: int) -> Tensor:
    """Forward-warp neighbours' points to sparse depth images, nearest point first (the DCL of MCDP, method section 8).

    Gives depth [B, N, 1, H, W] in metres, 0 in the holes. Gradients reach the depth, not the position.

    Args:
        points: [B, P, 3, H*W] the neighbours' points in the target cameras' frames, metres.
        valid: [B, P, 1, H, W], points of pixels that are 0 here are left out.
        intrinsics: [B, P, 3, 3] of the target cameras.
        targets: [P] the target camera of each pair.
        cameras: number of cameras N.

    """
    height, width = valid.shape[-2:]
    pixels, z = project(points, intrinsics)
    u, v = pixels.detach().nan_to_num(-1.0).clamp(-1.0, max(height, width)).round().long().unbind(-2)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (z.squeeze(-2) > 0) & (valid.flatten(2) > 0)
    index = torch.where(inside, (targets[:, None] * height + v) * width + u, cameras * height * width)
    nearest = z.new_full((len(z), cameras * height * width + 1), torch.inf)
    nearest = nearest.scatter_reduce(1, index.flatten(1), z.flatten(1), "amin")[:, :-1]
    depth = torch.where(nearest.isinf(), torch.zeros_like(nearest), nearest)
    return depth.view(-1, cameras, 1, height, width)
