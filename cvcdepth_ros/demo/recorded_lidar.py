# SPDX-License-Identifier: Apache-2.0
"""The LiDAR of a recording, at the moments of its surround sets."""

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.visualization import Points
from cvcdepth_ros.bags import Recording
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.truth import RecordedTruth


class RecordedLidar:
    """Reads a recording's sweeps and motion once, from its beginning to the last set that is asked for."""

    def __init__(self, recording: Recording, layout: RigLayout) -> None:
        self._truth = RecordedTruth(RecordedRig.from_recording(recording, layout))
        self._read_to = recording.start

    def at(self, stamp: int, log_time: int) -> Points | None:
        """Return the points [M, 3] nearest to `stamp` (ns), moved to then, in the base frame; None where none is near.

        Ask for later and later stamps; `log_time` (ns) says when the set was recorded. Raises TransformError when the
        recording does not tell how to move any of them.
        """
        refused_before, stop = self._truth.refused.count, log_time + self._truth.ahead_ns
        self._truth.read(self._read_to, stop)
        self._read_to = stop
        points = self._truth.points(stamp)
        self._truth.forget_before(stamp)
        if points is None and self._truth.refused.count > refused_before:
            raise TransformError(self._truth.refused.reasons[-1])
        return points
