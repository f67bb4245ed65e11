# SPDX-License-Identifier: Apache-2.0
"""Loss terms where depth is known, dense (rendered worlds) or sparse (LiDAR): of log depth, per camera.

Depth is [..., 1, H, W] in metres with any leading dimensions, which every reduction keeps. Truth is inf in the sky and
NaN where it is not known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

FAR = 100.0
"""Metres from which on it is enough that depth is as far: no picture tells 120 m from 150 m."""

_NEAREST = 0.1  # metres; what is nearer counts as this
_STEPS = (1, 2, 4)  # pixels
_LEAST_LOG_UNCERTAINTY = -5.0
_OVER_IMAGE = (-3, -2, -1)


class LogErrors(NamedTuple):
    """Errors of log depth."""

    error: Tensor
    """[..., 1, H, W] log(depth / truth), 0 where truth is not known; beyond `FAR` 0 or below."""
    known: Tensor
    """[..., 1, H, W] bool: whether there is truth, which is not the sky."""
    near: Tensor
    """[..., 1, H, W] bool: known, and not beyond `FAR`."""

    @classmethod
    def of(cls, depth: Tensor, truth: Tensor) -> LogErrors:
        """Compare depth with truth."""
        known = torch.isfinite(truth)
        near = known & (truth <= FAR)
        error = torch.log(depth) - torch.log(truth.nan_to_num(nan=1.0).clamp(_NEAREST, FAR))
        error = torch.where(near, error, error.clamp(max=0.0))
        return cls(torch.where(known, error, 0.0), known, near)

    def mean(self) -> Tensor:
        """Return the mean absolute error [...]."""
        return self._mean(self.error.abs())

    def deviation(self) -> Tensor:
        """Return the standard deviation [...] of the error over the picture, which no scale changes."""
        variance = self._mean(self.error**2) - self._mean(self.error) ** 2
        return torch.sqrt(variance.clamp(min=1e-6))

    def of_steps(self) -> Tensor:
        """Return the mean absolute error [...] of the steps of log depth between pixels 1, 2 and 4 apart, summed."""
        return torch.stack([self._of_steps(dim, step) for dim in (-1, -2) for step in _STEPS]).sum(dim=0)

    def surprise(self, log_uncertainty: Tensor) -> Tensor:
        """Return the negative log likelihood [...] of the error, Laplacian of that scale; the error has no gradient."""
        scale = log_uncertainty.clamp(min=_LEAST_LOG_UNCERTAINTY)
        return self._mean(self.error.detach().abs() * torch.exp(-scale) + scale)

    def _mean(self, values: Tensor) -> Tensor:
        return (values * self.known).sum(_OVER_IMAGE) / self.known.sum(_OVER_IMAGE).clamp(min=1)

    def _of_steps(self, dim: int, step: int) -> Tensor:
        length = self.error.shape[dim] - step
        both = self.near.narrow(dim, 0, length) & self.near.narrow(dim, step, length)
        steps = self.error.narrow(dim, step, length) - self.error.narrow(dim, 0, length)
        return (steps.abs() * both).sum(_OVER_IMAGE) / both.sum(_OVER_IMAGE).clamp(min=1)


def sky_error(depth: Tensor, sky: Tensor | None, truth: Tensor) -> Tensor:
    """Return by how much log depth in the sky is short of `FAR`, plus the cross entropy of the logits `sky`, [...].

    What is known and beyond `FAR` is for neither.
    """
    is_sky = torch.isinf(truth)
    short = torch.relu(math.log(FAR) - torch.log(depth)) * is_sky
    error = short.sum(_OVER_IMAGE) / is_sky.sum(_OVER_IMAGE).clamp(min=1)
    if sky is None:
        return error
    told = is_sky | (truth <= FAR)
    entropy = F.binary_cross_entropy_with_logits(sky, is_sky.to(sky), reduction="none") * told
    return error + entropy.sum(_OVER_IMAGE) / told.sum(_OVER_IMAGE).clamp(min=1)
