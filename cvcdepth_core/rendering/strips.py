# SPDX-License-Identifier: Apache-2.0
"""Strips: the runs of columns of cameras' images where neighbours may see something, which is all that overlaps need.

Neighbouring cameras of a ring share a quarter of a picture or so. Beyond the strips a rendered view is black and its
mask zero, so that nothing there enters a masked mean.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from cvcdepth_core.rendering.projection import Reprojection, divisor
from cvcdepth_core.rendering.view_synthesis import sum_by_target

_REACH = 1.5
"""Pixels beyond a source's outermost ones from where its image is still mixed into a view: 1, and some for rounding."""
_BESIDE = 2
"""Columns beside those that may see something: one for the windows of SSIM, and one for rounding."""
_WIDTHS = 8
"""Different widths that strips may have, parts of the image's, so that many go through one operation."""

Interval = tuple[int, int]
"""First column, and the one after the last."""


@dataclass(frozen=True)
class Strips:
    """S strips of one width w, of the images [H, W] of N cameras, in which P pairs (target, source) are rendered."""

    cameras: int
    """N."""
    image_width: int
    """W."""
    width: int
    """w."""
    camera_of_strip: tuple[int, ...]
    """[S]."""
    firsts: tuple[int, ...]
    """[S] the first column."""
    pairs: tuple[int, ...]
    """[P] which of the rig's pairs these are."""
    strip_of_pair: tuple[int, ...]
    """[P] the strip of the pair's target that the pair is rendered in."""

    @classmethod
    def from_whole_images(cls, targets: Sequence[int], cameras: int, width: int) -> Strips:
        """Return one strip for every camera, all of its image, for all pairs with these `targets`."""
        pairs = tuple(range(len(targets)))
        return cls(cameras, width, width, tuple(range(cameras)), (0,) * cameras, pairs, tuple(targets))

    @property
    def are_whole_images(self) -> bool:
        """Whether nothing is left out, one strip after the other being one camera after the other."""
        return self.width == self.image_width and self.camera_of_strip == tuple(range(self.cameras))

    @property
    def share(self) -> float:
        """Of an image's columns, those of a strip."""
        return self.width / self.image_width

    def cut(self, images: Tensor) -> Tensor:
        """Return the strips [..., S, C, H, w] of `images` [..., N, C, H, W]."""
        if self.are_whole_images:
            return images
        strips: Tensor = _Linear.apply(images, self.copy_cut, self.copy_paste)  # type: ignore[no-untyped-call]
        return strips

    def paste(self, strips: Tensor) -> Tensor:
        """Return images [..., N, C, H, W] that are zero beside these `strips` [..., S, C, H, w]."""
        if self.are_whole_images:
            return strips
        images: Tensor = _Linear.apply(strips, self.copy_paste, self.copy_cut)  # type: ignore[no-untyped-call]
        return images

    def of_pairs(self, strips: Tensor) -> Tensor:
        """Return for each pair [..., P, C, H, w] its strip of `strips` [..., S, C, H, w]."""
        return strips if self._are_pairs else strips[..., list(self.strip_of_pair), :, :, :]

    def sum_of_pairs(self, views: Tensor) -> Tensor:
        """Add up `views` [..., P, C, H, w] of pairs that share a strip, to [..., S, C, H, w]."""
        if self._are_pairs:
            return views
        return sum_by_target(views, torch.tensor(self.strip_of_pair, device=views.device), len(self.firsts))

    def sum_of_cameras(self, values: Tensor) -> Tensor:
        """Add up `values` [..., S] of the strips of each camera, to [..., N]."""
        index = torch.tensor(self.camera_of_strip, device=values.device)
        return values.new_zeros(*values.shape[:-1], self.cameras).index_add(-1, index, values)

    def first_of_pairs(self, like: Tensor) -> Tensor:
        """Return the first column [P] of each pair's strip, in the type of another tensor."""
        return like.new_tensor([self.firsts[strip] for strip in self.strip_of_pair])

    @property
    def _are_pairs(self) -> bool:
        return self.strip_of_pair == tuple(range(len(self.firsts)))

    def copy_cut(self, images: Tensor) -> Tensor:
        """Return `cut`, without a gradient."""
        strips = images.new_empty(*images.shape[:-4], len(self.firsts), *images.shape[-3:-1], self.width)
        for strip, part in zip(strips.unbind(-4), self._parts(images), strict=True):
            strip.copy_(part)
        return strips

    def copy_paste(self, strips: Tensor) -> Tensor:
        """Return `paste`, without a gradient; where strips of a camera share columns, their sum."""
        images = strips.new_zeros(*strips.shape[:-4], self.cameras, *strips.shape[-3:-1], self.image_width)
        for strip, part in zip(strips.unbind(-4), self._parts(images), strict=True):
            part.add_(strip)
        return images

    def _parts(self, images: Tensor) -> Iterable[Tensor]:
        for camera, first in zip(self.camera_of_strip, self.firsts, strict=True):
            yield images.select(-4, camera).narrow(-1, first, self.width)


def divide_into_strips(seen: Sequence[Interval], targets: Sequence[int], cameras: int, width: int) -> list[Strips]:
    """Return strips, in groups of the same width, that hold the columns `seen` of each pair's target.

    Pairs of one target that see columns in common share a strip. Whole images where strips save nothing.
    """
    runs = [
        (camera, run)
        for camera in range(cameras)
        for run in _united(own for target, own in zip(targets, seen, strict=True) if target == camera)
    ]
    step = -(-width // _WIDTHS)
    widths = [min(width, -(-(last - first) // step) * step) for _, (first, last) in runs]
    if sum(widths) >= width * cameras:
        return [Strips.from_whole_images(targets, cameras, width)]
    run_at = {(camera, column): i for i, (camera, run) in enumerate(runs) for column in range(*run)}
    run_of_pair = [run_at[target, first] for target, (first, _) in zip(targets, seen, strict=True)]
    groups = []
    for one_width in sorted(set(widths)):
        chosen = [i for i, found in enumerate(widths) if found == one_width]
        pairs = [pair for pair, run in enumerate(run_of_pair) if run in chosen]
        groups.append(
            Strips(
                cameras,
                width,
                one_width,
                tuple(runs[i][0] for i in chosen),
                tuple(min(runs[i][1][0], width - one_width) for i in chosen),
                tuple(pairs),
                tuple(chosen.index(run_of_pair[pair]) for pair in pairs),
            )
        )
    return groups


class _Linear(torch.autograd.Function):
    """A linear function whose gradient its adjoint gives."""

    @staticmethod
    def forward(
        ctx: Any, values: Tensor, function: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor]
    ) -> Tensor:
        ctx.adjoint = adjoint
        return function(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return ctx.adjoint(grad), None, None


@torch.no_grad()
def seen_columns(depth: Tensor, targets: Tensor, source_of_target: Reprojection) -> list[Interval]:
    """Return for each of P pairs the columns of the target where the source may be sampled, at any sample and frame.

    `depth` [B, N, 1, H, W] in metres, `targets` [P] index N, `source_of_target` [B, F, P]; sources have the same size.
    There may be columns too many, never too few: a pixel is sampled where its point is inside of the four planes
    through the source's centre and the borders of its image, or outside of them all, behind the source. The distance
    from a plane over a column is extreme at the column's two ends, at its least or greatest depth.
    """
    distances = _distances_from_borders(depth, targets, source_of_target)
    ahead = (distances.amax(dim=-2) > 0).all(dim=0)
    behind = (distances.amin(dim=-2) < 0).all(dim=0)
    seen = (ahead | behind).flatten(0, 1).any(dim=0)
    width = depth.shape[-1]
    intervals = [columns.nonzero().flatten().tolist() or [0] for columns in seen.cpu()]
    return [(max(0, of[0] - _BESIDE), min(width, of[-1] + 1 + _BESIDE)) for of in intervals]


def _distances_from_borders(depth: Tensor, targets: Tensor, source_of_target: Reprojection) -> Tensor:
    """Return [4, B, F, P, 4, W]: of the four borders, at the four extreme points of each column; in any unit."""
    height, width = depth.shape[-2:]
    extreme_depths = torch.stack([depth.amin(dim=-2), depth.amax(dim=-2)], dim=-2)[:, targets]  # [B, P, 1, 2, W]
    columns = torch.arange(width).to(depth)
    pixels = torch.stack(
        [torch.stack([columns, torch.full_like(columns, row), torch.ones_like(columns)]) for row in (0, height - 1)],
        dim=1,
    )  # [3, 2, W]
    turned = (source_of_target.turn @ pixels.flatten(1)).view(*source_of_target.turn.shape[:-1], 2, 1, width)
    points = turned * extreme_depths[:, None, :, :, None] + source_of_target.shift[..., None, None]
    x, y, z = points.flatten(-3, -2).unbind(-3)
    z = divisor(z)
    return torch.stack([x + _REACH * z, (width - 1 + _REACH) * z - x, y + _REACH * z, (height - 1 + _REACH) * z - y])


def _united(intervals: Iterable[Interval]) -> list[Interval]:
    """Join those that touch."""
    united: list[Interval] = []
    for first, last in sorted(intervals):
        if united and first <= united[-1][1]:
            united[-1] = (united[-1][0], max(last, united[-1][1]))
        else:
            united.append((first, last))
    return united
