# SPDX-License-Identifier: Apache-2.0
"""What the networks see differently from the losses: colour jitter (method section 2), and the coins of Hflip-S."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

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


def draw_flips(generators: Sequence[torch.Generator]) -> Tensor:
    """Toss one fair coin per sample, with its CPU generator: bool [B], for all its cameras and frames."""
    return torch.stack([torch.rand((), generator=generator) for generator in generators]) < 0.5
