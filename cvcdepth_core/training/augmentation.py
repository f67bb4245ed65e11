# SPDX-License-Identifier: Apache-2.0
"""What the networks see differently from the losses: colour jitter (method section 2) and Hflip-S (section 7)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from cvcdepth_core.networks import RigImages

_LUMA = (0.299, 0.587, 0.114)
"""Weights of ITU-R BT.601, as image editors convert to grey."""

LATERAL_AXIS = 1
"""Of the vehicle: y, to the left (REP 103)."""

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


def mirror(images: Tensor, flips: Tensor) -> Tensor:
    """Mirror the samples of `images` [B, ..., W] left to right where `flips` [B] says so."""
    return _where(flips, images.flip(-1), images)


def mirror_motion(motions: Tensor, flips: Tensor, axis: int = 0) -> Tensor:
    """Express motions [B, ..., 4, 4] in the mirrored world where `flips` [B] says so: T <- S T S.

    S negates `axis`, the one across the image: x = 0 in an optical frame, `LATERAL_AXIS` in the vehicle's.
    """
    return _where(flips, _negated(_negated(motions, -2, axis), -1, axis), motions)


def mirror_rig(rig: RigImages, flips: Tensor) -> RigImages:
    """Mirror the world of the samples where `flips` [B] says so: every picture, and the rig that took them.

    E -> S_v E S_c with S_v = diag(1, -1, 1, 1) across the vehicle and S_c = diag(-1, 1, 1, 1) across the image: a rig
    that could be built, so that a network which looks at the mounts can be trained with flips too.
    """
    width = rig.images.shape[-1]
    mounts = _negated(_negated(rig.base_T_camera, -2, LATERAL_AXIS), -1, 0)
    return rig._replace(
        images=mirror(rig.images, flips),
        intrinsics=_where(flips, _mirrored_intrinsics(rig.intrinsics, width), rig.intrinsics),
        base_T_camera=_where(flips, mounts, rig.base_T_camera),
        masks=mirror(rig.masks, flips),
    )


def _mirrored_intrinsics(intrinsics: Tensor, width: int) -> Tensor:
    """Return K [..., 3, 3] of the mirrored picture: the principal point changes sides, a skew its sign."""
    mirrored = intrinsics.clone()
    mirrored[..., 0, 1] *= -1
    mirrored[..., 0, 2] = width - 1 - intrinsics[..., 0, 2]
    return mirrored


def _negated(matrices: Tensor, dimension: int, index: int) -> Tensor:
    """Return [..., 4, 4] with one row (dimension -2) or column (-1) negated."""
    signs = matrices.new_ones(4)
    signs[index] = -1.0
    return matrices * (signs[:, None] if dimension == -2 else signs)


def _where(flips: Tensor, mirrored: Tensor, plain: Tensor) -> Tensor:
    """Choose sample by sample, [B, ...]."""
    return torch.where(_per_sample(flips, plain), mirrored, plain)


def _per_sample(flips: Tensor, like: Tensor) -> Tensor:
    return flips.to(like.device).view(-1, *[1] * (like.ndim - 1))
