# SPDX-License-Identifier: Apache-2.0
"""One surround set as data: the pictures that a depth predictor takes, and the depth that it gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

SkyChoice = Literal["far", "nan", "keep"]
"""What depth images say of the sky: beyond measure (inf), nothing (NaN), or what the network said."""


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

    sky: NDArray[np.bool_] | None = None
    """[N, H, W] where there is nothing to measure; `depth` there means nothing. None where nobody looked for it."""

    def sure_depth(self, camera: int, least: float) -> NDArray[np.float32]:
        """Return a camera's depth [H, W], NaN in the sky and where its confidence is below `least`."""
        return self._without(self.depth[camera], self._unsure(camera, least), self._sky(camera))

    def shown_depth(self, camera: int, sky: SkyChoice, least: float = 0.0) -> NDArray[np.float32]:
        """Return a camera's depth [H, W] as images show it (REP 118): NaN where its confidence is below `least`.

        In the sky, whatever the confidence, it is what `sky` says.
        """
        shown = self._without(self.depth[camera], self._unsure(camera, least))
        there = self._sky(camera)
        if there is None or sky == "keep":
            return shown
        return np.where(there & ~np.isnan(self.depth[camera]), np.float32(np.inf if sky == "far" else np.nan), shown)

    def _unsure(self, camera: int, least: float) -> NDArray[np.bool_] | None:
        if least <= 0:
            return None
        if self.confidence is None:
            return np.ones(self.depth.shape[1:], dtype=np.bool_)
        return np.asarray(self.confidence[camera] < least)

    def _sky(self, camera: int) -> NDArray[np.bool_] | None:
        return None if self.sky is None else self.sky[camera]

    @staticmethod
    def _without(depth: NDArray[np.float32], *masks: NDArray[np.bool_] | None) -> NDArray[np.float32]:
        for mask in masks:
            if mask is not None:
                depth = np.where(mask, np.float32(np.nan), depth)
        return depth
