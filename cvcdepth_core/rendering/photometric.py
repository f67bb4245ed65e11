# SPDX-License-Identifier: Apache-2.0
"""The photometric error 0.85 SSIM distance + 0.15 absolute difference (method section 6), with its own gradient.

The error is evaluated for some fifty views per sample, and left to autograd it costs more time and memory than both
networks: some thirty intermediate images per view are kept for the backward pass. Here nothing is kept but the two
images; the backward pass works the statistics out again, a few views at a time so that they stay in the cache.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_C1, _C2, _EPSILON = 0.01**2, 0.03**2, 1e-8
_SSIM_SHARE = 0.85
_OVER_IMAGE = (-3, -2, -1)
_CHUNK_ELEMENTS = 1 << 20
"""Pixels times channels that are worked on at a time."""


def photometric_error(prediction: Tensor, target: Tensor) -> Tensor:
    """Return the error map [..., 1, H, W] of `prediction` [..., C, H, W] against `target`, averaged over channels.

    The leading dimensions of `target` are those of `prediction`, or 1 where one target serves several predictions.
    Differentiable once, in both arguments.
    """
    views = prediction.flatten(0, -4)
    target_of_view = torch.arange(target.flatten(0, -4).shape[0], device=target.device).view(target.shape[:-3])
    target_of_view = target_of_view.expand(prediction.shape[:-3]).flatten()
    error: Tensor = _PhotometricError.apply(  # type: ignore[no-untyped-call]
        views, target.flatten(0, -4), target_of_view
    )
    return error.view(*prediction.shape[:-3], 1, *prediction.shape[-2:])


def ssim_distance(prediction: Tensor, target: Tensor) -> Tensor:
    """Return clamp((1 - SSIM) / 2, 0, 1) [..., C, H, W] of two such images over 3x3 windows (Wang et al., 2004)."""
    return ((1 - _Ssim.from_images(prediction, target).value) / 2).clamp(0, 1)


def masked_mean(error: Tensor, mask: Tensor) -> Tensor:
    """Return the mean [...] of `error` [..., 1, H, W] weighted by `mask` [..., 1, H, W]; zero for an empty mask."""
    return (error * mask).sum(_OVER_IMAGE) / (mask.sum(_OVER_IMAGE) + _EPSILON)


class _PhotometricError(torch.autograd.Function):
    """Error [V, 1, H, W] of predictions [V, C, H, W] against targets [U, C, H, W]; `target_of_view` [V] says which."""

    @staticmethod
    def forward(ctx: Any, predictions: Tensor, targets: Tensor, target_of_view: Tensor) -> Tensor:
        ctx.save_for_backward(predictions, targets, target_of_view)
        error = torch.empty_like(predictions[:, :1])
        for chunk in _chunks(predictions):
            prediction, target = predictions[chunk], targets[target_of_view[chunk]]
            difference = (prediction - target).abs_().mul_(1 - _SSIM_SHARE)
            distance = ssim_distance(prediction, target).mul_(_SSIM_SHARE)
            error[chunk] = distance.add_(difference).mean(dim=1, keepdim=True)
        return error

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_error: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        predictions, targets, target_of_view = ctx.saved_tensors
        wants_prediction, wants_target, _ = ctx.needs_input_grad
        grad_predictions = torch.empty_like(predictions) if wants_prediction else None
        grad_targets = torch.zeros_like(targets) if wants_target else None
        for chunk in _chunks(predictions):
            prediction, target = predictions[chunk], targets[target_of_view[chunk]]
            grad = grad_error[chunk] / prediction.shape[1]
            ssim = _Ssim.from_images(prediction, target)
            inside = ssim.value.abs() <= 1  # where the clamp of the distance lets the gradient through
            grad_ssim = torch.where(inside, grad * (-_SSIM_SHARE / 2), torch.zeros_like(grad))
            grad_difference = torch.sign(prediction - target) * (grad * (1 - _SSIM_SHARE))
            if grad_predictions is not None:
                grad_predictions[chunk] = ssim.gradient(prediction, target, grad_ssim).add_(grad_difference)
            if grad_targets is not None:
                grad_target = ssim.swapped().gradient(target, prediction, grad_ssim).sub_(grad_difference)
                grad_targets.index_add_(0, target_of_view[chunk], grad_target)
        return grad_predictions, grad_targets, None


def _chunks(views: Tensor) -> Iterator[slice]:
    step = max(1, _CHUNK_ELEMENTS // max(1, views[:1].numel()))
    return (slice(start, start + step) for start in range(0, len(views), step))


@dataclass(frozen=True)
class _Ssim:
    """SSIM = (2 m_x m_y + C1)(2 s_xy + C2) / ((m_x^2 + m_y^2 + C1)(s_xx + s_yy + C2) + epsilon) and its parts."""

    mean_x: Tensor
    mean_y: Tensor
    luminance: Tensor  # 2 m_x m_y + C1
    structure: Tensor  # 2 s_xy + C2
    energy: Tensor  # m_x^2 + m_y^2 + C1
    spread: Tensor  # s_xx + s_yy + C2
    denominator: Tensor
    value: Tensor

    @classmethod
    def from_images(cls, x: Tensor, y: Tensor) -> _Ssim:
        mean_x, mean_y = _local_mean(x), _local_mean(y)
        product = mean_x * mean_y
        squares = mean_x.square().add_(mean_y.square())
        structure = _local_mean(x * y).sub_(product).mul_(2).add_(_C2)
        spread = _local_mean(torch.addcmul(x * x, y, y)).sub_(squares).add_(_C2)
        luminance, energy = product.mul_(2).add_(_C1), squares.add_(_C1)
        denominator = (energy * spread).add_(_EPSILON)
        value = (luminance * structure).div_(denominator)
        return cls(mean_x, mean_y, luminance, structure, energy, spread, denominator, value)

    def swapped(self) -> _Ssim:
        """Return the same with x and y exchanged."""
        return _Ssim(
            self.mean_y,
            self.mean_x,
            self.luminance,
            self.structure,
            self.energy,
            self.spread,
            self.denominator,
            self.value,
        )

    def gradient(self, x: Tensor, y: Tensor, grad: Tensor) -> Tensor:
        """Return the gradient in x, given `grad` in `value`.

        With e_xx and e_xy the local means of x^2 and x y, s_xx = e_xx - m_x^2 and s_xy = e_xy - m_x m_y, the value
        depends on x through m_x, e_xx and e_xy.
        """
        scaled = grad / self.denominator
        by_e_xy = 2 * scaled * self.luminance
        by_e_xx = -scaled * self.value * self.energy
        by_mean = 2 * scaled * self.mean_y * (self.structure - self.luminance)
        by_mean -= 2 * scaled * self.value * self.mean_x * (self.spread - self.energy)
        through_mean = _local_mean_adjoint(by_mean)
        return through_mean.addcmul_(_local_mean_adjoint(by_e_xx), x, value=2).addcmul_(_local_mean_adjoint(by_e_xy), y)


def _local_mean(images: Tensor) -> Tensor:
    """Average [..., H, W] over 3x3 pixels; the border repeats the image mirrored about its outermost pixels."""
    for dim in (-1, -2):
        last = images.shape[dim] - 1
        summed = _sum_of_three(images, dim)
        summed.select(dim, 0).add_(images.select(dim, 1))
        summed.select(dim, last).add_(images.select(dim, last - 1))
        images = summed
    return images.div_(9)


def _local_mean_adjoint(images: Tensor) -> Tensor:
    """Apply the transpose of `_local_mean`, which carries gradients back."""
    for dim in (-1, -2):
        last = images.shape[dim] - 1
        summed = _sum_of_three(images, dim)
        summed.select(dim, 1).add_(images.select(dim, 0))
        summed.select(dim, last - 1).add_(images.select(dim, last))
        images = summed
    return images.div_(9)


def _sum_of_three(images: Tensor, dim: int) -> Tensor:
    rest = images.shape[dim] - 1
    summed = images.clone()
    summed.narrow(dim, 1, rest).add_(images.narrow(dim, 0, rest))
    summed.narrow(dim, 0, rest).add_(images.narrow(dim, 1, rest))
    return summed
