# SPDX-License-Identifier: Apache-2.0
"""The node's log of what is wrong: said once it lasts, with the remedy, again later, and its end. No ROS here."""

from collections.abc import Mapping
from typing import Any

from cvcdepth_ros.live.camera_states import CameraCondition, CameraState
from cvcdepth_ros.live.standing_problems import REPEAT_SECONDS, Problem, StandingProblems

_HEALTHY = CameraCondition(CameraState.OK)
_WAITING = {CameraState.WAITING_FOR_IMAGES, CameraState.WAITING_FOR_CAMERA_INFO, CameraState.WAITING_FOR_TRANSFORM}
_REMEDIES = {
    CameraState.FROZEN: "restart its driver, or take it as it is with frozen_after:=0.0",
    CameraState.STALE: "look at its driver; min_cameras lets the other cameras go on",
    CameraState.WAITING_FOR_IMAGES: "is its driver running, and is the topic's name right?",
    CameraState.WAITING_FOR_CAMERA_INFO: "publish it, or write the calibration into the rig file",
    CameraState.WAITING_FOR_TRANSFORM: "publish it on /tf_static, or write base_T_camera into the rig file",
}


class ProblemLog:
    """Says in the log what `/diagnostics` knows."""

    def __init__(self, logger: Any) -> None:
        """Write with an rclpy logger."""
        self._logger = logger
        self.forget()

    def forget(self) -> None:
        """Begin anew: what comes next may be other cameras, and what was wrong is neither there nor mended."""
        self._standing = StandingProblems()
        self._reported: dict[str, CameraCondition] = {}
        self._were_healthy: set[str] = set()

    def tell(self, problems: Mapping[str, str], conditions: Mapping[str, CameraCondition], is_matching: bool) -> None:
        """Log what is due of the problems, by subject, and of the cameras' conditions.

        While no set is matched at all, that is a problem of its own, which names the cameras to blame.
        """
        if not is_matching:
            conditions = {n: _HEALTHY if c.state == CameraState.UNMATCHED else c for n, c in conditions.items()}
        for camera, condition in conditions.items():
            self._tell_change(camera, condition)
        self._reported = dict(conditions)
        found = {subject: Problem(text) for subject, text in problems.items() if text}
        found |= {f"camera {n}": self._lasting(n, c) for n, c in conditions.items() if c != _HEALTHY}
        for notice in self._standing.update(found):
            if notice.is_over:  # rclpy wants every line of code to log with one severity
                self._logger.info(notice.text)
            else:
                self._logger.warning(notice.text)

    def _tell_change(self, camera: str, condition: CameraCondition) -> None:
        """Log what is wrong with a camera when it begins, and its end; a camera that never was well may be starting."""
        former = self._reported.get(camera)
        if condition == former or self._may_be_starting(camera, condition):
            return
        if condition == _HEALTHY:
            if former is not None or camera not in self._were_healthy:
                self._logger.info(f"camera {camera}: ok")
            self._were_healthy.add(camera)
        elif former is None or condition.state != former.state:
            self._logger.warning(f"camera {camera}: {condition.text}")
        else:  # the reason may be another with every image
            self._logger.warning(f"camera {camera}: {condition.text}", throttle_duration_sec=5.0)

    def _may_be_starting(self, camera: str, condition: CameraCondition) -> bool:
        return condition.state in _WAITING and camera not in self._were_healthy

    def _lasting(self, camera: str, condition: CameraCondition) -> Problem:
        """Return a camera's problem; where `_tell_change` has told it, it is told here when it lasts very long."""
        remedy = _REMEDIES.get(condition.state, "")
        text = "; ".join(filter(None, (condition.text, remedy)))
        if self._may_be_starting(camera, condition):
            return Problem(text, is_end_told=False)
        return Problem(text, patience=REPEAT_SECONDS, is_end_told=False)
