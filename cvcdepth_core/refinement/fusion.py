# SPDX-License-Identifier: Apache-2.0
"""From matching costs to one factor per pixel: smoothness, a posterior over the hypotheses, and its mean.

Smoothness is asked of the ratio to the prior, not of depth: the prior's edges and slopes cost nothing. Costs are summed
along four directions (semi-global matching; Hirschmueller, 2008) and averaged over a small square, which takes the
streaks that four directions leave.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from cvcdepth_core.refinement.confidence import RIGHT_WITHIN
from cvcdepth_core.refinement.settings import RefinementSettings

_LEAST_LOG_RATIO = 1e-4  # below is rounding: the prior stays bit for bit


class Posterior(NamedTuple):
    """What is believed of each pixel's log ratio to the prior."""

    log_ratio: Tensor
    """[N, h, w] by which the prior's logarithm is off; exactly 0 where nothing speaks against the prior."""
    peak: Tensor
    """[N, h, w] probability of the hypotheses around the best one."""
    prior_right: Tensor
    """[N, h, w] probability that the prior is right within a factor of 1.25."""


def posterior(cost: Tensor, settings: RefinementSettings) -> Posterior:
    """Read log ratios out of `cost` [N, bins, h, w], which includes what is known of the prior."""
    smooth = averaged(semi_global(cost, settings.step_penalty), settings.smoothing)
    probability = torch.softmax(smooth.div_(-settings.temperature), dim=1)
    log_ratios = settings.log_ratios(cost.device)
    log_ratio, peak = _peak_mean(probability, log_ratios)
    log_ratio = torch.where(log_ratio.abs() < _LEAST_LOG_RATIO, 0.0, log_ratio)
    near = log_ratios.abs() <= RIGHT_WITHIN
    return Posterior(log_ratio, peak, probability[:, near].sum(1))


def semi_global(cost: Tensor, step_penalty: float) -> Tensor:
    """Return the mean over four directions of the least cost [N, bins, h, w] of a path that ends at each hypothesis.

    Costs of a pixel are right but for a constant that its hypotheses share.
    """
    cameras = len(cost)
    total = torch.zeros_like(cost)
    for along in ((2, 0, 1, 3), (3, 0, 1, 2)):  # rows, columns; scanned forth and back at once
        lines = cost.permute(along)
        scanned = _scan(torch.cat([lines, lines.flip(0)], dim=1), step_penalty)
        total.permute(along).add_(scanned[:, :cameras]).add_(scanned[:, cameras:].flip(0))
    return total.div_(4)


def _scan(lines: Tensor, step_penalty: float) -> Tensor:
    """Add to each line [M, bins, K] of `lines` [L, M, bins, K], in place, the least cost of the way from those before.

    A path pays for every bin that it steps, also for many at once, so that only neighbouring bins need be looked at.
    """
    best, stepped = torch.empty_like(lines[0]), torch.empty_like(lines[0])
    for before, line in pairwise(lines.unbind(0)):
        torch.add(before, step_penalty, out=stepped)
        torch.minimum(before[:, 1:], stepped[:, :-1], out=best[:, 1:])
        best[:, 0] = before[:, 0]
        torch.minimum(best[:, :-1], stepped[:, 1:], out=best[:, :-1])
        line.add_(best)
    return lines


def averaged(values: Tensor, share: float) -> Tensor:
    """Average `values` [N, ..., h, w] over squares of an odd number of pixels, about `share` of the width, squared."""
    half = round((share * values.shape[-1] - 1) / 2)
    if half < 1:
        return values
    return torch.stack([_box_mean(_box_mean(camera, half, -2), half, -1) for camera in values])


def _box_mean(values: Tensor, half: int, dim: int) -> Tensor:
    """Average over 2 half + 1 neighbours along an axis; beyond the border the values there are taken on."""
    size = values.shape[dim]
    before, after = values.narrow(dim, 0, 1), values.narrow(dim, size - 1, 1)
    padded = torch.cat([*[before] * half, values, *[after] * half], dim)
    total = padded.narrow(dim, 0, size).clone()
    for offset in range(1, 2 * half + 1):
        total += padded.narrow(dim, offset, size)
    return total.div_(2 * half + 1)


def _peak_mean(probability: Tensor, log_ratios: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean log ratio [N, h, w] over the likeliest five neighbouring bins, and their probability."""
    weighted = probability * log_ratios[:, None, None]
    mass, first = _five_sums(probability).max(dim=1, keepdim=True)
    mean = _five_sums(weighted).gather(1, first) / mass
    return mean.squeeze(1), mass.squeeze(1)


def _five_sums(values: Tensor) -> Tensor:
    """Sum `values` [N, bins, h, w] over each bin and the four after it, [N, bins - 4, h, w]."""
    pairs = values[:, :-1] + values[:, 1:]
    return (pairs[:, :-2] + pairs[:, 2:])[:, :-1].add_(values[:, 4:])
