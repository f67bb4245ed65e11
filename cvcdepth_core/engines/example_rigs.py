# SPDX-License-Identifier: Apache-2.0
"""Made-up surround sets, on which engines are compared with the network and from which networks are exported."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.networks import RigImages
from cvcdepth_core.surround_depth import SurroundPictures

CAMERAS = 6

_HEIGHT_ABOVE_GROUND, _RADIUS = 1.5, 0.8  # metres
_FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # base_T_optical of a camera ahead


def ring_of_cameras(height: int, width: int) -> RigImages:
    """Return one set, B = 1, of six cameras in a ring with different lenses; all but the last are present."""
    return RigImages.from_pictures(ring_of_pictures(height, width, present=CAMERAS - 1))


def ring_of_pictures(height: int, width: int, present: int = CAMERAS) -> SurroundPictures:
    """Return the pictures and the calibration of such a ring, of which the first `present` cameras are there."""
    there = np.arange(CAMERAS) < present
    pictures = np.stack([np.roll(street_like_picture(height, width), 17 * i, axis=1) for i in range(CAMERAS)])
    pictures[~there] = 0
    return SurroundPictures(
        pictures=pictures,
        present=there,
        intrinsics=np.stack([_intrinsics(height, width, (0.5 + 0.05 * i) * width) for i in range(CAMERAS)]),
        base_T_camera=np.stack([_mount(-2 * math.pi * i / CAMERAS) for i in range(CAMERAS)]),
        valid=np.ones((CAMERAS, height, width), bool),
    )


def _intrinsics(height: int, width: int, fx: float) -> NDArray[np.float64]:
    return np.array([[fx, 0, (width - 1) / 2], [0, fx, (height - 1) / 2], [0, 0, 1]])


def _mount(yaw: float) -> NDArray[np.float64]:
    """Return `base_T_camera` [4, 4] of a camera that looks outward from the ring, `yaw` rad to the left of ahead."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    turned = np.array([[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    turned[:3, 3] = _RADIUS * cos, _RADIUS * sin, _HEIGHT_ABOVE_GROUND
    mount: NDArray[np.float64] = turned @ _FORWARD
    return mount


def street_like_picture(height: int, width: int) -> Picture:
    """Return a picture [H, W, 3] with what pictures have: light from above, edges at all distances, fine texture."""
    rng = np.random.default_rng(0)
    picture = np.repeat(np.linspace(230, 60, height)[:, None, None], width, axis=1) + np.array([-10.0, 0.0, 10.0])
    for _ in range(40):
        size = rng.integers(4, height // 2, 2)
        corner = rng.integers(0, (width, height))
        cv2.rectangle(picture, corner, corner + size, rng.uniform(20, 235, 3).tolist(), thickness=-1)
    noisy = picture + rng.normal(0, 6, picture.shape)
    result: Picture = np.clip(noisy, 0, 255).astype(np.uint8)
    return result
