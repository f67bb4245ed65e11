# SPDX-License-Identifier: Apache-2.0
"""Points out of PointCloud2 messages, and LiDAR sweeps where the vehicle was when the anchor camera fired."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.poses import Pose, inverse
from cvcdepth_core.visualization import ColouredPoints, Points
from cvcdepth_ros.bags import Recording
from cvcdepth_ros.messages import stamp_ns
from cvcdepth_ros.transforms import PoseTrack, TransformTree, frame_name

_CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
_NUMPY_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField.msg
_SWEEP_WINDOW_NS = 150_000_000


def cloud_columns(message: Any) -> NDArray[np.void]:
    """Return a PointCloud2's points [M] as a structured array with the cloud's own field names.

    Raises RecordingError for a field type that PointField.msg does not know and for too few bytes.
    """
    if unknown := [field.name for field in message.fields if field.datatype not in _NUMPY_TYPES]:
        raise RecordingError(f"PointCloud2 in {message.header.frame_id}: fields {unknown} have an unknown datatype")
    order = ">" if message.is_bigendian else "<"
    layout = np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": [order + _NUMPY_TYPES[field.datatype] for field in message.fields],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    content = np.frombuffer(message.data, dtype=np.uint8)
    if content.size < message.row_step * message.height or message.row_step < message.point_step * message.width:
        raise RecordingError(
            f"PointCloud2 in {message.header.frame_id}: {content.size} bytes, row_step {message.row_step} do not hold "
            f"{message.height} x {message.width} points of {message.point_step} bytes"
        )
    rows = content[: message.row_step * message.height].reshape(message.height, message.row_step)
    points: NDArray[np.void] = np.ascontiguousarray(rows[:, : message.point_step * message.width]).view(layout).ravel()
    return points


def points_xyz(columns: NDArray[np.void]) -> Points:
    """Return x, y, z [M, 3] in the cloud's frame, metres."""
    return np.stack([columns[axis] for axis in "xyz"], axis=-1).astype(np.float32)


def coloured_points(message: Any) -> ColouredPoints:
    """Return the points and colours of a cloud with a packed `rgb` field (0x00RRGGBB)."""
    columns = cloud_columns(message)
    packed = np.ascontiguousarray(columns["rgb"]).view(np.uint32)
    rgb = np.stack([packed >> shift & 0xFF for shift in (16, 8, 0)], axis=-1).astype(np.uint8)
    return ColouredPoints(points_xyz(columns), rgb)


class LidarSweeps:
    """The LiDAR of a recording, moved to the base frame by the recording's own transforms."""

    def __init__(self, recording: Recording, base_frame: str) -> None:
        self._recording = recording
        self._base_frame = frame_name(base_frame)
        self._topic = next((name for name, topic in recording.topics.items() if topic.type == _CLOUD_TYPE), None)
        self._static = TransformTree()
        for message in self._messages("/tf_static"):
            self._static.add_message(message)
        self._motion = self._read_motion()

    def nearest(self, stamp: int, log_time: int) -> Points | None:
        """Return the points [M, 3] of the sweep nearest to `stamp` (ns), in the base frame at that stamp.

        `log_time` (ns) is about when it was recorded. None where the recording has no sweep within 0.15 s.
        Raises TransformError when a transform on the way is not recorded.
        """
        if self._topic is None:
            return None
        window = (log_time - _SWEEP_WINDOW_NS, log_time + _SWEEP_WINDOW_NS)
        sweeps = [self._recording.deserialize(m) for m in self._recording.messages([self._topic], *window)]
        if not sweeps:
            return None
        sweep = min(sweeps, key=lambda message: abs(stamp_ns(message) - stamp))
        base_T_lidar = self._motion_between(stamp, stamp_ns(sweep)) @ self._static.lookup(
            self._base_frame, sweep.header.frame_id
        )
        xyz = points_xyz(cloud_columns(sweep))
        moved: Points = (xyz @ base_T_lidar[:3, :3].T + base_T_lidar[:3, 3]).astype(np.float32)
        return moved

    def _motion_between(self, target_stamp: int, source_stamp: int) -> Pose:
        """Return target_T_source of the base frame at two stamps; the identity for a recording that does not tell."""
        if self._motion is None:
            return np.eye(4)
        return inverse(self._motion.lookup(target_stamp)) @ self._motion.lookup(source_stamp)

    def _read_motion(self) -> PoseTrack | None:
        """Return the moving link that ends in the base frame, or None."""
        track: PoseTrack | None = None
        for message in self._messages("/tf"):
            for link in message.transforms:
                if track is None and frame_name(link.child_frame_id) == self._base_frame:
                    track = PoseTrack(link.header.frame_id, self._base_frame)
            if track is not None:
                track.add_message(message)
        return track

    def _messages(self, topic: str) -> list[Any]:
        if topic not in self._recording.topics:
            return []
        return [self._recording.deserialize(message) for message in self._recording.messages([topic])]
