# SPDX-License-Identifier: Apache-2.0
"""From linear light to the picture that a camera sends."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.worlds.rendering.light import Light
from cvcdepth_core.worlds.sensors import CameraLook
from cvcdepth_core.worlds.shapes.meshes import Floats

_DARKEST = 0.01
_MOST_GAIN = 40.0
_GREY = np.float32(0.18)


def develop(light: Floats, look: CameraLook, daylight: float, seed: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return the picture, uint8 RGB [H, W, 3], of linear light [H, W, 3].

    `daylight` is that of `daylight_of`, for fixed exposures; `seed` is that of the noise, `seed[0]` that of the camera.
    """
    exposed = light * np.float32(_gain(light, look, daylight))
    exposed *= np.array(look.white_balance, np.float32)
    exposed *= _lens_shade(light.shape[0], light.shape[1], look.vignetting, look.dirt, seed[0])[..., None]
    if look.bloom:
        exposed += np.float32(look.bloom) * cv2.GaussianBlur(
            np.clip(exposed - 1.0, 0.0, 8.0), (0, 0), light.shape[1] / 50
        )
    if look.blur > 0.2:
        exposed = cv2.GaussianBlur(exposed, (0, 0), look.blur)
    if look.noise:
        exposed = _noisy(exposed, look.noise, seed)
    picture = _toned(np.maximum(exposed, 0.0), look)
    if look.sharpening:
        picture = picture + np.float32(look.sharpening) * (picture - cv2.GaussianBlur(picture, (0, 0), 1.0))
    return np.rint(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8)


def daylight_of(light: Light) -> float:
    """Return how much light falls on level ground in the open."""
    upward = np.array([[0.0], [0.0], [1.0]], np.float32)
    sky = float(light.ambient(upward).mean())
    return max(0.25, sky + float(light.sunlight.mean()) * max(0.0, float(light.sun[2])))


def _gain(light: Floats, look: CameraLook, daylight: float) -> float:
    if look.exposure == "fixed":
        return look.key / (float(_GREY) * daylight)
    grey = np.clip(light.mean(axis=-1), _DARKEST, 4.0)
    typical = float(np.exp(np.log(grey).mean()))
    # Light places count too: a camera would rather lose shadows than all of the sky.
    bright = float(np.quantile(grey, 0.8))
    return min(look.key / (0.6 * typical + 0.25 * bright), _MOST_GAIN)


@lru_cache(maxsize=64)
def _lens_shade(height: int, width: int, vignetting: float, dirt: float, seed: int) -> Floats:
    """Return what the lens lets through, [H, W]."""
    y, x = np.mgrid[:height, :width]
    dx, dy = (x - (width - 1) / 2) / (width / 2), (y - (height - 1) / 2) / (width / 2)
    shade = 1.0 - vignetting * (dx * dx + dy * dy) / (1.0 + (height / width) ** 2)
    rng = np.random.default_rng([seed, 41])
    for _ in range(int(12 * dirt)):
        u, v, size = rng.uniform(-1, 1), rng.uniform(-0.6, 0.6), rng.uniform(0.02, 0.12)
        shade *= 1.0 - rng.uniform(0.1, 0.5) * np.exp(-((((dx - u) ** 2 + (dy - v) ** 2) / size**2) ** 2))
    through: Floats = np.clip(shade, 0.05, 1.0).astype(np.float32)
    return through


def _noisy(exposed: Floats, noise: float, seed: tuple[int, ...]) -> Floats:
    """Add the noise of photons, which grows with the light's root, and of reading, which is always there."""
    rng = np.random.default_rng(seed)
    deviation = np.float32(noise) * (np.float32(0.12) + np.sqrt(np.clip(exposed, 0.0, 1.5)))
    found: Floats = exposed + deviation * rng.standard_normal(exposed.shape, np.float32)
    return found


def _toned(exposed: Floats, look: CameraLook) -> Floats:
    """Bend the lights so that they do not clip at once, then apply gamma, saturation and contrast."""
    bent = 1.0 - np.exp(-1.25 * exposed)
    picture = bent ** np.float32(1.0 / look.gamma)
    if look.saturation != 1.0:
        grey = picture.mean(axis=-1, keepdims=True)
        picture = grey + (picture - grey) * np.float32(look.saturation)
    toned: Floats = (picture - 0.5) * np.float32(look.contrast) + 0.5
    return toned
