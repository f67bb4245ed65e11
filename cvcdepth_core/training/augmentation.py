# SPDX-License-Identifier: Apache-2.0
"""Changes to samples: colour jitter (method section 2) and Hflip-S, of which the losses see nothing, and windows."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.training.batch import RigBatch

_LUMA = (0.299, 0.587, 0.114)
"""Weights of ITU-R BT.601, as image editors convert to grey."""

FlipMode = Literal["none", "depth", "pose", "both"]


class ColorJitterConfig(BaseModel):
    """Half widths of the uniform distributions that the jitter is drawn from."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    brightness: float = Field(default=0.2, ge=0, lt=1)
    """Factor 1 +- this."""
    contrast: float = Field(default=0.2, ge=0, lt=1)
    """Factor 1 +- this on the distance to the image's mean grey."""
    saturation: float = Field(default=0.2, ge=0, lt=1)
    """Factor 1 +- this on the distance to each pixel's grey."""
    hue: float = Field(default=0.05, ge=0, le=0.5)
    """Shift of +- this many turns of the colour circle."""


def jitter_colors(frames: Tensor, config: ColorJitterConfig, generators: Sequence[torch.Generator]) -> Tensor:
    """Jitter `frames` [B, T, N, 3, H, W] in [0, 1]; every camera of every sample draws once for all its T frames.

    The four changes come in random order. `generators` are CPU ones, one per sample.
    """
    jittered = torch.empty_like(frames)
    for sample, generator in enumerate(generators):
        for camera in range(frames.shape[2]):
            changes = _draw_changes(config, generator)
            jittered[sample, :, camera] = apply_changes(frames[sample, :, camera], changes)
    return jittered


def apply_changes(images: Tensor, changes: list[tuple[str, float]]) -> Tensor:
    """Apply (name, amount) in order to `images` [..., 3, H, W]: names as in `ColorJitterConfig`, factors or turns."""
    for name, amount in changes:
        images = _COLOR_CHANGES[name](images, amount)
    return images


def _draw_changes(config: ColorJitterConfig, generator: torch.Generator) -> list[tuple[str, float]]:
    names = list(_COLOR_CHANGES)
    order = torch.randperm(len(names), generator=generator).tolist()
    offsets = (2 * torch.rand(len(names), generator=generator) - 1).tolist()
    return [
        (name, (name != "hue") + getattr(config, name) * offset)
        for name, offset in zip((names[i] for i in order), offsets, strict=True)
    ]


def adjust_brightness(images: Tensor, factor: float) -> Tensor:
    """Scale `images` [..., 3, H, W] and clip to [0, 1]."""
    return (images * factor).clamp(0, 1)


def adjust_contrast(images: Tensor, factor: float) -> Tensor:
    """Scale the distance of `images` [..., 3, H, W] to each image's mean grey."""
    return torch.lerp(_grey(images).mean(dim=(-2, -1), keepdim=True), images, factor).clamp(0, 1)


def adjust_saturation(images: Tensor, factor: float) -> Tensor:
    """Scale the distance of `images` [..., 3, H, W] to each pixel's grey."""
    return torch.lerp(_grey(images), images, factor).clamp(0, 1)


def adjust_hue(images: Tensor, turns: float) -> Tensor:
    """Turn the colours of `images` [..., 3, H, W] around the HSV circle; value and saturation stay."""
    red, green, blue = images.unbind(-3)
    value, chroma = images.amax(-3), images.amax(-3) - images.amin(-3)
    divisor = torch.where(chroma > 0, chroma, 1.0)
    hue = torch.where(
        value == red,
        (green - blue) / divisor,
        torch.where(value == green, 2 + (blue - red) / divisor, 4 + (red - green) / divisor),
    )
    sectors = (torch.stack([hue + 5, hue + 3, hue + 1], dim=-3) + 6 * turns) % 6
    return value.unsqueeze(-3) - chroma.unsqueeze(-3) * torch.minimum(sectors, 4 - sectors).clamp(0, 1)


_COLOR_CHANGES: dict[str, Callable[[Tensor, float], Tensor]] = {
    "brightness": adjust_brightness,
    "contrast": adjust_contrast,
    "saturation": adjust_saturation,
    "hue": adjust_hue,
}


def _grey(images: Tensor) -> Tensor:
    weights = images.new_tensor(_LUMA)[:, None, None]
    return (images * weights).sum(dim=-3, keepdim=True).expand_as(images)


def zoom_in(batch: RigBatch, zoom: float, generators: Sequence[torch.Generator]) -> RigBatch:
    """Return a batch with a random window of each camera's pictures in their place, down to 1 / `zoom` of their width.

    The calibration follows, and mask and truth, so that networks and losses have other lenses to learn from; all frames
    of a camera have the same window. `generators` are CPU ones, one per sample.
    """
    if zoom == 1.0:
        return batch
    draws = [torch.rand(batch.cameras, 3, generator=generator, dtype=torch.float64) for generator in generators]
    share, left, top = torch.stack(draws).to(batch.intrinsics).unbind(-1)
    share = 1 / zoom + (1 - 1 / zoom) * share
    height, width = batch.frames.shape[-2:]
    corner = torch.stack([left * (1 - share) * width, top * (1 - share) * height], dim=-1)
    zoomed = copy.copy(batch)
    zoomed.intrinsics = batch.intrinsics.clone()
    zoomed.intrinsics[..., :2, :2] /= share[..., None, None]
    zoomed.intrinsics[..., :2, 2] = (batch.intrinsics[..., :2, 2] + 0.5 - corner) / share[..., None] - 0.5
    grid = _window_grid(share, corner, height, width)
    by_camera = batch.frames.transpose(1, 2)
    zoomed.frames = _sampled(by_camera.flatten(2, 3), grid, "bilinear").view(by_camera.shape).transpose(1, 2)
    zoomed.masks = _sampled(batch.masks, grid, "nearest")
    zoomed.truth = None if batch.truth is None else _sampled(batch.truth, grid, "nearest")
    return zoomed


def _window_grid(share: Tensor, corner: Tensor, height: int, width: int) -> Tensor:
    """Return where the pixels [B, N, H, W, 2] of windows lie in their pictures, as `grid_sample` has it."""
    u, v = (torch.arange(size, device=share.device, dtype=share.dtype) + 0.5 for size in (width, height))
    x = (u * share[..., None] + corner[..., :1]) * 2 / width - 1
    y = (v * share[..., None] + corner[..., 1:]) * 2 / height - 1
    shape = (*share.shape, height, width)
    return torch.stack([x[..., None, :].expand(shape), y[..., None].expand(shape)], dim=-1)


def _sampled(images: Tensor, grid: Tensor, mode: str) -> Tensor:
    """Sample images [B, N, C, H, W] at a grid [B, N, H, W, 2]."""
    found = F.grid_sample(images.flatten(0, 1), grid.flatten(0, 1).to(images), mode, "border", align_corners=False)
    return found.view(images.shape)


def draw_flips(generators: Sequence[torch.Generator]) -> Tensor:
    """Toss one fair coin per sample, with its CPU generator: bool [B], for all its cameras and frames."""
    return torch.stack([torch.rand((), generator=generator) for generator in generators]) < 0.5
