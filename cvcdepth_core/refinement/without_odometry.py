# SPDX-License-Identifier: Apache-2.0
"""Refinement on a vehicle that tells nothing of its motion: alignment and refinement take turns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cvcdepth_core.refinement.alignment import AlignedMotion, Twist
from cvcdepth_core.refinement.moments import SurroundMoment
from cvcdepth_core.refinement.refiner import RefinedDepth, SurroundRefiner
from cvcdepth_core.refinement.visual_odometry import VisualOdometry

_TRUSTED = 0.65  # confidence of depth that the next set is aligned to


class RefinerWithoutOdometry:
    """Aligns each set to the one before, refines it by that motion, and keeps what is sure for the next alignment.

    The first set, and sets that cannot be aligned, are refined by the cameras' neighbours alone.
    """

    def __init__(self, refiner: SurroundRefiner, odometry: VisualOdometry) -> None:
        self._refiner = refiner
        self._odometry = odometry
        self.motion: AlignedMotion | None = None
        """Of the last set since the one before; None where there was none."""

    def reset(self) -> None:
        """Forget all earlier sets: after a jump in time, or when the rig has changed."""
        self._refiner.reset()
        self._odometry.reset()
        self.motion = None

    def refine(self, moment: SurroundMoment, guess: Twist | None = None) -> RefinedDepth:
        """Refine the next set; its own `world_T_base` is not looked at. `guess` is as for `VisualOdometry.track`."""
        self.motion = self._odometry.track(moment, guess)
        refined = self._refiner.refine(replace(moment, world_T_base=self._odometry.base_poses()))
        sure = refined.confidence > _TRUSTED
        self._odometry.keep(np.where(sure, refined.depth, np.float32(np.nan)) if sure.any() else moment.depth)
        return refined
