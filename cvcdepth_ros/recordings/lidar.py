# SPDX-License-Identifier: Apache-2.0
"""LiDAR sweeps out of PointCloud2 messages, moved to where the vehicle was when a camera fired. No ROS here."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError, RecordingError, TransformError
from cvcdepth_core.rig.poses import Pose, inverse, pose_from_quaternion
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.messages.cloud_sources import why_no_lidar
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.transform_topics import moving_transform_topics
from cvcdepth_ros.messages.transforms import PoseTrack, TransformTree, frame_name
from cvcdepth_ros.surround_sets.synchronizer import NANOSECONDS

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"

_FLOAT_TYPES = {7: "f4", 8: "f8"}  # sensor_msgs/PointField.FLOAT32 and FLOAT64
_MESSAGES_TO_FIND_MOTION = 1000


def points_from_message(message: Any, topic: str) -> NDArray[np.float64]:
    """Return the points [M, 3] of a PointCloud2, metres in its frame; those without a return (NaN, inf, 0) left out.

    Any layout is read: float32 or float64, any offsets, organised or not, padded rows, either byte order.
    Raises RecordingError, naming topic and field, when x, y or z is missing, no float, or outside of the bytes.
    """
    content = np.frombuffer(message.data, dtype=np.uint8)
    _check_size(message, content.size, topic)
    xyz = np.stack([_column(message, content, axis, topic) for axis in "xyz"], axis=-1)
    returned = np.isfinite(xyz).all(axis=1) & xyz.any(axis=1)
    points: NDArray[np.float64] = xyz[returned]
    return points


def cloud_topics(recording: Recording) -> list[str]:
    """Return the names of all topics with point clouds, sorted."""
    return sorted(topic.name for topic in recording.topics.values() if topic.type == CLOUD_TYPE and topic.count)


def find_lidars(recording: Recording) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the topics of the LiDARs, and for those of other clouds why they are no LiDAR's, see `why_no_lidar`.

    The node's own are among these: they are no truth, where a recording was made while it ran.
    """
    clouds = cloud_topics(recording)
    reasons = {topic: reason for topic in clouds if (reason := _why_no_lidar(recording, topic)) is not None}
    return tuple(topic for topic in clouds if topic not in reasons), reasons


class VehicleMotion:
    """Where the vehicle was over time: a moving link of `/tf`, or an odometry topic."""

    def __init__(self, topic: str, track: PoseTrack, child_T_base: Pose) -> None:
        """`track` ends in a frame of the vehicle, in which `child_T_base` [4, 4] is the base frame's pose."""
        self.topic = topic
        self._track = track
        self._child_T_base = child_T_base

    @classmethod
    def find(cls, recording: Recording, base_frame: str, static: TransformTree) -> VehicleMotion | None:
        """Look for the vehicle's motion, which is still to be added message by message; None where none is recorded.

        The link of `/tf` that leads from elsewhere to the base frame, or to a frame fixed to it, comes before odometry
        topics.
        """
        odometry = sorted(topic.name for topic in recording.topics.values() if topic.type == ODOMETRY_TYPE)
        for topic in (*moving_transform_topics(recording), *odometry):
            for message in islice(recording.messages([topic]), _MESSAGES_TO_FIND_MOTION):
                for parent, child in _moving_links(recording, message):
                    child_T_base = _fixed_pose(static, child, base_frame)
                    # Where sensors' fixed links are on /tf too, both of their ends ride along with the base.
                    if child_T_base is not None and _fixed_pose(static, parent, base_frame) is None:
                        return cls(topic, PoseTrack(parent, child), child_T_base)
        return None

    def add(self, message: Any) -> None:
        """Add a `tf2_msgs/TFMessage` or `nav_msgs/Odometry`; TransformError names the topic of an impossible pose."""
        if hasattr(message, "transforms"):
            try:
                self._track.add_message(message)
            except TransformError as error:
                raise TransformError(f"{self.topic}: {error}") from error
            return
        p, q = message.pose.pose.position, message.pose.pose.orientation
        pose = pose_from_quaternion((p.x, p.y, p.z), (q.x, q.y, q.z, q.w), self.topic)
        self._track.add(stamp_ns(message), pose)

    def base_pose(self, stamp: int) -> Pose:
        """Return world_T_base [4, 4], the world being the frame that the motion is told in, at a stamp (ns).

        Raises TransformError outside of the time for which messages were added: nothing is extrapolated.
        """
        return self._track.lookup(stamp) @ self._child_T_base

    def forget_before(self, stamp: int) -> None:
        """Drop what no stamp (ns) at or after this one needs, so that memory does not grow with the recording."""
        self._track.forget_before(stamp)


class LidarSweep(NamedTuple):
    """One message of one LiDAR."""

    stamp: int
    """ns."""
    base_T_lidar: Pose
    points: NDArray[np.float64]
    """[M, 3] metres in the LiDAR's frame."""


@dataclass(frozen=True, eq=False)
class SweptPoints:
    """What the LiDARs saw around one moment."""

    points: NDArray[np.float64]
    """[M, 3] metres in the base frame at that moment."""
    seconds_later: dict[str, float]
    """By how much each LiDAR's sweep is later than the moment; LiDARs without a sweep near it are absent."""


class LidarSweeps:
    """The recent sweeps of one or several LiDARs, brought to the base frame at any moment."""

    def __init__(
        self,
        topics: Sequence[str],
        base_frame: str,
        static: TransformTree,
        motion: VehicleMotion | None,
        tolerance: float = 0.1,
    ) -> None:
        """`motion` is None where the recording has none: then the vehicle counts as standing still.

        `tolerance`, seconds, is the greatest distance in time between a sweep and the moment it is used for.
        """
        if tolerance < 0:
            raise ConfigError(f"LiDAR tolerance is {tolerance} s, must not be negative")
        self._sweeps: dict[str, list[LidarSweep]] = {topic: [] for topic in topics}
        self._base_frame = base_frame
        self._static = static
        self._motion = motion
        self._tolerance = round(tolerance * NANOSECONDS)

    def add(self, topic: str, message: Any) -> None:
        """Take in a sweep.

        Raises RecordingError, naming the topic and the field, when it cannot be read, and TransformError, naming the
        topic and the frame, when that has no transform to the base frame.
        """
        points = points_from_message(message, topic)
        try:
            base_T_lidar = self._static.lookup(self._base_frame, message.header.frame_id)
        except TransformError as error:
            raise TransformError(f"{topic}: {error}") from error
        self._sweeps[topic].append(LidarSweep(stamp_ns(message), base_T_lidar, points))

    def at(self, stamp: int) -> SweptPoints | None:
        """Return each LiDAR's sweep nearest to `stamp` (ns), moved to then; None without any within the tolerance.

        Add messages up to `stamp` plus the tolerance before. Raises TransformError when the vehicle's motion is not
        known at both moments.
        """
        nearest = {topic: self._nearest(topic, stamp) for topic in self._sweeps}
        found = {topic: sweep for topic, sweep in nearest.items() if sweep is not None}
        if not found:
            return None
        points = np.concatenate([self._moved(sweep, stamp) for sweep in found.values()])
        return SweptPoints(points, {topic: (s.stamp - stamp) / NANOSECONDS for topic, s in found.items()})

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


def _check_size(message: Any, size: int, topic: str) -> None:
    """Raise unless the rows fit the bytes; a single row needs no row_step, which some drivers leave at 0."""
    row_bytes = message.width * message.point_step
    if message.height > 1 and message.row_step < row_bytes:
        raise RecordingError(
            f"{topic}: row_step is {message.row_step} bytes, but {message.width} points of {message.point_step} need "
            f"{row_bytes}"
        )
    needed = (message.height - 1) * message.row_step + row_bytes if message.height else 0
    if size < needed:
        raise RecordingError(
            f"{topic}: data has {size} bytes, but {message.height} x {message.width} points of {message.point_step} "
            f"bytes with a row_step of {message.row_step} need {needed}"
        )


def _column(message: Any, content: NDArray[np.uint8], name: str, topic: str) -> NDArray[np.float64]:
    """Return one field of all points [M]."""
    field = next((field for field in message.fields if field.name == name), None)
    if field is None:
        raise RecordingError(
            f"{topic}: no field {name}; there are {', '.join(f.name for f in message.fields) or 'none'}"
        )
    if field.datatype not in _FLOAT_TYPES:
        raise RecordingError(f"{topic}: field {name} has datatype {field.datatype}, want 7 (FLOAT32) or 8 (FLOAT64)")
    dtype = np.dtype((">" if message.is_bigendian else "<") + _FLOAT_TYPES[field.datatype])
    if field.offset + dtype.itemsize > message.point_step:
        raise RecordingError(
            f"{topic}: field {name} at offset {field.offset} of {dtype.itemsize} bytes is outside of the point_step of "
            f"{message.point_step}"
        )
    shape, strides = (message.height, message.width), (message.row_step, message.point_step)
    if 0 in shape:
        return np.empty(0)
    column: NDArray[np.generic] = np.ndarray(shape, dtype, content, field.offset, strides)
    return column.ravel().astype(np.float64)


def _why_no_lidar(recording: Recording, topic: str) -> str | None:
    """Judge by the topic's first message that can be read."""
    for message in recording.messages([topic]):
        with suppress(RecordingError):
            return why_no_lidar(topic, recording.deserialize(message))
    return None


def _moving_links(recording: Recording, message: RecordedMessage) -> list[tuple[str, str]]:
    """Return parent and child of every link that a TFMessage or Odometry tells of; none where it cannot be read."""
    try:
        content = recording.deserialize(message)
    except RecordingError:
        return []
    links = getattr(content, "transforms", [content])
    return [(frame_name(link.header.frame_id), frame_name(link.child_frame_id)) for link in links]


def _fixed_pose(static: TransformTree, frame: str, base_frame: str) -> Pose | None:
    """Return frame_T_base where the two are fixed to each other, else None."""
    if frame == frame_name(base_frame):
        return np.eye(4)
    try:
        return static.lookup(frame, base_frame)
    except TransformError:
        return None
