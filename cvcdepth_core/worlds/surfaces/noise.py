# SPDX-License-Identifier: Apache-2.0
"""Tiles of noise with their averages at every scale, for textures that neither repeat visibly nor flicker far away."""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache

import cv2
import numpy as np

from cvcdepth_core.worlds.shapes.meshes import Floats, Ints

TILE = 256
"""Texels of a tile's side; tiles repeat."""
_LEVELS = 7  # 256 to 4 texels
_ROW = 4096  # how samples are laid out for OpenCV, which counts rows and columns in 16 bits
_PADDED = TILE + 2


class Noise(IntEnum):
    """What the tiles look like; each has mean 0 and standard deviation 1."""

    GRAIN = 0
    """Almost every texel for itself."""
    ROUGH = 1
    """Spots of all sizes, small ones strong."""
    CLOUDY = 2
    """Spots of all sizes, large ones strong."""
    SMOOTH = 3
    """Large soft spots."""
    CRACKS = 4
    """A few thin dark lines."""
    BLOTCHES = 5
    """Flat patches with clear borders."""
    STREAKS = 6
    """Drawn out along v."""
    PEBBLES = 7
    """Cells of different brightness with dark borders."""


@lru_cache(maxsize=1)
def _atlas() -> tuple[Floats, Ints]:
    """Return all tiles at all levels in one image, and the column at which each level begins."""
    tiles = _tiles()
    widths = [(TILE >> level) + 2 for level in range(_LEVELS)]
    starts = np.cumsum([0, *widths[:-1]])
    atlas = np.zeros((_PADDED * len(tiles), sum(widths)), np.float32)
    for number, tile in enumerate(tiles):
        for level, column in enumerate(starts):
            size = TILE >> level
            wrapped = np.pad(tile, ((0, 1), (0, 1)), mode="wrap")
            atlas[number * _PADDED : number * _PADDED + size + 1, column : column + size + 1] = wrapped
            tile = tile.reshape(size // 2, 2, size // 2, 2).mean(axis=(1, 3))
    return atlas, starts.astype(np.int32)


def noise(kind: Noise | Ints, u: Floats, v: Floats, footprint: Floats) -> Floats:
    """Sample tiles at u, v [N] in texels, averaged over about `footprint` [N] texels; float32 [N]."""
    atlas, starts = _atlas()
    level = np.clip(np.log2(np.maximum(footprint, 1.0)).astype(np.int32), 0, _LEVELS - 1)
    scale = np.ldexp(np.float32(1.0), -level)
    size = np.float32(TILE) * scale
    x = np.mod((u.astype(np.float32) + np.float32(0.5)) * scale - np.float32(0.5), size) + starts[level]
    y = np.mod((v.astype(np.float32) + np.float32(0.5)) * scale - np.float32(0.5), size)
    y += np.asarray(kind, np.float32) * _PADDED
    return _sampled(atlas, x.astype(np.float32), y.astype(np.float32))


def _sampled(image: Floats, x: Floats, y: Floats) -> Floats:
    count = len(x)
    rows = max(1, -(-count // _ROW))
    padded = np.zeros((2, rows * _ROW), np.float32)
    padded[0, :count], padded[1, :count] = x, y
    mapped: Floats = cv2.remap(image, padded[0].reshape(rows, _ROW), padded[1].reshape(rows, _ROW), cv2.INTER_LINEAR)
    return mapped.reshape(-1)[:count]


def _tiles() -> list[Floats]:
    rng = np.random.default_rng(20260101)
    cracks = -np.exp(-((_spectral(rng, 1.5) / 0.05) ** 2)) * np.clip(_spectral(rng, 1.6) + 0.3, 0.0, 1.0)
    flat = np.sign(_spectral(rng, 1.2)) + 0.35 * _spectral(rng, 1.0)
    tiles = [
        _spectral(rng, 0.35),
        _spectral(rng, 0.8),
        _spectral(rng, 1.3),
        _spectral(rng, 1.9),
        cracks,
        flat,
        _spectral(rng, 1.1, stretch=9.0),
        _pebbles(rng),
    ]
    return [_standardised(tile) for tile in tiles]


def _spectral(rng: np.random.Generator, slope: float, stretch: float = 1.0) -> Floats:
    """Noise whose amplitude falls with frequency^slope; `stretch` draws it out along v."""
    fx, fy = np.meshgrid(np.fft.fftfreq(TILE) * TILE, np.fft.fftfreq(TILE) * TILE)
    frequency = np.hypot(fx, fy * stretch)
    amplitude = np.where(frequency > 0, np.maximum(frequency, 1e-9) ** -slope, 0.0)
    values: Floats = np.fft.ifft2(np.fft.fft2(rng.normal(size=(TILE, TILE))) * amplitude).real
    found: Floats = values / values.std()
    return found


def _pebbles(rng: np.random.Generator, cells: int = 16) -> Floats:
    """Cells around jittered points: distance to the nearest one, and a brightness of its own."""
    step = TILE // cells
    offsets = rng.uniform(0.1, 0.9, (cells, cells, 2)) * step
    shades = rng.normal(size=(cells, cells))
    y, x = np.mgrid[:TILE, :TILE]
    distance, shade = np.full((TILE, TILE), np.inf), np.zeros((TILE, TILE))
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            row, column = y // step + dy, x // step + dx
            point = offsets[row % cells, column % cells]
            squared = (column * step + point[..., 0] - x) ** 2 + (row * step + point[..., 1] - y) ** 2
            nearer = squared < distance
            shade = np.where(nearer, shades[row % cells, column % cells], shade)
            distance = np.where(nearer, squared, distance)
    found: Floats = shade - 2.5 * (np.sqrt(distance) / step) ** 2
    return found


def _standardised(tile: Floats) -> Floats:
    centred = np.clip((tile - tile.mean()) / tile.std(), -6.0, 3.0)
    scaled: Floats = ((centred - centred.mean()) / centred.std()).astype(np.float32)
    return scaled
