# SPDX-License-Identifier: Apache-2.0
"""Input of all checks: one recording, read once, with its rig as far as it is known."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError, RecordingError, RigError, TransformError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.stamps import exposure_times
from cvcdepth_core.training.config import RecordingsConfig
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.messages.camera_discovery import RECORDED_IMAGE_TYPES
from cvcdepth_ros.messages.conversion import picture_from_message
from cvcdepth_ros.messages.recorded_changes import CalibrationHistory
from cvcdepth_ros.messages.rig_assembly import RigAssembler
from cvcdepth_ros.recordings.compared_pictures import ComparedPictures
from cvcdepth_ros.recordings.motion import VehicleMotion, find_motion_link
from cvcdepth_ros.recordings.refusals import Refusals
from cvcdepth_ros.recordings.rig import chosen_layout
from cvcdepth_ros.recordings.rig_messages import RigMessages
from cvcdepth_ros.recordings.topic_timing import TopicTiming
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet, SurroundSynchronizer

Status = Literal["passed", "warning", "failed", "skipped"]

_DEFAULTS = MatchingSettings()
_TRAINING = RecordingsConfig()
_KEPT_SWEEPS = 3
_SHOWN_SETS = 3


@dataclass(frozen=True)
class CheckResult:
    """Result of one check."""

    status: Status
    """skipped: there is nothing to check, or what it needs is missing, which another check reports."""
    finding: str
    """One line, with the values that were seen."""
    remedy: str | None = None
    """What the user can do about it."""
    values: dict[str, Any] = field(default_factory=dict)
    """The values, for machines."""


@dataclass(frozen=True)
class CheckOptions:
    """What the recording is checked for, and which part of it."""

    tolerance: float = _DEFAULTS.tolerance
    """Seconds that two images of one set may be apart."""
    queue_size: int = _DEFAULTS.queue_size
    """Images that are kept per camera while their set is not complete."""
    base_frame: str = "base_link"
    """The vehicle's frame where no rig file names it."""
    lidar: tuple[str, ...] | None = None
    """LiDAR topics; None for all of the recording, see `RigMessages.lidars`."""
    training: RecordingsConfig = _TRAINING
    """How training samples would be chosen."""
    checkpoint: Path | None = None
    """Weights whose pose network is compared with the recorded motion."""
    pictures: bool = False
    """Whether the network is run, to compare pictures with mounts and motion."""
    start: int | None = None
    """First log time to read, ns."""
    stop: int | None = None
    """Log time to read to (exclusive), ns."""


class ImageTimes(NamedTuple):
    """When one image was taken and recorded, ns."""

    camera: str
    stamp: int
    log_time: int


class CheckContext:
    """One recording, read once."""

    def __init__(
        self,
        recording: Recording,
        options: CheckOptions,
        rig_layout: RigLayout | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        """Read the window of the recording; `progress` is called with log times (ns)."""
        self.recording = recording
        self.options = options
        self.has_rig_file = rig_layout is not None
        self.contradiction: str | None = None
        """Why the recorded transforms make no tree."""
        self.refusal: str | None = None
        """Why the cameras make no rig at all."""
        messages = RigMessages(recording, rig_layout)
        self.first_messages = messages.firsts
        """Of each topic that may be a camera's; of CameraInfos where there is a rig file."""
        layout = self._chosen_layout(rig_layout)
        self.assembler = None if layout is None else self._assembled(messages, layout)
        if self.assembler is not None and not self.has_rig_file:
            self.assembler.split_wide_lenses()
        """None where the cameras make no rig, or the transforms contradict each other."""
        self.lidars = messages.lidars if options.lidar is None else options.lidar
        """The topics of the LiDARs."""
        self.other_clouds = messages.other_clouds if options.lidar is None else {}
        """By topic, why its clouds are no LiDAR's."""
        self.motion = self._found_motion()
        self.refused_motion = Refusals()
        """Impossible poses."""
        self.timings: dict[str, TopicTiming] = {}
        """Of the topics with images and LiDAR sweeps."""
        self.calibrations = self._followed_calibrations()
        """What the CameraInfos say; None where a rig file says it, or there are no cameras."""
        self.images: list[ImageTimes] = []
        """Every image, in the order of recording."""
        self.sweeps: dict[str, list[Any]] = defaultdict(list)
        """The first sweeps of each LiDAR; RecordingError in place of one that is no message."""
        self.compared: ComparedPictures | CheckResult | None = None
        """What comparing pictures told, or why it could not be done; None before."""
        self._first_images: dict[str, RecordedMessage] = {}
        self._read(progress)

    @property
    def layout(self) -> RigLayout | None:
        """The cameras: the rig file's, or those found, ordered around the vehicle where their poses are known."""
        if self.assembler is None:
            return None
        if self.has_rig_file or self.assembler.problems():
            return self.assembler.layout
        return self.assembler.completed_layout()

    @cached_property
    def rig(self) -> Rig | None:
        """The complete rig; None where something is missing, which the checks of its parts report."""
        if self.layout is None or self.assembler is None or self.assembler.problems():
            return None
        return self.assembler.rig()

    @cached_property
    def pictures(self) -> dict[str, Picture | str]:
        """Each camera's first image, or why it cannot be decoded; cameras without an image are absent."""
        return {camera: self._picture(camera, message) for camera, message in self._first_images.items()}

    def stamps(self, camera: str) -> NDArray[np.int64]:
        """Return the stamps [M] of a camera's images, ns, sorted."""
        return np.array(sorted(image.stamp for image in self.images if image.camera == camera), dtype=np.int64)

    def times(self, camera: str) -> NDArray[np.int64]:
        """Return when a camera's images were taken [M], ns, sorted: their stamps without the camera's offset."""
        entries = self.assembler.layout.cameras if self.assembler else ()
        offsets = {entry.name: entry.stamp_offset_ns for entry in entries}
        return exposure_times(self.stamps(camera), offsets[camera])

    def match(
        self, layout: RigLayout, tolerance: float, changed_offsets: Mapping[str, float] | None = None
    ) -> list[SurroundSet[int]]:
        """Match the images as the node does; the sets hold their log times (ns). Stamp offsets are in seconds."""
        offsets = {camera.name: camera.stamp_offset for camera in layout.cameras} | dict(changed_offsets or {})
        synchroniser: SurroundSynchronizer[int] = SurroundSynchronizer(
            layout.names, layout.anchor_camera, tolerance, offsets, self.options.queue_size
        )
        sets = [found for image in self.images for found in synchroniser.add(*image)]
        return sets + synchroniser.flush()

    @cached_property
    def shown_sets(self) -> list[dict[str, Picture]]:
        """The pictures of a few sets, spread over the recording; those that cannot be decoded are left out."""
        return [*self._decoded_sets()]

    def _decoded_sets(self) -> Iterator[dict[str, Picture]]:
        if self.layout is None:
            return
        sets = self.match(self.layout, self.options.tolerance)
        topics = {camera.name: camera.image_topic for camera in self.layout.cameras}
        for found in (sets[len(sets) * (2 * i + 1) // (2 * _SHOWN_SETS)] for i in range(min(_SHOWN_SETS, len(sets)))):
            wanted: dict[tuple[str, int], list[str]] = defaultdict(list)
            for camera, log_time in found.images.items():
                wanted[topics[camera], log_time].append(camera)
            times = found.images.values()
            messages = self.recording.messages(set(topics.values()), min(times), max(times) + 1)
            read = {
                camera: message for message in messages for camera in wanted.get((message.topic, message.log_time), ())
            }
            pictures = {camera: self._picture(camera, message) for camera, message in read.items()}
            yield {camera: picture for camera, picture in pictures.items() if not isinstance(picture, str)}

    def _chosen_layout(self, rig_file: RigLayout | None) -> RigLayout | None:
        try:
            return chosen_layout(self.recording, rig_file, self.options.base_frame)
        except RecordingError as error:
            self.refusal = str(error)
            return None

    def _assembled(self, messages: RigMessages, layout: RigLayout) -> RigAssembler | None:
        try:
            return messages.assembler(layout)
        except TransformError as error:
            self.contradiction = str(error)
        except (RecordingError, RigError) as error:
            self.refusal = str(error)
        return None

    def _found_motion(self) -> VehicleMotion | None:
        if self.assembler is None:
            return None
        link = find_motion_link(self.recording, self.assembler.layout.base_frame, self.assembler.transforms)
        return None if link is None else VehicleMotion(link)

    def _followed_calibrations(self) -> CalibrationHistory | None:
        if self.has_rig_file or self.assembler is None:
            return None
        return CalibrationHistory(self.recording, self.assembler.layout, self.first_messages)

    def _read(self, progress: Callable[[int], None] | None) -> None:
        cameras = self._cameras_by_topic()
        moving = [self.motion.topic] if self.motion else []
        infos = self.calibrations.topics if self.calibrations else set()
        topics = {*cameras, *self.lidars, *moving, *infos} & self.recording.topics.keys()
        for message in self.recording.messages(topics, self.options.start, self.options.stop):
            if message.topic in moving:
                self._add_motion(message)
            elif self.calibrations and message.topic in infos:
                self.calibrations.add(message)
            else:
                self._add_stamped(message, cameras.get(message.topic, ()))
            if progress:
                progress(message.log_time)

    def _cameras_by_topic(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = defaultdict(list)
        images = {topic.name for topic in self.recording.topics.values() if topic.type in RECORDED_IMAGE_TYPES}
        for camera in self.assembler.layout.cameras if self.assembler else ():
            if camera.image_topic in images:
                found[camera.image_topic].append(camera.name)
        return found

    def _add_stamped(self, message: RecordedMessage, cameras: Iterable[str]) -> None:
        """Add an image or a sweep."""
        if message.topic not in self.timings:
            type_ = self.recording.topics[message.topic].type
            self.timings[message.topic] = TopicTiming(type_, self.recording.typestore)
        stamp = self.timings[message.topic].add(message)
        for camera in cameras:
            self._first_images.setdefault(camera, message)
            if stamp is not None:
                self.images.append(ImageTimes(camera, stamp, message.log_time))
        if message.topic in self.lidars and len(self.sweeps[message.topic]) < _KEPT_SWEEPS:
            self.sweeps[message.topic].append(self._deserialized(message))

    def _add_motion(self, message: RecordedMessage) -> None:
        with self.refused_motion.instead_of_errors():
            if self.motion is not None:
                self.motion.add(self.recording.deserialize(message))

    def _deserialized(self, message: RecordedMessage) -> Any:
        try:
            return self.recording.deserialize(message)
        except RecordingError as error:
            return error

    def _picture(self, camera: str, message: RecordedMessage) -> Picture | str:
        try:
            return picture_from_message(self.recording.deserialize(message), camera)
        except (ImageError, RecordingError) as error:
            return str(error)
