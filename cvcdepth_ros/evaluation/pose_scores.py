# SPDX-License-Identifier: Apache-2.0
"""The answers of a checkpoint's pose network from set to set, beside the recorded motion."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cvcdepth_core.errors import CheckpointError
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.training.pose_network import MotionError, PoseAnswers, PoseScore, motion_error, pose_score_to_json

if TYPE_CHECKING:
    from cvcdepth_ros.evaluation.measuring import MeasuredSet

_LONGEST_STEP_NS = NANOSECONDS // 2  # as far as training looks by default


class PoseScoring:
    """Compares the motion between a recording's sets, which come in order."""

    def __init__(self, checkpoint: Path | None) -> None:
        """Load the pose network; without a checkpoint, or with one that has none, there is nothing to compare."""
        self.problem = ""
        """Why the pose network cannot be asked; empty where it can, or where there is none."""
        self._network: PoseAnswers | None = None
        self._earlier: MeasuredSet | None = None
        self._errors: list[MotionError] = []
        if checkpoint is not None:
            try:
                self._network = PoseAnswers.from_checkpoint(load_checkpoint(checkpoint))
            except CheckpointError as error:
                self.problem = str(error)

    def add(self, measured: MeasuredSet) -> None:
        """Compare the motion since an earlier set, where the vehicle has moved by a tenth of a metre or more."""
        if self._network is None or measured.world_T_base is None or not measured.estimated.result.present.all():
            return
        earlier = self._earlier
        if earlier is not None and measured.stamp_ns - earlier.stamp_ns <= _LONGEST_STEP_NS:
            error = self._error(self._network, earlier, measured)
            if error is None:
                return
            self._errors.append(error)
        self._earlier = measured

    def result(self) -> dict[str, float | None]:
        """Return the score for JSON."""
        return pose_score_to_json(PoseScore.of(self._errors))

    def _error(self, network: PoseAnswers, earlier: MeasuredSet, later: MeasuredSet) -> MotionError | None:
        rig = later.estimated.rig
        anchor = rig.names.index(rig.anchor)
        base_T_camera = np.stack([camera.base_T_camera for camera in rig.cameras])
        if earlier.world_T_base is None or later.world_T_base is None:
            return None
        before, after = (poses[anchor] @ base_T_camera[anchor] for poses in (earlier.world_T_base, later.world_T_base))
        pictures = [one.estimated.result.pictures for one in (earlier, later)]
        intrinsics = later.estimated.result.intrinsics
        answer = network.later_T_earlier(pictures[0], pictures[1], rig.poses_above_ground, anchor, intrinsics)
        return motion_error(answer, inverse(after) @ before)


def joined_pose_score(summaries: Iterable[Mapping[str, Any]]) -> PoseScore | None:
    """Return the score of several recordings, from what their summaries say."""
    found = [summary["pose_network"] for summary in summaries if summary["pose_network"]["steps"]]
    return PoseScore.joined([PoseScore(**{name: one[name] for name in PoseScore._fields}) for one in found])
