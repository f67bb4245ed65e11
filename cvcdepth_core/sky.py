# SPDX-License-Identifier: Apache-2.0
"""The sky: pixels that show nothing whose depth could be measured.

A network that knows the sky puts it at its farthest depth. For one that does not, `sky_in_picture` looks for what is
smooth from the picture's upper edge down to something above the horizon, at least as bright as what lies below, no
redder than grey, and not near by the network's own depth: a light wall looks like a clouded sky. In doubt there is no
sky: points that stay cost less than an obstacle that vanishes.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.surround_depth import SurroundPictures

_FAR_SHARE = 0.5
"""Of the farthest depth that a network can say: beyond is sky, or as good as that."""

_WIDTH = 160  # columns, about, of the picture that is searched
_SMOOTH = 7.0  # grey levels between neighbouring pixels of it, at most
_BELOW_HORIZON = -0.03  # sine of the elevation to which mounts and hills may let the sky seem to reach
_LEAST_SHARE = 0.004  # of the picture: smaller patches are no sky
_OUTLINE = 4  # pixels of the small picture around smooth sky in which its colour decides
_LIKE_THE_SKY = 3.0  # standard deviations of the sky's colour
_LEAST_DEVIATION = 6.0  # grey levels
_NEAREST = 12.0  # metres that the network's depth of a sky has at least, in the middle of its pixels
_WARMEST = 12.0  # grey levels by which the sky's red may exceed its blue


def beyond_measure(
    depth: NDArray[np.float32], fx: NDArray[np.float64], max_depth: float, focal_scale: float
) -> NDArray[np.bool_]:
    """Return where depth [N, H, W] is at the farthest that a network of that range can say, cameras of `fx` [N]."""
    farthest = (max_depth * fx / focal_scale).astype(np.float32)[:, None, None]
    with np.errstate(invalid="ignore"):
        beyond: NDArray[np.bool_] = depth >= np.float32(_FAR_SHARE) * farthest
    return beyond


def sky_in_pictures(surround: SurroundPictures, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return where the pictures of a set show the sky [N, H, W], by looks, mounts, and `depth` [N, H, W] in metres."""
    sky = np.zeros(surround.valid.shape, dtype=np.bool_)
    height, width = surround.valid[0].shape
    for camera in np.flatnonzero(surround.present).tolist():
        upward = elevations(surround.intrinsics[camera], surround.base_T_camera[camera], height, width)
        sky[camera] = sky_in_picture(surround.pictures[camera], upward, depth[camera]) & surround.valid[camera]
    return sky


def elevations(
    intrinsics: NDArray[np.float64], base_T_camera: NDArray[np.float64], height: int, width: int
) -> NDArray[np.float32]:
    """Return the sine of the elevation above the horizon [h, w] at which pixels look, of a picture as it is searched.

    That is the picture of `height` x `width`, reduced to about 160 columns.
    """
    step = _step(width)
    u = np.arange(width // step) * step + (step - 1) / 2
    v = np.arange(height // step) * step + (step - 1) / 2
    x, y = (u - intrinsics[0, 2]) / intrinsics[0, 0], ((v - intrinsics[1, 2]) / intrinsics[1, 1])[:, None]
    right, down, ahead = base_T_camera[2, :3]
    sines: NDArray[np.float64] = (right * x + down * y + ahead) / np.sqrt(x**2 + y**2 + 1)
    return sines.astype(np.float32)


def sky_in_picture(
    picture: NDArray[np.uint8], upward: NDArray[np.float32], depth: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Return where an RGB picture [H, W, 3] of that depth [H, W] shows the sky; `upward` are its `elevations`."""
    height, width = upward.shape
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    metres = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
    seed = _smooth_sky(small, upward, metres)
    if not seed.any():
        return np.zeros(picture.shape[:2], dtype=np.bool_)
    near = cv2.dilate(seed.astype(np.uint8), np.ones((2 * _OUTLINE + 1, 2 * _OUTLINE + 1), np.uint8)) > 0
    sky = seed | (near & _is_like(small, seed) & (upward > 0))
    full = cv2.resize(sky.astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(full > 0)


def _step(width: int) -> int:
    return max(width // _WIDTH, 1)


def _smooth_sky(
    small: NDArray[np.float32], upward: NDArray[np.float32], metres: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Return the smooth regions that begin at the upper edge and end above the horizon, and look like a sky."""
    count, regions, boxes, _ = cv2.connectedComponentsWithStats(_smooth(small).astype(np.uint8), connectivity=4)
    below = np.bincount(regions[upward < _BELOW_HORIZON], minlength=count)
    large = boxes[:, cv2.CC_STAT_AREA] >= _LEAST_SHARE * regions.size
    large &= (boxes[:, cv2.CC_STAT_TOP] == 0) & (below <= 0.01 * boxes[:, cv2.CC_STAT_AREA])
    sky = np.zeros(regions.shape, dtype=np.bool_)
    for region in np.flatnonzero(large[1:]) + 1:
        found = regions == region
        is_far = 2 * np.count_nonzero(metres[found] >= _NEAREST) >= np.count_nonzero(found)
        if is_far and _looks_like_sky(small, found, upward):
            sky |= found
    return sky


def _smooth(small: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which pixels [h, w] differ little from those beside and below them, in every colour."""
    rough = np.zeros(small.shape[:2], dtype=np.bool_)
    for colour in cv2.split(small):
        rough[:, 1:] |= np.abs(colour[:, 1:] - colour[:, :-1]) > _SMOOTH
        rough[1:] |= np.abs(colour[1:] - colour[:-1]) > _SMOOTH
    return ~rough


def _looks_like_sky(small: NDArray[np.float32], region: NDArray[np.bool_], upward: NDArray[np.float32]) -> bool:
    red, green, blue = small[region].mean(axis=0).tolist()
    ground = small[upward < 0]
    below = float(ground.mean()) if ground.size else 0.0
    return bool(blue - red > -_WARMEST and (red + green + blue) / 3 >= below)


def _is_like(small: NDArray[np.float32], seed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which pixels [h, w] have the seed's colour."""
    like = np.ones(seed.shape, dtype=np.bool_)
    for colour in cv2.split(small):
        of_sky = colour[seed]
        like &= np.abs(colour - of_sky.mean()) < _LIKE_THE_SKY * max(float(of_sky.std()), _LEAST_DEVIATION)
    return like
