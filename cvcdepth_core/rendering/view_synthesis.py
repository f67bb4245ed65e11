# SPDX-License-Identifier: Apache-2.0
"""One camera's view rendered from another camera or another moment (method section 5).

Everything runs on stacks of views with any leading dimensions (samples, frames, cameras or camera pairs). Which camera
is rendered from which is a matter of index tensors, so there is no loop over cameras and any rig fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.rendering.projection import Reprojection, divisor, pixel_grid, project, transform

_OUTSIDE = 2.0
_STD_EPSILON = 1e-8
_OVER_VIEW = (-3, -2, -1)


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
    return _rendered(grid, z, images, masks, in_front_only)


def warp_by_depth(
    depth: Tensor, images: Tensor, masks: Tensor, source_of_target: Reprojection, in_front_only: bool
) -> Warp:
    """Render target views, or parts of them, by their `depth` [..., 1, H, w] in metres.

    The quicker form of `warp_views`, with no points in between: the leading dimensions, `images`, `masks` and
    `in_front_only` are as there. `source_of_target` leads from the pixels of `depth` to those of the source.
    """
    grid, z = _GridByDepth.apply(depth, *source_of_target, images.shape[-2:])  # type: ignore[no-untyped-call]
    return _rendered(grid, z, images, masks, in_front_only)


class _GridByDepth(torch.autograd.Function):
    """The sampling grid of `warp_by_depth`, with a gradient of its own that keeps few of the images in between."""

    @staticmethod
    def forward(
        ctx: Any, depth: Tensor, turn: Tensor, shift: Tensor, size: tuple[int, int] | torch.Size
    ) -> tuple[Tensor, Tensor]:
        turned = Reprojection(turn, shift).turned(depth)
        x, y, z = torch.addcmul(shift, turned, depth.flatten(-2)).unbind(-2)
        nearness = divisor(z).reciprocal_()
        u, v = ((along * nearness).mul_(scale).sub_(1.0) for along, scale in zip((x, y), _scales(size), strict=True))
        grid = torch.view_as_real(torch.complex(u, v)).view(*u.shape[:-1], *depth.shape[-2:], 2)
        ctx.save_for_backward(depth, turn, shift, nearness, grid)
        ctx.size = size
        ctx.mark_non_differentiable(z)
        return grid, z

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_grid: Tensor, _: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        depth, turn, shift, nearness, grid = ctx.saved_tensors
        u, v = grid.flatten(-3, -2).unbind(-1)
        by_u, by_v = (part * nearness for part in grad_grid.flatten(-3, -2).unbind(-1))
        # u + 1 is proportional to x / z.
        by_z = torch.addcmul(by_u, by_u, u).add_(by_v).addcmul_(by_v, v).neg_()
        across, down = _scales(ctx.size)
        by_pixel = torch.stack([by_u.mul_(across), by_v.mul_(down), by_z], dim=-2)
        grad_depth = (by_pixel * Reprojection(turn, shift).turned(depth)).sum(dim=-2)
        grad_turn = (by_pixel * depth.flatten(-2)) @ pixel_grid(depth).mT
        return (
            grad_depth.view(*grad_depth.shape[:-1], 1, *depth.shape[-2:]).sum_to_size(depth.shape),
            grad_turn.sum_to_size(turn.shape),
            by_pixel.sum(dim=-1, keepdim=True).sum_to_size(shift.shape),
            None,
        )


def _scales(size: tuple[int, int] | torch.Size) -> tuple[float, float]:
    """Return what pixels (u, v) of an image of `size` (H, W) are multiplied by to span 2."""
    height, width = size
    return 2 / (width - 1), 2 / (height - 1)


def _rendered(grid: Tensor, z: Tensor, images: Tensor, masks: Tensor, in_front_only: bool) -> Warp:
    fixed = grid.detach()
    u, v = fixed.abs().unbind(-1)
    seen = (torch.maximum(u, v) <= 1.0).unsqueeze(-3)
    if in_front_only:
        seen &= z.detach().view(seen.shape) > 0
    return Warp(sample(images, grid), seen * sample(masks, fixed, mode="nearest"), grid)


def sampling_grid(points: Tensor, intrinsics: Tensor, size: tuple[int, int] | torch.Size) -> tuple[Tensor, Tensor]:
    """Project source-frame `points` [..., 3, H*W] to a grid [..., H, W, 2], -1..1 over an image of `size` (H, W).

    Gives z [..., 1, H*W] in metres as well. The outermost pixel centres are at -1 and 1.
    """
    height, width = size
    pixels, z = project(points, intrinsics)
    half = pixels.new_tensor([[width - 1], [height - 1]]) / 2
    return (pixels / half - 1.0).mT.reshape(*pixels.shape[:-2], height, width, 2), z


def sample(images: Tensor, grid: Tensor, mode: str = "bilinear") -> Tensor:
    """Sample `images` [..., C, H, W] at `grid` [..., h, w, 2]; zero outside.

    Points near the source's focal plane project to very large coordinates; they are brought to a place that is outside
    as well, because interpolation weights of infinite coordinates are NaN.
    """
    flat_grid = grid.flatten(0, -4).clamp(-_OUTSIDE, _OUTSIDE)
    sampled = F.grid_sample(images.flatten(0, -4), flat_grid, mode, padding_mode="zeros", align_corners=True)
    return sampled.view(*images.shape[:-2], *sampled.shape[-2:])


class Whole(Protocol):
    """A view of which only a part is given."""

    def variance(self, part: Tensor, center: Tensor) -> Tensor:
        """Return the mean squared distance [..., 1, 1, 1] of all its pixels from `center` [..., 1, 1, 1]."""


class KnownView(NamedTuple):
    """Views that were measured before."""

    mean: Tensor
    """[..., 1, 1, 1] over channels and pixels."""
    spread: Tensor
    """[..., 1, 1, 1], the variance about it."""

    @classmethod
    def from_images(cls, images: Tensor) -> KnownView:
        """Measure `images` [..., C, H, W]."""
        mean = images.mean(_OVER_VIEW, keepdim=True)
        return cls(mean, _mean_square(images - mean))

    def at(self, index: Any) -> KnownView:
        """Return those at an index into the leading dimensions."""
        return KnownView(self.mean[index], self.spread[index])

    def variance(self, part: Tensor, center: Tensor) -> Tensor:
        """See `Whole`."""
        return self.spread + (self.mean - center).square()


class BlackBeyond(NamedTuple):
    """Views that are black beyond the part."""

    share: float
    """Of a view, which the part is."""

    def variance(self, part: Tensor, center: Tensor) -> Tensor:
        """See `Whole`."""
        return self.share * _mean_square(part - center) + (1 - self.share) * center.square()


_AS_GIVEN = BlackBeyond(1.0)


def align_intensity(
    warped: Tensor,
    warp_mask: Tensor,
    target: Tensor,
    target_mask: Tensor,
    masked_deviation: bool,
    whole_warped: Whole = _AS_GIVEN,
    whole_target: Whole = _AS_GIVEN,
) -> Tensor:
    """Give `warped` [..., 3, H, W] the mean and deviation that `target` has where both are valid (method section 5).

    Cameras differ in exposure. Masks are [..., 1, H, W]; no gradient flows through the statistics. A view without
    overlap is left as it is. `masked_deviation` restricts the deviation to the overlap, the release takes all pixels of
    the views, which may be more than those that are given.
    """
    both = (warp_mask * target_mask).sign()
    target_mean, target_std = overlap_statistics(target, both, masked_deviation, whole_target)
    warp_mean, warp_std = overlap_statistics(warped, both, masked_deviation, whole_warped)
    gain = target_std / (warp_std + _STD_EPSILON)
    offset = target_mean - warp_mean * gain
    overlaps = both.amax(dim=_OVER_VIEW, keepdim=True)
    slope = torch.addcmul(1 - overlaps, warp_mask, overlaps * gain)
    return torch.addcmul(overlaps * offset * warp_mask, warped, slope)


@torch.no_grad()
def overlap_statistics(
    images: Tensor, overlap: Tensor, masked_deviation: bool, whole: Whole = _AS_GIVEN
) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation [..., 1, 1, 1] of `images` [..., C, H, W] over `overlap` [..., 1, H, W].

    One number per view over channels and pixels. The deviation is around the masked mean, over all pixels of the
    `whole` views unless `masked_deviation`.
    """
    weights = overlap.to(images.dtype)
    count = (weights.sum(_OVER_VIEW, keepdim=True) * images.shape[-3]).clamp(min=1)
    mean = _weighted_sum(images, weights) / count
    if masked_deviation:
        variance = _weighted_sum((images - mean).square_(), weights) / count
    else:
        variance = whole.variance(images, mean)
    return mean, (variance + _STD_EPSILON**2).sqrt()


def _mean_square(differences: Tensor) -> Tensor:
    """Return the mean [..., 1, 1, 1] over channels and pixels of the squares, in the place of the differences."""
    return differences.square_().mean(_OVER_VIEW, keepdim=True)


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
