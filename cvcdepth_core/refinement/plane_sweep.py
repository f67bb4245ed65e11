# SPDX-License-Identifier: Apache-2.0
"""The relative plane sweep: how well each multiple of the prior depth explains what other views show.

A hypothesis is the prior times a factor, the same for all pixels of a patch, so that patches follow the prior's slopes.
Views are compared by the zero-mean normalised cross-correlation (ZNCC) of 5 x 5 patches. What has no picture is NaN,
and NaN spreads by itself to every patch that would need it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.refinement.moments import View
from cvcdepth_core.rig.poses import inverse

PATCH = 5
_MARGIN = PATCH // 2
_LEAST_SQUARES = PATCH**2 * 1.1**2  # of a patch around its mean: noise of 1.1 grey levels
_NEAREST = 0.1  # metres in front of a source
_BEHIND = 4.0  # a coordinate outside of the sampled picture, which spans -1 to 1
_PARALLAX_WIDTH = 320  # parallax is counted in pixels of a picture this wide
_LEAST_PARALLAX, _LARGEST_PARALLAX = 1.0, 12.0
_COARSE = 4  # pixels between those that are looked at to find what a source sees
_TINY = 1e-12


class SweepCost(NamedTuple):
    """What the sources say of each hypothesis about one camera's depth."""

    cost: Tensor
    """[bins, h, w] mean of 1 - ZNCC times `evidence`; 0 where no source sees the pixel."""
    evidence: Tensor
    """[h, w] in [0, 1]: whether there is parallax enough; 0 where nothing could be compared."""
    fineness: Tensor
    """[h, w] in [0, 1]: below `evidence` where all sources move by many pixels from one hypothesis to the next."""
    contrast: Tensor
    """[h, w] difference of the dearest and the cheapest hypothesis: 0 where pictures show no texture."""


def sweep(view: View, depth: Tensor, sources: Sequence[View], log_ratios: Tensor) -> SweepCost:
    """Compare a view with its sources; `depth` [h, w] is its prior (NaN unknown), `log_ratios` [bins] to that."""
    reference = _Reference.of(view, depth)
    hypotheses = (-log_ratios).exp()[:, None, None]
    likeness = depth.new_zeros(len(log_ratios), *depth.shape)
    weights, evidence = torch.zeros_like(likeness), torch.zeros_like(depth)
    for source in sources:
        geometry = _Geometry.between(view, source)
        window = _seen_window(reference.nearness, geometry, hypotheses[:: len(hypotheses) // 4])
        if window is not None:
            _add_source(reference.cut(window), source.grey, geometry, hypotheses, _Sums(likeness, weights, evidence))
    return _combined(_Sums(likeness, weights, evidence))


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Where a pixel of the view lies in the source: (matrix (u, v, 1) + offset / depth), homogeneous, -1..1."""

    matrix: NDArray[np.float64]
    """[3, 3]"""
    offset: NDArray[np.float64]
    """[3]"""
    half_size: tuple[float, float]
    """Pixels of the source per unit of its coordinates, across and down."""

    @classmethod
    def between(cls, view: View, source: View) -> _Geometry:
        """Return the geometry of a padded source for the view; relative poses are taken in float64."""
        source_T_view = inverse(source.world_T_camera) @ view.world_T_camera
        height, width = source.grey.shape
        half = ((width - 1) / 2, (height - 1) / 2)
        # The border is one pixel wide: pixel u of the picture is u + 1 of the padded one.
        normalise = np.array([[1 / half[0], 0, 1 / half[0] - 1], [0, 1 / half[1], 1 / half[1] - 1], [0, 0, 1]])
        projection = normalise @ source.intrinsics
        matrix = projection @ source_T_view[:3, :3] @ np.linalg.inv(view.intrinsics)
        return cls(matrix, projection @ source_T_view[:3, 3], half)

    def directions(self, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the three coordinates [rows, columns] of infinitely far points, from pixel numbers in float64."""
        u, v = columns[None], rows[:, None]
        x, y, z = ((m[0] * u + m[1] * v + m[2]).float() for m in self.matrix.tolist())
        return x, y, z


@dataclass(frozen=True, eq=False)
class _Reference:
    """The view whose depth is looked for, or a window of it, with its patches' statistics."""

    grey: Tensor
    """[h, w], NaN also where the prior is unknown."""
    nearness: Tensor
    """[h, w] inverse prior, 1/m; 0 where unknown."""
    mean: Tensor
    """[h - 4, w - 4] of each patch."""
    inverse_norm: Tensor
    """[h - 4, w - 4] one over the root of the patch's squares around its mean."""
    rows: slice
    columns: slice
    full_width: int

    @classmethod
    def of(cls, view: View, depth: Tensor) -> _Reference:
        unknown = torch.isnan(depth)
        grey = torch.where(unknown, torch.nan, view.grey[1:-1, 1:-1])
        total = _patch_sums(grey)
        squares = _patch_sums(grey.square()) - total.square() / PATCH**2
        height, width = depth.shape
        return cls(
            grey,
            torch.where(unknown, 0.0, depth.reciprocal()),
            total / PATCH**2,
            squares.clamp(min=_LEAST_SQUARES).rsqrt(),
            slice(0, height),
            slice(0, width),
            width,
        )

    def cut(self, window: tuple[slice, slice]) -> _Reference:
        """Return a window of the view."""
        rows, columns = window
        inner = (slice(rows.start, rows.stop - 2 * _MARGIN), slice(columns.start, columns.stop - 2 * _MARGIN))
        parts = (self.grey[window], self.nearness[window], self.mean[inner], self.inverse_norm[inner])
        return _Reference(*parts, rows, columns, self.full_width)

    @property
    def inner(self) -> tuple[slice, slice, slice]:
        """Where in the whole volume [bins, h, w] the window's patches have their middles."""
        rows, columns = self.rows, self.columns
        return (
            slice(None),
            slice(rows.start + _MARGIN, rows.stop - _MARGIN),
            slice(columns.start + _MARGIN, columns.stop - _MARGIN),
        )


class _Sums(NamedTuple):
    """What is added up over the sources."""

    likeness: Tensor
    """[bins, h, w] ZNCC times weight."""
    weights: Tensor
    """[bins, h, w] of the sources that see the hypothesis."""
    evidence: Tensor
    """[h, w] by parallax, times the share of the hypotheses that are seen."""


def _add_source(reference: _Reference, grey: Tensor, geometry: _Geometry, hypotheses: Tensor, sums: _Sums) -> None:
    """Add what one source says to the sums, where it sees something."""
    grid = _sampling_grid(reference, geometry, hypotheses)
    parallax = _parallax(grid, geometry, hypotheses) * (_PARALLAX_WIDTH / reference.full_width)
    evidence = (parallax / _LEAST_PARALLAX).clamp_(max=1.0).square_()
    weight = evidence * (_LARGEST_PARALLAX / parallax.clamp_(min=_LARGEST_PARALLAX)).square_()
    correlation = _correlation(reference, _sampled(grey, grid))
    seen = (correlation * 0 + 1).nan_to_num_(0.0)  # 1 or 0: five times as quick as to ask and to choose
    sums.evidence[reference.inner[1:]] += evidence * seen.mean(0)
    sums.weights[reference.inner].addcmul_(seen, weight.expand_as(seen))
    sums.likeness[reference.inner].addcmul_(correlation.nan_to_num_(0.0), weight.expand_as(seen))


def _sampling_grid(reference: _Reference, geometry: _Geometry, hypotheses: Tensor) -> Tensor:
    """Return where in the source each hypothesis lies, [2, bins, h, w] from -1 to 1."""
    rows = torch.arange(reference.rows.start, reference.rows.stop, dtype=torch.float64)
    columns = torch.arange(reference.columns.start, reference.columns.stop, dtype=torch.float64)
    x, y, z = (part.to(hypotheses.device) for part in geometry.directions(rows, columns))
    bx, by, bz = geometry.offset.tolist()
    nearness = reference.nearness * hypotheses
    scale = torch.add(z, nearness, alpha=bz)
    behind = _behind(reference.nearness, hypotheses, z, bz)
    grid = nearness.new_empty(2, *nearness.shape)
    torch.add(x, nearness, alpha=bx, out=grid[0])
    torch.add(y, nearness, alpha=by, out=grid[1])
    grid /= scale
    if behind is not None:
        grid[0].masked_fill_(behind, _BEHIND)
    return grid


def _behind(nearness: Tensor, hypotheses: Tensor, z: Tensor, bz: float) -> Tensor | None:
    """Return which hypotheses [bins, h, w] are not in front of the source; None, most of the time, for none."""
    slope = bz - _NEAREST  # z + bz / d > _NEAREST / d is linear in 1 / d: the ends tell of all between them
    ends = torch.stack([hypotheses.amin(), hypotheses.amax()])[:, None, None]
    if bool((torch.add(z, nearness * ends, alpha=slope) > 0).all()):
        return None
    return torch.add(z, nearness * hypotheses, alpha=slope) <= 0


def _sampled(grey: Tensor, grid: Tensor) -> Tensor:
    """Interpolate the padded picture [h, w] at `grid` [2, bins, h', w']; outside it is NaN like its border."""
    _, bins, height, width = grid.shape
    coordinates = grid.permute(1, 2, 3, 0).reshape(1, bins * height, width, 2)
    sampled = F.grid_sample(grey[None, None], coordinates, padding_mode="border", align_corners=True)
    return sampled.view(bins, height, width)


def _correlation(reference: _Reference, sampled: Tensor) -> Tensor:
    """Return the ZNCC of all patches, [bins, h - 4, w - 4]; NaN where a patch is not seen whole."""
    total = _patch_sums(sampled)
    squares = _patch_sums(sampled.square()).addcmul_(total, total, value=-1 / PATCH**2)
    products = _patch_sums(sampled.mul_(reference.grey)).addcmul_(total, reference.mean, value=-1)
    norm = squares.clamp_(min=_LEAST_SQUARES).rsqrt_().mul_(reference.inverse_norm)
    return products.mul_(norm)


def _patch_sums(x: Tensor) -> Tensor:
    """Sum `x` [..., h, w] over patches, [..., h - 4, w - 4]."""
    pairs = x[..., :-1, :] + x[..., 1:, :]
    x = (pairs[..., :-2, :] + pairs[..., 2:, :])[..., :-1, :].add_(x[..., 4:, :])
    pairs = x[..., :-1] + x[..., 1:]
    return (pairs[..., :-2] + pairs[..., 2:])[..., :-1].add_(x[..., 4:])


def _parallax(grid: Tensor, geometry: _Geometry, hypotheses: Tensor) -> Tensor:
    """Return by how many pixels a patch moves in the source per unit of log depth, at the prior: [h - 4, w - 4]."""
    middle = len(hypotheses) // 2
    inner = slice(_MARGIN, -_MARGIN)
    step = grid[:, middle + 1, inner, inner] - grid[:, middle - 1, inner, inner]
    across, down = (half * part for half, part in zip(geometry.half_size, step, strict=True))
    log_step = (hypotheses[middle - 1] / hypotheses[middle + 1]).log()
    return torch.hypot(across, down).div_(log_step).nan_to_num_(0.0)


def _seen_window(nearness: Tensor, geometry: _Geometry, hypotheses: Tensor) -> tuple[slice, slice] | None:
    """Return rows and columns outside of which the source sees no hypothesis; None where it sees none at all."""
    coarse = nearness[::_COARSE, ::_COARSE] * hypotheses
    rows, columns = (torch.arange(0, size, _COARSE, dtype=torch.float64) for size in nearness.shape)
    x, y, z = (part.to(nearness.device) for part in geometry.directions(rows, columns))
    bx, by, bz = geometry.offset.tolist()
    in_front = torch.add(z, coarse, alpha=bz - _NEAREST) > 0
    scale = torch.add(z, coarse, alpha=bz)
    inside = ((x + bx * coarse) / scale).abs() <= 1
    inside &= ((y + by * coarse) / scale).abs() <= 1
    seen = (inside & in_front).any(0)
    spans = (_span(seen.any(1), nearness.shape[0]), _span(seen.any(0), nearness.shape[1]))
    return None if spans[0] is None or spans[1] is None else (spans[0], spans[1])


def _span(seen: Tensor, size: int) -> slice | None:
    """Return the pixels around the coarse ones that are seen, with room for their patches; None for too few."""
    found = seen.nonzero().squeeze(1)
    if not len(found):
        return None
    first = max(0, (int(found[0]) - 1) * _COARSE - _MARGIN)
    last = min(size, (int(found[-1]) + 1) * _COARSE + _MARGIN + 1)
    return slice(first, last) if last - first > PATCH else None


def _combined(sums: _Sums) -> SweepCost:
    """Average over sources; a hypothesis that none sees costs what its pixel's others do on average: it is neutral."""
    evidence = sums.evidence.clamp(max=1.0)
    likeness = sums.likeness / sums.weights.clamp(min=_TINY)
    seen = sums.weights > 0
    mean = likeness.sum(0) / seen.sum(0).clamp(min=1)
    cost = (1 - torch.where(seen, likeness, mean)).mul_(evidence)
    fineness = sums.weights.mean(0).clamp_(max=1.0)
    contrast = cost.amax(0) - cost.amin(0)
    return SweepCost(*(_to_border(part) for part in (cost, evidence, fineness, contrast)))


def _to_border(values: Tensor) -> Tensor:
    """Take the outermost middles of patches [..., h, w] on to the border, in place: those patches cover it."""
    values[..., :_MARGIN, :] = values[..., _MARGIN : _MARGIN + 1, :]
    values[..., -_MARGIN:, :] = values[..., -_MARGIN - 1 : -_MARGIN, :]
    values[..., :_MARGIN] = values[..., _MARGIN : _MARGIN + 1]
    values[..., -_MARGIN:] = values[..., -_MARGIN - 1 : -_MARGIN]
    return values
