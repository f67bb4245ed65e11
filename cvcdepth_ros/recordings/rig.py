# SPDX-License-Identifier: Apache-2.0
"""The rig of a recording: its cameras found, or a rig file's completed, from CameraInfo, `/tf_static` and `/tf`."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any

from pydantic import ValidationError

from cvcdepth_core.errors import RecordingError, RigError, TransformError
from cvcdepth_core.rig.calibration import first_validation_message
from cvcdepth_core.rig.rig import CameraEntry, RigLayout
from cvcdepth_ros.bags import Recording
from cvcdepth_ros.messages.camera_discovery import CAMERA_INFO_TYPE, RECORDED_IMAGE_TYPES
from cvcdepth_ros.messages.camera_info import MOST_UNCALIBRATED, is_uncalibrated
from cvcdepth_ros.messages.recorded_cameras import find_recorded_cameras
from cvcdepth_ros.messages.recorded_changes import moment_of
from cvcdepth_ros.messages.rig_assembly import RigAssembler
from cvcdepth_ros.messages.transform_topics import (
    describe_transform_topics,
    moving_transform_topics,
    static_transform_topics,
)
from cvcdepth_ros.messages.transforms import TransformTree, frame_name
from cvcdepth_ros.recordings.fixed_frames import add_fixed_frames, observed_links
from cvcdepth_ros.recordings.lidar import cloud_topics

STATIC_TRANSFORMS = "/tf_static"


def discover_rig(recording: Recording, base_frame: str = "base_link") -> RigLayout:
    """Find the recording's cameras and return them complete, ordered around the vehicle from the front one.

    Raises RecordingError when there are fewer than two, and RigError or TransformError, naming the recording and the
    camera, for the first that is not calibrated or has no transform to `base_frame`.
    """
    return assemble_rig(recording, discover_layout(recording, base_frame)).completed_layout()


def discover_layout(recording: Recording, base_frame: str = "base_link") -> RigLayout:
    """Find the recording's cameras; calibrations and poses are still open.

    Raises RecordingError when there are fewer than two.
    """
    entries = recorded_cameras(recording)
    if len(entries) < 2:
        raise RecordingError(f"{recording.path}: {_too_few(entries, recording)}")
    try:
        return RigLayout(base_frame=base_frame, cameras=tuple(entries))
    except ValidationError as error:
        raise RecordingError(f"{recording.path}: its cameras make no rig: {first_validation_message(error)}") from error


def recorded_cameras(recording: Recording) -> list[CameraEntry]:
    """Return the cameras of which something was recorded, see `find_cameras`."""
    return find_recorded_cameras(recording).cameras


def topics_without_images(recording: Recording) -> Iterator[str]:
    """Give the camera_info topics beside which no image was recorded: a rig that is found would silently lack them."""
    yield from find_recorded_cameras(recording).without_images


def assemble_rig(recording: Recording, layout: RigLayout) -> RigAssembler:
    """Complete `layout` with each camera's first CameraInfo and the static transforms of the whole recording.

    Raises RecordingError when a topic that the layout needs is not in the recording or is of another type; RigError or
    TransformError, naming the recording and the camera, for the first that stays incomplete.
    """
    for problem in topic_problems(recording, layout):
        raise RecordingError(f"{recording.path}: {problem}")
    assembler = collect_rig(recording, layout)
    for problem in assembler.problems().values():
        raise RigError(f"{recording.path}: {problem}")
    return assembler


def collect_rig(recording: Recording, layout: RigLayout) -> RigAssembler:
    """Collect each camera's first CameraInfo with a calibration and the fixed transforms, as far as they are recorded.

    Transforms are those of `/tf_static`; frames of cameras and LiDARs that are not connected there are looked for on
    `/tf`, see `add_fixed_frames`. Raises TransformError for transforms that contradict each other, and for a camera
    that moves.
    """
    assembler = RigAssembler(layout)
    _add_first_camera_infos(assembler, recording)
    _add_static_transforms(assembler, recording)
    _add_fixed_frames(assembler, recording)
    return assembler


def add_camera_info(assembler: RigAssembler, topic: str, message: Any) -> bool:
    """Hand a CameraInfo to every camera of that topic; return whether it says anything new."""
    cameras = [camera.name for camera in assembler.layout.cameras if camera.camera_info_topic == topic]
    return True in [assembler.add_camera_info(camera, message) for camera in cameras]


def _add_first_camera_infos(assembler: RigAssembler, recording: Recording) -> None:
    recorded = {topic.name for topic in recording.topics.values() if topic.type == CAMERA_INFO_TYPE}
    awaited = {camera.camera_info_topic for camera in assembler.layout.cameras} & recorded
    looked_at: Counter[str] = Counter()
    for message in recording.messages(awaited):
        if message.topic in awaited:
            info = recording.deserialize(message)
            add_camera_info(assembler, message.topic, info)
            looked_at[message.topic] += 1
            if not is_uncalibrated(info) or looked_at[message.topic] == MOST_UNCALIBRATED:
                awaited.remove(message.topic)
        if not awaited:
            return


def _add_static_transforms(assembler: RigAssembler, recording: Recording) -> None:
    assembler.about_transforms = describe_transform_topics(recording)
    for message in recording.messages(static_transform_topics(recording)):
        try:
            assembler.transforms.add_message(recording.deserialize(message), moment_of(message.log_time, recording))
        except TransformError as error:
            raise TransformError(f"{recording.path}: {message.topic}: {error}") from error


def _add_fixed_frames(assembler: RigAssembler, recording: Recording) -> None:
    if not moving_transform_topics(recording):
        return
    tree, base_frame = assembler.transforms, assembler.layout.base_frame
    open_cameras = [camera.name for camera in assembler.layout.cameras if camera.base_T_camera is None]
    cameras = _unconnected(tree, base_frame, [assembler.frame_id(name) or "" for name in open_cameras])
    lidars = _unconnected(tree, base_frame, [*_lidar_frames(recording)])
    if not cameras and not lidars:
        return
    try:
        links = observed_links(recording)
        assembler.frames_on_tf += add_fixed_frames(tree, links, base_frame, cameras)
    except TransformError as error:
        raise TransformError(f"{recording.path}: {error}") from error
    for lidar in lidars:
        try:
            assembler.frames_on_tf += add_fixed_frames(tree, links, base_frame, [lidar])
        except TransformError as error:  # without it there is less truth, no less depth
            tree.refused[frame_name(lidar)] = str(error)


def _unconnected(tree: TransformTree, base_frame: str, frames: Sequence[str]) -> list[str]:
    root = tree.ancestors(base_frame)[-1]
    return [frame for frame in frames if tree.ancestors(frame)[-1] != root]


def _lidar_frames(recording: Recording) -> Iterator[str]:
    """Give the frame of each LiDAR's first sweep that can be read."""
    for topic in cloud_topics(recording):
        for message in islice(recording.messages([topic]), 1):
            with suppress(RecordingError):
                yield recording.deserialize(message).header.frame_id


def topic_problems(recording: Recording, layout: RigLayout) -> Iterator[str]:
    """Say what is wrong with the topics that the cameras need, camera by camera."""
    for camera in layout.cameras:
        problem = _topic_problem(recording, camera.image_topic, RECORDED_IMAGE_TYPES)
        if problem is None and (camera.calibration is None or camera.frame_id is None):
            problem = _topic_problem(recording, camera.camera_info_topic, (CAMERA_INFO_TYPE,))
        if problem is not None:
            yield f"camera {camera.name}: {problem}"


def _topic_problem(recording: Recording, name: str, types: Sequence[str]) -> str | None:
    topic = recording.topics.get(name)
    if topic is None:
        others = [other.name for other in recording.topics.values() if other.type in types]
        return f"no topic {name}; of type {' or '.join(types)} there are {', '.join(others) or 'none'}"
    if topic.type not in types:
        return f"{name} carries {topic.type}, want {' or '.join(types)}"
    return None if topic.count else f"no message on {name}"


def _too_few(entries: Sequence[CameraEntry], recording: Recording) -> str:
    infos = [topic.name for topic in recording.topics.values() if topic.type == CAMERA_INFO_TYPE]
    images = [topic.name for topic in recording.topics.values() if topic.type in RECORDED_IMAGE_TYPES]
    offers = find_recorded_cameras(recording).offers
    return (
        f"a surround rig needs two cameras, found {len(entries)}: a camera is a namespace with a camera_info and an "
        f"image topic; camera_info: {', '.join(infos) or 'none'}; images: {', '.join(images) or 'none'}"
        f"{offers and f'; {offers}'}"
    )
