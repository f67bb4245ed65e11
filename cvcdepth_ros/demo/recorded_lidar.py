# SPDX-License-Identifier: Apache-2.0
"""The LiDAR of a recording, at the moments of its surround sets."""

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.visualization import Points
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.recordings.lidar import LidarSweeps, VehicleMotion, find_lidars
from cvcdepth_ros.recordings.rig import assemble_rig

_AHEAD_NS = 300_000_000  # a sweep is recorded after its stamp, and may be later than the set


class RecordedLidar:
    """Reads a recording's sweeps and motion once, from its beginning to the last set that is asked for."""

    def __init__(self, recording: Recording, layout: RigLayout) -> None:
        self._recording = recording
        static = assemble_rig(recording, layout).transforms
        self._motion = VehicleMotion.find(recording, layout.base_frame, static)
        topics, _ = find_lidars(recording)
        self._sweeps = LidarSweeps(topics, layout.base_frame, static, self._motion)
        self._messages = recording.messages([*topics, *([self._motion.topic] if self._motion else [])])

    def at(self, stamp: int, log_time: int) -> Points | None:
        """Return the points [M, 3] nearest to `stamp` (ns), moved to then, in the base frame; None where none is near.

        Ask for later and later stamps; `log_time` (ns) says when the set was recorded. Raises TransformError when the
        recording does not tell how to move any of them.
        """
        refusal = None
        for message in self._messages:
            try:
                self._add(message)
            except TransformError as error:
                refusal = error
            if message.log_time >= log_time + _AHEAD_NS:
                break
        swept = self._sweeps.at(stamp)
        self._sweeps.forget_before(stamp)
        if swept is None and refusal is not None:
            raise refusal
        return None if swept is None else swept.points

    def _add(self, message: RecordedMessage) -> None:
        content = self._recording.deserialize(message)
        if self._motion is not None and message.topic == self._motion.topic:
            self._motion.add(content)
        else:
            self._sweeps.add(message.topic, content)
