# SPDX-License-Identifier: Apache-2.0
"""Ground truth from LiDAR: sparse depth in a camera's rectified picture, and predictions sampled there.

The field's protocol resizes the prediction bilinearly to the truth's size (method section 9). Truth is sparse, so the
prediction is sampled at the truth's pixels instead: the same numbers for a hundredth of the work.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError
from cvcdepth_core.rig.pinhole import PinholeView, rays_through
from cvcdepth_core.rig.view import PicturePart
from cvcdepth_core.scoring.sparse_depth import OcclusionFilter, SparseDepth

_NEAREST_OVERLAP = 1.0


def sparse_depth(
    points: NDArray[np.floating], view: PinholeView, occlusion: OcclusionFilter | None = None
) -> SparseDepth:
    """Project `points` [M, 3] (metres, base frame at the picture's moment) to depth, the nearest of each pixel.

    Points behind the camera, outside the picture and NaN ones are left out; `occlusion` also drops hidden ones.
    """
    pixels, z = view.project(points)
    u, v = np.floor(pixels + 0.5).T
    inside = (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    flat = v[inside].astype(np.int64) * view.width + u[inside].astype(np.int64)
    nearest_first = np.argsort(z[inside], kind="stable")
    pixel, first = np.unique(flat[nearest_first], return_index=True)
    rows, columns = np.divmod(pixel, view.width)
    truth = SparseDepth(rows, columns, z[inside][nearest_first][first], view.height, view.width)
    return truth if occlusion is None else truth[occlusion.visible(truth, float(view.intrinsics[0, 0]))]


def overlap_pixels(truth: SparseDepth, view: PinholeView, neighbours: Sequence[PinholeView]) -> NDArray[np.bool_]:
    """Return which pixels [M] of `truth` a neighbour sees too: inside its picture, z > 1 m (method section 9)."""
    pixels = np.stack([truth.columns, truth.rows], axis=1)
    in_camera = rays_through(pixels, view.intrinsics) * truth.depth[:, None]
    points = in_camera @ view.base_T_camera[:3, :3].T + view.base_T_camera[:3, 3]
    seen = np.zeros(len(truth), dtype=bool)
    for neighbour in neighbours:
        (u, v), z = (found.T for found in neighbour.project(points))
        inside = (u >= 0) & (u <= neighbour.width - 1) & (v >= 0) & (v <= neighbour.height - 1)
        seen |= inside & (z > _NEAREST_OVERLAP)
    return seen


def sample_prediction(
    prediction: NDArray[np.floating], truth: SparseDepth, part: PicturePart | None = None
) -> NDArray[np.float64]:
    """Return `prediction` [h, w], resized bilinearly to the truth's size, at the truth's pixels [M].

    `part` is what of the truth's picture the prediction shows; all of it, where it is not given. NaN outside of it, and
    where any pixel that it is interpolated from is NaN. Raises ImageError when it is no picture.
    """
    if prediction.ndim != 2 or 0 in prediction.shape:
        raise ImageError(f"prediction: shape is {list(prediction.shape)}, expected [h, w]")
    height, width = prediction.shape
    part = part or PicturePart(0.0, 0.0, truth.width, truth.height)
    rows, columns = truth.rows - part.top, truth.columns - part.left
    top, bottom, down = _interpolation(rows, part.height, height)
    left, right, across = _interpolation(columns, part.width, width)
    upper = _blend(prediction[top, left], prediction[top, right], across)
    lower = _blend(prediction[bottom, left], prediction[bottom, right], across)
    is_shown = _is_between(rows, part.height) & _is_between(columns, part.width)
    return np.where(is_shown, _blend(upper, lower, down), np.nan)


def resized_truth(truth: SparseDepth, height: int, width: int, part: PicturePart | None = None) -> NDArray[np.float32]:
    """Return truth as an image [height, width] of `part` of its picture, metres; inf in the sky, NaN where unknown.

    Each pixel has the truth that is nearest to its centre among all that lies in it: depth is never averaged.
    """
    part = part or PicturePart(0.0, 0.0, truth.width, truth.height)
    rows = np.concatenate([truth.rows, truth.sky[:, 0]])
    columns = np.concatenate([truth.columns, truth.sky[:, 1]])
    depth = np.concatenate([truth.depth, np.full(len(truth.sky), np.inf)])
    v = (rows - part.top + 0.5) * height / part.height - 0.5
    u = (columns - part.left + 0.5) * width / part.width - 0.5
    at_v, at_u = np.floor(v + 0.5).astype(np.int64), np.floor(u + 0.5).astype(np.int64)
    inside = (at_v >= 0) & (at_v < height) & (at_u >= 0) & (at_u < width)
    farthest_first = np.argsort(-np.hypot(v - at_v, u - at_u)[inside], kind="stable")  # the last one stays
    image = np.full((height, width), np.nan, np.float32)
    image[at_v[inside][farthest_first], at_u[inside][farthest_first]] = depth[inside][farthest_first]
    return image


def downsample_ground_truth(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Move the points of a sparse depth image [H, W] (metres, 0 unknown) to the pixels of [height, width].

    The published numbers are computed at network resolution: pixel (u, v) goes to (floor(u width / W), floor(v height /
    H)), and of several points the last in reading order stays.
    """
    rows, columns = np.nonzero(depth)
    smaller = np.zeros((height, width), dtype=depth.dtype)
    smaller[rows * height // depth.shape[0], columns * width // depth.shape[1]] = depth[rows, columns]
    return smaller


def _is_between(positions: NDArray[np.floating], size: float) -> NDArray[np.bool_]:
    return (positions >= -0.5) & (positions <= size - 0.5)


def _interpolation(
    positions: NDArray[np.floating], large: float, small: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return for pixels of an axis of `large` their two neighbours of `small`, and the weight of the second."""
    at = np.clip((positions + 0.5) * small / large - 0.5, 0, small - 1)
    first = np.floor(at).astype(np.int64)
    return first, np.minimum(first + 1, small - 1), at - first


def _blend(
    first: NDArray[np.floating], second: NDArray[np.floating], fraction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate; a value that has no weight does not count, not even NaN."""
    blended: NDArray[np.float64] = np.where(fraction > 0, (1 - fraction) * first + fraction * second, first)
    return blended
