# SPDX-License-Identifier: Apache-2.0
"""The LiDAR sweeps and the vehicle's motion of a recording, read along with its surround sets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cvcdepth_core.errors import RecordingError, TransformError
from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.scoring.ground_truth import sparse_depth
from cvcdepth_core.scoring.sparse_depth import OcclusionFilter, SparseDepth
from cvcdepth_core.stamps import to_nanoseconds
from cvcdepth_core.visualization import Points
from cvcdepth_ros.bags import RecordedMessage
from cvcdepth_ros.messages.point_clouds import POINT_CLOUD_TYPE
from cvcdepth_ros.recordings.lidar import LidarSweeps
from cvcdepth_ros.recordings.refusals import Refusals
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.rig_messages import cloud_topics
from cvcdepth_ros.settings import LIDAR_TOLERANCE

_LATE_NS = 300_000_000
"""By how much later than its stamp a sweep or a pose is recorded, at most."""


class RecordedMotion:
    """A recording's motion, as ground truth of any kind needs it."""

    def __init__(self, recorded: RecordedRig, tolerance: float = LIDAR_TOLERANCE) -> None:
        self._recording = recorded.recording
        self.topics: tuple[str, ...] = ()
        """The topics that the truth is on."""
        self.left_out: Mapping[str, str] = {}
        """By topic, why other clouds are no LiDAR's."""
        self.motion = recorded.vehicle_motion()
        self.refused = Refusals()
        """Sweeps, poses and moments that cannot be used, and why."""
        self._tolerance_ns = to_nanoseconds(tolerance)
        self.ahead_ns = 0
        self.handlers: Mapping[str, Callable[[RecordedMessage], None]] = (
            {self.motion.topic: self._add_motion} if self.motion else {}
        )

    def read(self, start: int, stop: int) -> None:
        """Add the sweeps and poses of the messages with start <= log_time < stop (ns)."""
        for message in self._recording.messages(self.handlers, start, stop):
            self.handlers[message.topic](message)

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
        if self.motion is not None:
            self.motion.forget_before(stamp - self._tolerance_ns)

    def _add_motion(self, message: RecordedMessage) -> None:
        with self.refused.instead_of_errors():
            if self.motion is not None:
                self.motion.add(self._recording.deserialize(message))


class RecordedTruth(RecordedMotion):
    """Ground truth for depth from a recording's LiDARs, and the poses from its motion.

    Hand `handlers` to the replay. A set's truth is complete once messages up to `ahead_ns` after it were read.
    """

    def __init__(
        self, recorded: RecordedRig, lidar: Sequence[str] | None = None, tolerance: float = LIDAR_TOLERANCE
    ) -> None:
        """`lidar` names the topics (None: `RecordedRig.lidars`), `tolerance` is in seconds; see `LidarSweeps`.

        Raises RecordingError for a topic that is not there or carries no point clouds.
        """
        super().__init__(recorded, tolerance)
        self.topics = recorded.lidars if lidar is None else tuple(map(self._checked, lidar))
        self.left_out = recorded.other_clouds if lidar is None else {}
        self._sweeps = LidarSweeps(self.topics, recorded.layout.base_frame, recorded.transforms, self.motion, tolerance)
        self.ahead_ns = self._tolerance_ns + _LATE_NS
        self.handlers = {**dict.fromkeys(self.topics, self._add_sweep), **self.handlers}

    def points(self, time: int) -> Points | None:
        """Return the LiDARs' points nearest to a moment (ns), [M, 3] metres in the base frame then, or None."""
        try:
            return self._sweeps.points_at(time)
        except TransformError as error:
            self.refused.add(str(error))
            return None

    def camera_depth(self, rig: Rig, times: Mapping[str, int], occlusion: OcclusionFilter | None) -> list[SparseDepth]:
        """Return each camera's true depth at the moment of its picture (ns), at full size; empty where unknown."""
        truth = []
        for camera in rig.cameras:
            points = self.points(times[camera.name])
            found = np.empty((0, 3)) if points is None else points
            truth.append(sparse_depth(found, camera.rectified_view, occlusion))
        return truth

    def forget_before(self, stamp: int) -> None:
        """Drop what no stamp (ns) at or after this one needs."""
        super().forget_before(stamp)
        self._sweeps.forget_before(stamp)

    def _checked(self, topic: str) -> str:
        found = self._recording.topics.get(topic)
        if found is None or found.type != POINT_CLOUD_TYPE:
            there = ", ".join(cloud_topics(self._recording)) or "none"
            what = "no such topic" if found is None else f"carries {found.type}"
            raise RecordingError(
                f"{self._recording.path}: LiDAR {topic}: {what}; topics of {POINT_CLOUD_TYPE}: {there}"
            )
        return topic

    def _add_sweep(self, message: RecordedMessage) -> None:
        with self.refused.instead_of_errors():
            self._sweeps.add(message.topic, self._recording.deserialize(message))
