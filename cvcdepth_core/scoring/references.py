# SPDX-License-Identifier: Apache-2.0
"""Reference predictors that look at no picture; any useful network beats them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.rig.pinhole import pixel_rays
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.surround_depth import SurroundPictures

REFERENCE_HEIGHT, REFERENCE_WIDTH = 384, 640
"""Rows and columns of the published DDAD network, so that references are compared at the resolution of networks."""


class ReferenceSize(NamedTuple):
    """Size of the pictures in pixels."""

    height: int
    width: int


class FixedDepth:
    """The same depth for every set: a `DepthPredictor` for one rig."""

    def __init__(self, depth: NDArray[np.float32], fx: NDArray[np.float64], model_id: str) -> None:
        """`depth` [N, H, W] in metres is for cameras with the focal lengths `fx` [N], pixels of H x W."""
        self.spec = ReferenceSize(*depth.shape[1:])
        self.independent = True
        self.model_id = model_id
        self._depth = depth
        self._fx = fx

    @property
    def depth(self) -> NDArray[np.float32]:
        """[N, H, W] metres."""
        return self._depth

    def estimate(self, surround: SurroundPictures) -> NDArray[np.float32]:
        """Return the depth [N, H, W]; ConfigError when the calibration is not the one it was made for."""
        if not np.array_equal(surround.fx, self._fx):
            raise ConfigError(f"{self.model_id}: made for fx {self._fx.tolist()}, asked for fx {surround.fx.tolist()}")
        return np.array(self._depth)


def constant_depth(
    rig: Rig, metres: float = 10.0, height: int = REFERENCE_HEIGHT, width: int = REFERENCE_WIDTH
) -> FixedDepth:
    """Predict the same depth everywhere. Raises ConfigError unless `metres` is positive."""
    if not 0 < metres < math.inf:
        raise ConfigError(f"constant depth is {metres} m, must be positive")
    depth = np.full((len(rig.cameras), height, width), metres, dtype=np.float32)
    return FixedDepth(depth, SurroundPreprocessor(rig, height, width).intrinsics[:, 0, 0], f"constant {metres:g} m")


def best_constant(truth: NDArray[np.float64]) -> float:
    """Return the depth whose mean relative error to `truth` [M] (metres) is least; NaN for no truth.

    sum |c - t| / t is least at the median of t weighted by 1 / t.
    """
    if not truth.size:
        return math.nan
    ascending = np.sort(truth)
    weights = np.cumsum(1.0 / ascending)
    return float(ascending[np.searchsorted(weights, weights[-1] / 2)])


def ground_plane_depth(
    rig: Rig,
    ground_height: float = 0.0,
    far: float = 80.0,
    height: int = REFERENCE_HEIGHT,
    width: int = REFERENCE_WIDTH,
) -> FixedDepth:
    """Predict the depth of flat ground below each pixel, `far` metres above the horizon and where it is farther.

    `ground_height` is the ground's z in the base frame, metres: 0 for a base frame on the ground (`base_footprint`);
    where it is at the axles, like PandaSet's, the true ground is about the wheels' radius below (-0.4).
    Raises ConfigError when the ground is not below every camera, or `far` is not positive.
    """
    if not 0 < far < math.inf:
        raise ConfigError(f"ground plane: far is {far} m, must be positive")
    intrinsics = SurroundPreprocessor(rig, height, width).intrinsics
    depth = np.empty((len(rig.cameras), height, width), dtype=np.float32)
    for camera, K, image in zip(rig.cameras, intrinsics, depth, strict=True):
        drop = camera.base_T_camera[2, 3] - ground_height
        if not drop > 0:
            raise ConfigError(f"ground plane: the ground at z = {ground_height} m is not below camera {camera.name}")
        descent = -(pixel_rays(K, height, width).astype(np.float64) @ camera.base_T_camera[2, :3])
        image[:] = drop / np.maximum(descent, drop / far)
    return FixedDepth(depth, intrinsics[:, 0, 0], f"flat ground at z = {ground_height:g} m, far limit {far:g} m")
