# SPDX-License-Identifier: Apache-2.0
"""One surround set as data: the pictures that a depth predictor takes, and the depth that it gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class SurroundPictures:
    """The rectified pictures of one surround set; every array holds all cameras in the rig's order."""

    pictures: NDArray[np.uint8]
    """[N, H, W, 3] RGB; black where the camera is absent."""
    present: NDArray[np.bool_]
    """[N] which cameras have a picture."""
    intrinsics: NDArray[np.float64]
    """[N, 3, 3] in pixels of H x W, pixel centres at the integers."""
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4] camera (optical frame) to vehicle, metres."""
    valid: NDArray[np.bool_]
    """[N, H, W] False outside the raw picture and where the vehicle itself is in view."""

    @property
    def fx(self) -> NDArray[np.float64]:
        """[N] focal lengths along the rows, pixels."""
        return self.intrinsics[:, 0, 0]


@dataclass(frozen=True, eq=False)
class SurroundDepth:
    """What was estimated for one surround set; every array holds the cameras in the rig's order."""

    depth: NDArray[np.float32]
    """[N, H, W] metres along each camera's optical axis, NaN where unknown (REP 118)."""
    pictures: NDArray[np.uint8]
    """[N, H, W, 3] RGB, rectified: pixel by pixel what `depth` describes."""
    intrinsics: NDArray[np.float64]
    """[N, 3, 3] of those pictures, pixel centres at the integers."""
    present: NDArray[np.bool_]
    """[N] which cameras gave a picture; the others' depth is NaN and their picture black."""
    confidence: NDArray[np.float32] | None = None
    """[N, H, W] probability that depth is right within a factor of 1.25, 0 where nothing could be checked; None where
    it was not asked for."""

    def sure_depth(self, camera: int, least: float) -> NDArray[np.float32]:
        """Return a camera's depth [H, W], NaN where its confidence is below `least`; all of it where that is 0."""
        depth: NDArray[np.float32] = self.depth[camera]
        if least <= 0:
            return depth
        sure = np.False_ if self.confidence is None else self.confidence[camera] >= least
        return np.where(sure, depth, np.float32(np.nan)).astype(np.float32)
