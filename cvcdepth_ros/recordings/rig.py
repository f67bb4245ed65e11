# SPDX-License-Identifier: Apache-2.0
"""The rig of a recording: its cameras found, or a rig file's completed, from CameraInfo, `/tf_static` and `/tf`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

from pydantic import ValidationError

from cvcdepth_core.errors import RecordingError, RigError, first_validation_message
from cvcdepth_core.rig.rig_file import CameraEntry, RigLayout
from cvcdepth_core.rig.wide_lenses import from_left_to_right, lens_name
from cvcdepth_ros.bags import Recording
from cvcdepth_ros.messages.camera_discovery import (
    CAMERA_INFO_TYPE,
    RECORDED_IMAGE_TYPES,
)
from cvcdepth_ros.messages.recorded_cameras import find_recorded_cameras
from cvcdepth_ros.messages.recorded_changes import find_calibration_changes
from cvcdepth_ros.messages.rig_assembly import RigAssembler
from cvcdepth_ros.messages.transforms import TransformTree, frame_name
from cvcdepth_ros.recordings.motion import MotionLink, VehicleMotion, find_motion_link
from cvcdepth_ros.recordings.rig_messages import RigMessages


class RecordedRig:
    """The rig of an opened recording, complete: made once and handed to all that need some of it."""

    def __init__(self, recording: Recording, layout: RigLayout, messages: RigMessages) -> None:
        """Complete `layout` with what was read for its cameras; see `from_recording`.

        Raises RigError or TransformError, naming the recording and the camera, for the first that stays incomplete.
        """
        self.recording = recording
        self.layout = layout
        """The cameras: the rig file's, as it describes them, or those found, with calibrations and poses."""
        self._messages = messages
        assembler = messages.assembler(layout)
        for problem in assembler.problems().values():
            raise RigError(f"{recording.path}: {problem}{_remedy(assembler)}")
        self.transforms: TransformTree = assembler.transforms
        """The fixed transforms."""

    @classmethod
    def from_recording(
        cls, recording: Recording, layout: RigLayout | None = None, base_frame: str = "base_link"
    ) -> RecordedRig:
        """Return the rig of a rig file, or without one of the cameras found, ordered around the vehicle.

        Raises RecordingError when a topic that the layout needs is not in the recording or is of another type, or no
        camera is found; RigError or TransformError, naming the recording and the camera, for the first that
        is not calibrated or has no transform to the base frame, which `base_frame` names where there is no layout.
        """
        messages = RigMessages(recording, layout)
        chosen = chosen_layout(recording, layout, base_frame)
        for problem in topic_problems(recording, chosen):
            raise RecordingError(f"{recording.path}: {problem}")
        found = cls(recording, chosen, messages)
        return found if layout is not None else found.with_split_lenses().completed()

    def with_split_lenses(self) -> RecordedRig:
        """Return the same with two or three cameras in the place of each wide lens, see `split_wide_lenses`."""
        assembler = self.assembler()
        assembler.split_wide_lenses()
        return self.with_layout(assembler.layout)

    def completed(self) -> RecordedRig:
        """Return the same with all that was collected in its layout, the cameras ordered around the vehicle."""
        return self.with_layout(self.assembler().completed_layout())

    def with_layout(self, layout: RigLayout) -> RecordedRig:
        """Return the rig of another layout with the same camera_info topics; nothing is read again."""
        return RecordedRig(self.recording, layout, self._messages)

    def assembler(self) -> RigAssembler:
        """Return a new assembler with this rig in it, to which later CameraInfos can be added."""
        return self._messages.assembler(self.layout)

    def open_assembler(self) -> tuple[RigAssembler, set[str]]:
        """Return an assembler that later CameraInfos can change, and the cameras whose calibration they are told to.

        A rig file's calibration that differs from the recording's stays as it is.
        """
        told = {camera.name for camera in self.layout.cameras if self._messages.tells_calibration_of(camera)}
        cameras = tuple(
            camera.model_copy(update={"calibration": None}) if camera.name in told else camera
            for camera in self.layout.cameras
        )
        return self._messages.assembler(self.layout.model_copy(update={"cameras": cameras})), told

    def notes(self) -> list[str]:
        """Return how cameras were chosen, messages understood, and what changes on the way, a line each.

        The rig is of the beginning of the recording.
        """
        found = find_recorded_cameras(self.recording)
        changes = find_calibration_changes(self.recording, self.layout, self._messages.firsts)
        return [
            *self.recording.notes,
            *found.choices,
            *found.left_out,
            *self.open_assembler()[0].notes,
            *_split_lenses(self.layout),
            *(f"{change}; the rig is that of what comes before" for change in changes),
        ]

    @property
    def static_links(self) -> Mapping[str, Any]:
        """The last `geometry_msgs/TransformStamped` of `/tf_static` for each child frame."""
        return self._messages.static_links

    @property
    def lidars(self) -> tuple[str, ...]:
        """The topics of the LiDARs: those of all point clouds that were not made from camera images."""
        return self._messages.lidars

    @property
    def other_clouds(self) -> Mapping[str, str]:
        """By topic, why its clouds are no LiDAR's."""
        return self._messages.other_clouds

    def vehicle_motion(self) -> VehicleMotion | None:
        """Return the vehicle's motion, still to be added message by message; None where none is recorded."""
        return None if self._motion_link is None else VehicleMotion(self._motion_link)

    @cached_property
    def _motion_link(self) -> MotionLink | None:
        return find_motion_link(self.recording, self.layout.base_frame, self.transforms)


def _split_lenses(layout: RigLayout) -> Iterator[str]:
    for names in layout.views_by_image.values():
        if len(names) > 1:
            views = ", ".join(from_left_to_right(layout, names))
            yield f"camera {lens_name(names)}: shown by {views}, views of its one lens"


def _remedy(assembler: RigAssembler) -> str:
    """Return what helps where none of the transforms knows the base frame."""
    frames = assembler.transforms.frames
    if not frames or frame_name(assembler.layout.base_frame) in frames:
        return ""
    return "; name the vehicle's frame with --base-frame, or as base_frame in the rig file"


def discover_rig(recording: Recording, base_frame: str = "base_link") -> RigLayout:
    """Find the recording's cameras and return them complete; see `RecordedRig.from_recording`."""
    return RecordedRig.from_recording(recording, base_frame=base_frame).layout


def chosen_layout(recording: Recording, layout: RigLayout | None, base_frame: str) -> RigLayout:
    """Return the rig file's layout where there is one, else that of the cameras found, see `discover_layout`."""
    return discover_layout(recording, base_frame) if layout is None else layout


def discover_layout(recording: Recording, base_frame: str) -> RigLayout:
    """Return the recording's cameras as they are found by their topics, without calibrations and poses.

    Raises RecordingError when there is none.
    """
    entries = recorded_cameras(recording)
    if not entries:
        raise RecordingError(f"{recording.path}: {_no_camera(recording)}")
    try:
        return RigLayout(base_frame=base_frame, cameras=tuple(entries))
    except ValidationError as error:
        raise RecordingError(f"{recording.path}: its cameras make no rig: {first_validation_message(error)}") from error


def recorded_cameras(recording: Recording) -> list[CameraEntry]:
    """Return the cameras of which something was recorded, see `find_cameras`."""
    return find_recorded_cameras(recording).cameras


def topics_without_images(recording: Recording) -> Iterator[str]:
    """Yield the camera_info topics without images in their namespace: a rig that is found would silently lack them."""
    yield from find_recorded_cameras(recording).without_images


def topic_problems(recording: Recording, layout: RigLayout) -> Iterator[str]:
    """Yield what is wrong with the topics that the cameras need, camera by camera."""
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


def _no_camera(recording: Recording) -> str:
    infos = [topic.name for topic in recording.topics.values() if topic.type == CAMERA_INFO_TYPE]
    images = [topic.name for topic in recording.topics.values() if topic.type in RECORDED_IMAGE_TYPES]
    offers = find_recorded_cameras(recording).offers
    return (
        f"a rig needs a camera, found 0: a camera is a namespace with a camera_info and an image topic; "
        f"camera_info: {', '.join(infos) or 'none'}; images: {', '.join(images) or 'none'}"
        f"{offers and f'; {offers}'}"
    )
