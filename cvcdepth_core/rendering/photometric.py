# SPDX-License-Identifier: Apache-2.0
"""The photometric error 0.85 SSIM distance + 0.15 absolute difference (method section 6), with its own gradient.

The error is evaluated for some fifty views per sample, and left to autograd it costs more time and memory than both
networks: some thirty intermediate images per view are kept for the backward pass. Here nothing is kept but the images
and the statistics of the targets, which serve several views each; the backward pass works out the others again, a
piece at a time that stays in the cache.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_WINDOW = 9  # pixels
_EPSILON = 1e-8
# Sums over a window stand for the means of the formula: a product of two sums is 81 times that of the means.
_C1, _C2, _SSIM_EPSILON = _WINDOW**2 * 0.01**2, _WINDOW**2 * 0.03**2, _WINDOW**4 * _EPSILON
_SSIM_SHARE = 0.85
_OVER_IMAGE = (-3, -2, -1)
_CHUNK_ELEMENTS = 1 << 18
"""Pixels times channels that a CPU works on at a time; larger images leave its cache, for smaller ones calls count."""
_CHUNK_ELEMENTS_OF_GPUS = 1 << 24


def photometric_error(prediction: Tensor, target: Tensor, statistics: TargetStatistics | None = None) -> Tensor:
    """Return the error map [..., 1, H, W] of `prediction` [..., C, H, W] against `target`, averaged over channels.

    The leading dimensions of `target` are those of `prediction`, or 1 where one target serves several predictions.
    Differentiable once, in both arguments. `statistics` are the target's, where they have been measured already.
    """
    targets = target.flatten(0, -4)
    target_of_view = torch.arange(len(targets)).view(target.shape[:-3]).expand(prediction.shape[:-3]).flatten()
    error: Tensor = _PhotometricError.apply(  # type: ignore[no-untyped-call]
        prediction.flatten(0, -4), targets, target_of_view.tolist(), statistics or TargetStatistics.from_images(target)
    )
    return error.view(*prediction.shape[:-3], 1, *prediction.shape[-2:])


def ssim_distance(prediction: Tensor, target: Tensor) -> Tensor:
    """Return clamp((1 - SSIM) / 2, 0, 1) [..., C, H, W] of two such images over 3x3 windows (Wang et al., 2004)."""
    return ((1 - _Ssim.from_images(prediction, target, TargetStatistics.from_images(target)).value) / 2).clamp(0, 1)


def masked_mean(error: Tensor, mask: Tensor) -> Tensor:
    """Return the mean [...] of `error` [..., 1, H, W] weighted by `mask` [..., 1, H, W]; zero for an empty mask."""
    return weighted_mean((error * mask).sum(_OVER_IMAGE), mask.sum(_OVER_IMAGE))


def weighted_mean(weighted_sum: Tensor, weights: Tensor) -> Tensor:
    """Return the mean of what was added up with weights of this sum; zero where that is zero."""
    return weighted_sum / (weights + _EPSILON)


class TargetStatistics(NamedTuple):
    """What SSIM needs of its second image alone, [..., C, H, W] each."""

    sums: Tensor
    """9 m_y."""
    energy: Tensor
    """81 (m_y^2 + C1)."""
    spread: Tensor
    """81 (s_yy + C2)."""

    @classmethod
    @torch.no_grad()
    def from_images(cls, images: Tensor) -> TargetStatistics:
        """Measure `images` [..., C, H, W]."""
        measured = cls(*(torch.empty_like(images, memory_format=torch.contiguous_format) for _ in cls._fields))
        views, *parts = (part.flatten(0, -4) for part in (images, *measured))
        for piece in _pieces(views, range(len(views))):
            image, (sums, energy, spread) = piece.of_view(views), map(piece.of_view, parts)
            sums.copy_(_window_sums(image))
            torch.square(sums, out=energy)
            torch.sub(_window_sums(image * image).mul_(_WINDOW).add_(_C2), energy, out=spread)
            energy.add_(_C1)
        return measured


class _PhotometricError(torch.autograd.Function):
    """Error [V, 1, H, W] of predictions [V, C, H, W] against targets [U, C, H, W]; `target_of_view` [V] says which."""

    @staticmethod
    def forward(
        ctx: Any, predictions: Tensor, targets: Tensor, target_of_view: Sequence[int], statistics: TargetStatistics
    ) -> Tensor:
        of_targets = [part.flatten(0, -4) for part in statistics]
        ctx.save_for_backward(predictions, targets, *of_targets)
        ctx.target_of_view = target_of_view
        # Of every channel 0.85 (1 - SSIM) / 2 + 0.15 |difference|.
        error = torch.full_like(predictions[:, :1], _SSIM_SHARE / 2)
        difference_share = (1 - _SSIM_SHARE) / predictions.shape[1]
        for piece in _pieces(predictions, target_of_view):
            x, y, *of_y = piece.of_view(predictions), *map(piece.of_target, (targets, *of_targets))
            similarity = _Ssim.from_images(x, y, TargetStatistics(*of_y)).value.clamp_(-1, 1)
            errors = torch.sub((x - y).abs_(), similarity, alpha=_SSIM_SHARE / 2 / (1 - _SSIM_SHARE))
            for channel in errors.split(1, dim=1):  # type: ignore[no-untyped-call]
                error[piece.views].add_(channel, alpha=difference_share)
        return error

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_error: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        predictions, *of_targets = ctx.saved_tensors
        wants_prediction, wants_target, *_ = ctx.needs_input_grad
        grad_predictions = torch.empty_like(predictions) if wants_prediction else None
        grad_targets = torch.zeros_like(of_targets[0]) if wants_target else None
        grad_error = grad_error / predictions.shape[1]
        for piece in _pieces(predictions, ctx.target_of_view):
            x, y, *of_y = piece.of_view(predictions), *map(piece.of_target, of_targets)
            grad = grad_error[piece.views]
            grad_difference = (x - y).sign_().mul_(grad).mul_(1 - _SSIM_SHARE)
            ssim = _Ssim.from_images(x, y, TargetStatistics(*of_y))
            # SSIM leaves [-1, 1], where the distance is clamped, by rounding alone, and has no slope there.
            gradient = _SsimGradient.from_ssim(ssim, grad * (-_SSIM_SHARE / 2))
            if grad_predictions is not None:
                grad_x = gradient.half_in(x, y, ssim.sums, of_y[0])
                torch.add(grad_difference, grad_x, alpha=2, out=piece.of_view(grad_predictions))
            if grad_targets is not None:
                grad_y = gradient.half_in(y, x, of_y[0], ssim.sums)
                piece.of_target(grad_targets).add_(grad_y.mul_(2).sub_(grad_difference))
        return grad_predictions, grad_targets, None, None


class _Piece(NamedTuple):
    """What is worked on at a time: some channels of one view, or views in a row whose targets are in a row too."""

    views: slice
    channels: slice
    targets: slice

    def of_view(self, images: Tensor) -> Tensor:
        return images[self.views, self.channels]

    def of_target(self, images: Tensor) -> Tensor:
        return images[self.targets, self.channels]


def _pieces(views: Tensor, target_of_view: Sequence[int]) -> Iterator[_Piece]:
    """Divide `views` [V, C, H, W]."""
    most = _CHUNK_ELEMENTS if views.device.type == "cpu" else _CHUNK_ELEMENTS_OF_GPUS
    channels, planes = views.shape[1], max(1, most // max(1, views[:1, :1].numel()))
    first = 0
    while first < len(views):
        target, last = target_of_view[first], first + 1
        while (
            last < len(views)
            and (last + 1 - first) * channels <= planes
            and target_of_view[last] == target + last - first
        ):
            last += 1
        for channel in range(0, channels, planes):
            of_targets = slice(target, target + last - first)
            yield _Piece(slice(first, last), slice(channel, channel + planes), of_targets)
        first = last


@dataclass(frozen=True)
class _Ssim:
    """SSIM = (2 m_x m_y + C1)(2 s_xy + C2) / ((m_x^2 + m_y^2 + C1)(s_xx + s_yy + C2) + epsilon) and its parts."""

    sums: Tensor  # 9 m_x; the other parts are 81 times what stands here
    luminance: Tensor  # 2 m_x m_y + C1
    structure: Tensor  # 2 s_xy + C2
    energy: Tensor  # m_x^2 + m_y^2 + C1
    spread: Tensor  # s_xx + s_yy + C2
    denominator: Tensor  # 81^2 times
    value: Tensor  # as it is

    @classmethod
    def from_images(cls, x: Tensor, y: Tensor, of_y: TargetStatistics) -> _Ssim:
        sums = _window_sums(x)
        luminance = torch.addcmul(x.new_tensor(_C1), sums, of_y.sums, value=2)
        structure = _window_sums(x * y).mul_(2 * _WINDOW).sub_(luminance).add_(_C1 + _C2)
        energy = torch.addcmul(of_y.energy, sums, sums)
        spread = torch.addcmul(of_y.spread, sums, sums, value=-1).add_(_window_sums(x * x), alpha=_WINDOW)
        denominator = torch.addcmul(x.new_tensor(_SSIM_EPSILON), energy, spread)
        value = (luminance * structure).div_(denominator)
        return cls(sums, luminance, structure, energy, spread, denominator, value)


class _SsimGradient(NamedTuple):
    """How a function of the value depends on x and y.

    With e_xx and e_xy the local means of x^2 and x y, s_xx = e_xx - m_x^2 and s_xy = e_xy - m_x m_y, the value depends
    on x through m_x, e_xx and e_xy; on y in the same way, for it is symmetric.
    """

    by_products: Tensor  # per sum of x y, halved, and carried back to the pixels
    by_squares: Tensor  # per sum of x^2, negative
    by_mean_of_other: Tensor  # per sum of x, halved, over the sums of y
    by_mean: Tensor  # the same over the sums of x, negative

    @classmethod
    def from_ssim(cls, ssim: _Ssim, grad: Tensor) -> _SsimGradient:
        """`grad` is the function's gradient in the value."""
        scaled = grad / ssim.denominator
        weighted = scaled * ssim.value
        return cls(
            _window_sums_adjoint(scaled * ssim.luminance),
            _window_sums_adjoint(weighted * ssim.energy),
            (ssim.structure - ssim.luminance).mul_(scaled),
            (ssim.spread - ssim.energy).mul_(weighted),
        )

    def half_in(self, x: Tensor, y: Tensor, sums_x: Tensor, sums_y: Tensor) -> Tensor:
        """Return half the gradient in x."""
        by_sums = torch.mul(self.by_mean_of_other, sums_y).addcmul_(self.by_mean, sums_x, value=-1)
        through_mean = _window_sums_adjoint(by_sums)
        return through_mean.addcmul_(self.by_squares, x, value=-_WINDOW).addcmul_(self.by_products, y, value=_WINDOW)


def _window_sums(images: Tensor) -> Tensor:
    """Add up [..., H, W] over 3x3 pixels; the border repeats the image mirrored about its outermost pixels."""
    for dim in (-2, -1):
        last = images.shape[dim] - 1
        summed = _inner_sums(images, dim)
        for border, beside in ((0, 1), (last, last - 1)):
            torch.add(images.select(dim, border), images.select(dim, beside), alpha=2, out=summed.select(dim, border))
        images = summed
    return images


def _window_sums_adjoint(images: Tensor) -> Tensor:
    """Apply the transpose of `_window_sums`, which carries gradients back."""
    for dim in (-2, -1):
        last = images.shape[dim] - 1
        summed = _inner_sums(images, dim)
        for border, beside in ((0, 1), (last, last - 1)):
            torch.add(images.select(dim, border), images.select(dim, beside), out=summed.select(dim, border))
        for border, beside in ((0, 1), (last, last - 1)):
            summed.select(dim, beside).add_(images.select(dim, border))
        images = summed
    return images


def _inner_sums(images: Tensor, dim: int) -> Tensor:
    """Add up every pixel and the two beside it; the two at the border are left open."""
    inner = images.shape[dim] - 2
    summed = torch.empty_like(images)
    middle = summed.narrow(dim, 1, inner)
    torch.add(images.narrow(dim, 0, inner), images.narrow(dim, 2, inner), out=middle)
    middle.add_(images.narrow(dim, 1, inner))
    return summed
