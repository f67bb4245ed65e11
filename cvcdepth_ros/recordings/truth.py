# SPDX-License-Identifier: Apache-2.0
"""The LiDAR sweeps and the vehicle's motion of a recording, read along with its surround sets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cvcdepth_core.errors import CvcDepthError, RecordingError, TransformError
from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.scoring.ground_truth import OcclusionFilter, PinholeView, SparseDepth, sparse_depth
from cvcdepth_core.visualization import Points
from cvcdepth_ros.bags import RecordedMessage
from cvcdepth_ros.recordings.lidar import CLOUD_TYPE, LidarSweeps, VehicleMotion, cloud_topics, find_lidars
from cvcdepth_ros.recordings.replay import Refusals, SurroundReplay
from cvcdepth_ros.surround_sets.synchronizer import NANOSECONDS

_LATE_NS = 300_000_000
"""By how much later than its stamp a sweep or a pose is recorded, at most."""


class RecordedTruth:
    """What a recording knows of depth beside its pictures.

    Hand `handlers` to the replay. A set's truth is complete once messages up to `ahead_ns` after it were read.
    """

    def __init__(self, replay: SurroundReplay, lidar: Sequence[str] | None, tolerance: float) -> None:
        """`lidar` names the topics (None: see `find_lidars`), `tolerance` is in seconds; see `LidarSweeps`.

        Raises RecordingError for a topic that is not there or carries no point clouds.
        """
        self._recording, base_frame = replay.recording, replay.layout.base_frame
        self.topics, self.left_out = (
            find_lidars(self._recording) if lidar is None else (tuple(map(self._checked, lidar)), {})
        )
        """The LiDARs' topics, and why those of other clouds are no LiDARs'."""
        self.motion = VehicleMotion.find(self._recording, base_frame, replay.transforms)
        self.refused = Refusals()
        """Sweeps and moments that are no use, and why."""
        self._sweeps = LidarSweeps(self.topics, base_frame, replay.transforms, self.motion, tolerance)
        self._tolerance_ns = round(tolerance * NANOSECONDS)
        self.ahead_ns = self._tolerance_ns + _LATE_NS
        self.handlers: Mapping[str, Callable[[RecordedMessage], None]] = {
            **dict.fromkeys(self.topics, self._add_sweep),
            **({self.motion.topic: self._add_motion} if self.motion else {}),
        }

    def read(self, start: int, stop: int) -> None:
        """Take in the messages with start <= log_time < stop (ns), without those of the cameras."""
        for message in self._recording.messages(self.handlers, start, stop):
            self.handlers[message.topic](message)

    def points(self, time: int) -> Points | None:
        """Return what the LiDARs saw nearest to a moment (ns), [M, 3] metres in the base frame then; None: nothing."""
        try:
            swept = self._sweeps.at(time) if self.topics else None
        except TransformError as error:
            self.refused.add(str(error))
            return None
        return None if swept is None else swept.points

    def camera_depth(self, rig: Rig, times: Mapping[str, int], occlusion: OcclusionFilter | None) -> list[SparseDepth]:
        """Return each camera's true depth at the moment of its picture (ns), at full size; empty where unknown."""
        truth = []
        for camera in rig.cameras:
            points = self.points(times[camera.name])
            found = np.empty((0, 3)) if points is None else points
            truth.append(sparse_depth(found, PinholeView.of(camera), occlusion))
        return truth

    def base_poses(self, rig: Rig, times: Mapping[str, int]) -> list[Pose] | None:
        """Return world_T_base [4, 4] at each camera's moment (ns); None where the motion is not known."""
        if self.motion is None:
            return None
        try:
            return [self.motion.base_pose(times[name]) for name in rig.names]
        except TransformError as error:
            self.refused.add(str(error))
            return None

    def forget_before(self, stamp: int) -> None:
        """Drop what no stamp (ns) at or after this one needs."""
        self._sweeps.forget_before(stamp)
        if self.motion is not None:
            self.motion.forget_before(stamp - self._tolerance_ns)

    def _checked(self, topic: str) -> str:
        found = self._recording.topics.get(topic)
        if found is None or found.type != CLOUD_TYPE:
            there = ", ".join(cloud_topics(self._recording)) or "none"
            what = "no such topic" if found is None else f"carries {found.type}"
            raise RecordingError(f"{self._recording.path}: LiDAR {topic}: {what}; topics of {CLOUD_TYPE}: {there}")
        return topic

    def _add_sweep(self, message: RecordedMessage) -> None:
        try:
            self._sweeps.add(message.topic, self._recording.deserialize(message))
        except CvcDepthError as error:
            self.refused.add(str(error))

    def _add_motion(self, message: RecordedMessage) -> None:
        try:
            if self.motion is not None:
                self.motion.add(self._recording.deserialize(message))
        except CvcDepthError as error:
            self.refused.add(str(error))
