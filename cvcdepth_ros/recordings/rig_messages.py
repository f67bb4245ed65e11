# SPDX-License-Identifier: Apache-2.0
"""The messages of a recording that describe its sensors: CameraInfo, fixed transforms, frames of point clouds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from copy import deepcopy
from functools import cached_property
from typing import Any, NamedTuple

from cvcdepth_core.errors import RecordingError, RigError, TransformError
from cvcdepth_core.rig.rig_file import CameraEntry, RigLayout
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.messages.camera_discovery import CAMERA_INFO_TYPE, RECORDED_IMAGE_TYPES
from cvcdepth_ros.messages.camera_info import MOST_UNCALIBRATED, is_uncalibrated, read_camera_info
from cvcdepth_ros.messages.cloud_sources import why_no_lidar
from cvcdepth_ros.messages.point_clouds import POINT_CLOUD_TYPE
from cvcdepth_ros.messages.recorded_cameras import find_recorded_cameras
from cvcdepth_ros.messages.recorded_changes import moment_of
from cvcdepth_ros.messages.rig_assembly import RigAssembler
from cvcdepth_ros.messages.transform_topics import (
    describe_transform_topics,
    moving_transform_topics,
    static_transform_topics,
)
from cvcdepth_ros.messages.transforms import TransformTree, frame_name
from cvcdepth_ros.recordings.fixed_frames import (
    ObservedLink,
    add_fixed_frames,
    observed_links,
)

STATIC_TRANSFORMS = "/tf_static"


class CloudSource(NamedTuple):
    """The source of one topic's clouds, by its first message that can be read."""

    frame_id: str
    why_no_lidar: str | None
    """None where it may be a LiDAR."""


class RigMessages:
    """The first CameraInfo of each camera, all fixed transforms, and the sources of all point clouds of a recording.

    They are read in one pass, which drops each topic as soon as nothing more of it is needed, so that blocks of the
    file that hold nothing else are skipped.
    """

    def __init__(self, recording: Recording, layout: RigLayout | None) -> None:
        """Read for the cameras of `layout`; where it is None for all that may be found, see `find_recorded_cameras`.

        Damaged messages raise nothing here, see `assembler`.
        """
        self._recording = recording
        self.static_links: dict[str, Any] = {}
        """The last `geometry_msgs/TransformStamped` of `/tf_static` for each child frame."""
        self.firsts: dict[str, RecordedMessage] = {}
        """The first message of each topic that may be a camera's, by topic."""
        self._camera_infos: dict[str, list[Any]] = defaultdict(list)
        """By topic, up to the first with a calibration; RecordingError in place of a message that cannot be read."""
        self._clouds: dict[str, CloudSource] = {}
        self._transforms = TransformTree()
        self._contradiction: TransformError | RecordingError | None = None
        self._awaited = {*_camera_topics(recording, layout), *cloud_topics(recording)}
        self._static_topics = static_transform_topics(recording)
        self._awaited.update(self._static_topics)
        self._read()
        if layout is None:
            find_recorded_cameras(recording, self.firsts)  # which remembers them

    @property
    def lidars(self) -> tuple[str, ...]:
        """The topics of the LiDARs, sorted: those of all point clouds but the other ones."""
        return tuple(topic for topic in cloud_topics(self._recording) if topic not in self.other_clouds)

    @property
    def other_clouds(self) -> dict[str, str]:
        """By topic, why its clouds are no LiDAR's, see `why_no_lidar`.

        The node's own clouds are among them where it ran during the recording: they are no ground truth.
        """
        return {topic: source.why_no_lidar for topic, source in sorted(self._clouds.items()) if source.why_no_lidar}

    def tells_calibration_of(self, camera: CameraEntry) -> bool:
        """Whether the camera's calibration in a layout is the one that the recording tells."""
        infos = [info for info in self._camera_infos[camera.camera_info_topic] if not isinstance(info, RecordingError)]
        if camera.calibration is None or not infos:
            return False
        with suppress(RigError):
            return read_camera_info(infos[-1], camera.name).calibration == camera.calibration
        return False

    def assembler(self, layout: RigLayout) -> RigAssembler:
        """Return an assembler of `layout` with everything that was read for it; the rig may still be incomplete.

        Transforms are those of `/tf_static`; frames of cameras and LiDARs that are not connected there are looked for
        on `/tf`, see `add_fixed_frames`. Raises RecordingError for a CameraInfo that cannot be read, and TransformError
        for transforms that contradict each other, and for a camera that moves.
        """
        assembler = RigAssembler(layout, deepcopy(self._transforms))
        assembler.about_transforms = describe_transform_topics(self._recording)
        for topic, infos in self._camera_infos.items():
            readable = [info for info in infos if not isinstance(info, RecordingError)]
            if infos and not readable:
                raise infos[0]
            for info in readable:
                assembler.add_camera_info_on(topic, info)
        if self._contradiction is not None:
            raise self._contradiction
        if moving_transform_topics(self._recording):
            self._add_fixed_frames(assembler)
        return assembler

    @cached_property
    def _links(self) -> dict[str, ObservedLink]:
        return observed_links(self._recording)

    def _read(self) -> None:
        position: int | None = 0
        while position is not None and self._awaited:
            position = self._read_from(position)

    def _read_from(self, start: int) -> int | None:
        """Take what is awaited up to the first message that is not any more; return its log time, None at the end."""
        for message in self._recording.messages(set(self._awaited), start):
            if message.topic not in self._awaited:
                return message.log_time
            self._take(message)
        return None

    def _take(self, message: RecordedMessage) -> None:
        if message.topic in self._static_topics:
            self._add_transforms(message)
        elif self._recording.topics[message.topic].type == CAMERA_INFO_TYPE:
            self.firsts.setdefault(message.topic, message)
            self._add_camera_info(message)
        elif self._recording.topics[message.topic].type in RECORDED_IMAGE_TYPES:
            self.firsts[message.topic] = message
            self._awaited.remove(message.topic)
        else:
            self._add_cloud(message)

    def _add_transforms(self, message: RecordedMessage) -> None:
        try:
            content = self._recording.deserialize(message)
            self._transforms.add_message(content, moment_of(message.log_time, self._recording))
            self.static_links |= {frame_name(link.child_frame_id): link for link in content.transforms}
        except TransformError as error:
            self._contradiction = TransformError(f"{self._recording.path}: {message.topic}: {error}")
        except RecordingError as error:
            self._contradiction = error
        if self._contradiction is not None:
            self._awaited.difference_update(self._static_topics)

    def _add_cloud(self, message: RecordedMessage) -> None:
        with suppress(RecordingError):
            content = self._recording.deserialize(message)
            self._clouds[message.topic] = CloudSource(content.header.frame_id, why_no_lidar(message.topic, content))
            self._awaited.remove(message.topic)

    def _add_camera_info(self, message: RecordedMessage) -> None:
        """Take one that may be without a calibration: drivers send zeros until they have read their file."""
        infos = self._camera_infos[message.topic]
        try:
            infos.append(self._recording.deserialize(message))
        except RecordingError as error:
            infos.append(error)
        has_calibration = not isinstance(infos[-1], RecordingError) and not is_uncalibrated(infos[-1])
        if has_calibration or len(infos) == MOST_UNCALIBRATED:
            self._awaited.remove(message.topic)

    def _add_fixed_frames(self, assembler: RigAssembler) -> None:
        tree, base_frame = assembler.transforms, assembler.layout.base_frame
        open_cameras = [camera.name for camera in assembler.layout.cameras if camera.base_T_camera is None]
        cameras = _unconnected(tree, base_frame, [assembler.frame_id(name) or "" for name in open_cameras])
        lidars = _unconnected(tree, base_frame, [self._clouds[topic].frame_id for topic in sorted(self._clouds)])
        if not cameras and not lidars:
            return
        try:
            assembler.frames_on_tf += add_fixed_frames(tree, self._links, base_frame, cameras)
        except TransformError as error:
            raise TransformError(f"{self._recording.path}: {error}") from error
        for lidar in lidars:
            try:
                assembler.frames_on_tf += add_fixed_frames(tree, self._links, base_frame, [lidar])
            except TransformError as error:  # without it there is less truth, no less depth
                tree.refused[frame_name(lidar)] = str(error)


def cloud_topics(recording: Recording) -> list[str]:
    """Return the names of all topics with point clouds, sorted."""
    return sorted(topic.name for topic in recording.topics.values() if topic.type == POINT_CLOUD_TYPE and topic.count)


def _camera_topics(recording: Recording, layout: RigLayout | None) -> set[str]:
    """Return the CameraInfos of a layout's cameras; without one all of them, and all images, to find cameras by."""
    types = {topic.name: topic.type for topic in recording.topics.values() if topic.count}
    infos = {name for name, type_ in types.items() if type_ == CAMERA_INFO_TYPE}
    if layout is not None:
        return {camera.camera_info_topic for camera in layout.cameras} & infos
    return infos | {name for name, type_ in types.items() if type_ in RECORDED_IMAGE_TYPES}


def _unconnected(tree: TransformTree, base_frame: str, frames: Sequence[str]) -> list[str]:
    root = tree.ancestors(base_frame)[-1]
    return [frame for frame in frames if tree.ancestors(frame)[-1] != root]
