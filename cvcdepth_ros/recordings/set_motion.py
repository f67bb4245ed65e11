# SPDX-License-Identifier: Apache-2.0
"""The vehicle's recorded pose at the exposures of surround sets, read a little ahead of them. No ROS here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.messages.vehicle_motion import VehicleMotion
from cvcdepth_ros.recordings.refusals import Refusals
from cvcdepth_ros.recordings.rig import RecordedRig

_LATE_NS = 300_000_000
"""By how much later than a set a pose is recorded that belongs to it, at most."""
_BEFORE_NS = NANOSECONDS  # that is read before the first set


class RecordedSetMotion:
    """Gives poses between those recorded; sets come in order."""

    def __init__(self, recording: Recording, motion: VehicleMotion) -> None:
        """`motion` is still empty."""
        self._recording = recording
        self._motion = motion
        self._messages: Iterator[RecordedMessage] | None = None
        self._next: RecordedMessage | None = None
        self.refused = Refusals()
        """Impossible poses, and sets without one."""

    @classmethod
    def of(cls, recorded: RecordedRig) -> RecordedSetMotion | None:
        """Return the motion of a rig's recording; None where none is recorded."""
        motion = recorded.vehicle_motion()
        return None if motion is None else cls(recorded.recording, motion)

    def read_to(self, log_time: int) -> None:
        """Read what belongs to a set whose last image was recorded then (ns)."""
        if self._messages is None:
            start = max(0, log_time - _BEFORE_NS)
            self._messages = self._recording.messages([self._motion.topic], start)
            self._next = next(self._messages, None)
        while self._next is not None and self._next.log_time <= log_time + _LATE_NS:
            with self.refused.instead_of_errors():
                self._motion.add(self._recording.deserialize(self._next))
            self._next = next(self._messages, None)

    def poses_at(self, times_ns: Mapping[str, int]) -> dict[str, Pose] | None:
        """Return world_T_base [4, 4] at each exposure (ns); None where not all of them are known."""
        try:
            poses = {name: self._motion.base_pose(time) for name, time in times_ns.items()}
        except TransformError as error:
            self.refused.add(str(error))
            return None
        self._motion.forget_before(min(times_ns.values()) - _BEFORE_NS)
        return poses
