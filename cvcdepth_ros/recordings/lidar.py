# SPDX-License-Identifier: Apache-2.0
"""LiDAR sweeps, moved to where the vehicle was at the exposure of a camera. No ROS here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError, TransformError
from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.stamps import to_nanoseconds
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.point_clouds import points_from_message
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.recordings.motion import VehicleMotion


class LidarSweep(NamedTuple):
    """One message of one LiDAR."""

    stamp: int
    """ns."""
    base_T_lidar: Pose
    points: NDArray[np.float64]
    """[M, 3] metres in the LiDAR's frame."""


def read_sweep(topic: str, message: Any, base_frame: str, static: TransformTree) -> LidarSweep:
    """Return the sweep of a LiDAR's message; raises as `LidarSweeps.add`."""
    points = points_from_message(message, topic)
    try:
        base_T_lidar = static.lookup(base_frame, message.header.frame_id)
    except TransformError as error:
        raise TransformError(f"{topic}: {error}") from error
    return LidarSweep(stamp_ns(message), base_T_lidar, points)


class LidarSweeps:
    """The recent sweeps of one or several LiDARs, brought to the base frame at any moment."""

    def __init__(
        self,
        topics: Sequence[str],
        base_frame: str,
        static: TransformTree,
        motion: VehicleMotion | None,
        tolerance: float,
    ) -> None:
        """`motion` is None where the recording has none: then the vehicle is taken to stand still.

        `tolerance`, seconds, is the greatest distance in time between a sweep and the moment it is used for.
        """
        if tolerance < 0:
            raise ConfigError(f"LiDAR tolerance is {tolerance} s, must not be negative")
        self._sweeps: dict[str, list[LidarSweep]] = {topic: [] for topic in topics}
        self._base_frame = base_frame
        self._static = static
        self._motion = motion
        self._tolerance = to_nanoseconds(tolerance)

    def add(self, topic: str, message: Any) -> None:
        """Add a sweep.

        Raises RecordingError, naming the topic and the field, when it cannot be read, and TransformError, naming the
        topic and the frame, when that has no transform to the base frame.
        """
        self._sweeps[topic].append(read_sweep(topic, message, self._base_frame, self._static))

    def points_at(self, stamp: int) -> NDArray[np.float64] | None:
        """Return each LiDAR's sweep nearest to `stamp` (ns), moved to then; None without any within the tolerance.

        The points [M, 3] of all of them are in metres in the base frame at that moment. Add messages up to `stamp` plus
        the tolerance before. Raises TransformError when the vehicle's motion is not known at both moments.
        """
        nearest = [self._nearest(topic, stamp) for topic in self._sweeps]
        moved = [self._moved(sweep, stamp) for sweep in nearest if sweep is not None]
        return np.concatenate(moved) if moved else None

    def forget_before(self, stamp: int) -> None:
        """Drop the sweeps that no stamp (ns) at or after this one can use."""
        for topic, sweeps in self._sweeps.items():
            self._sweeps[topic] = [sweep for sweep in sweeps if sweep.stamp >= stamp - self._tolerance]

    def _nearest(self, topic: str, stamp: int) -> LidarSweep | None:
        near = [sweep for sweep in self._sweeps[topic] if abs(sweep.stamp - stamp) <= self._tolerance]
        return min(near, key=lambda sweep: abs(sweep.stamp - stamp), default=None)

    def _moved(self, sweep: LidarSweep, stamp: int) -> NDArray[np.float64]:
        base_T_lidar = sweep.base_T_lidar
        if self._motion is not None:
            pose = self._motion.base_pose
            base_T_lidar = inverse(pose(stamp)) @ pose(sweep.stamp) @ base_T_lidar
        moved: NDArray[np.float64] = sweep.points @ base_T_lidar[:3, :3].T + base_T_lidar[:3, 3]
        return moved
