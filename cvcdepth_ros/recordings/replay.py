# SPDX-License-Identifier: Apache-2.0
"""A recording's surround sets and their depth, through the node's own matching, preprocessing and estimator.

No ROS here. `SurroundReplay` gives the sets (for training, say), `DepthReplay` adds the depth. No set is
skipped: there is no clock to keep up with, hence no mailbox.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import CvcDepthError, RecordingError, RigError
from cvcdepth_core.estimator import DepthPredictor, SurroundDepthEstimator
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.stamps import NANOSECONDS, exposure_times
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_ros.bags import RecordedMessage
from cvcdepth_ros.messages.camera_info import content_of, is_usable
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.recorded_changes import moment_of
from cvcdepth_ros.recordings.refusals import Refusals
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.set_motion import RecordedSetMotion
from cvcdepth_ros.settings import MatchingSettings, ModelSettings
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.refinement import RefinementStage
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet, estimate_set
from cvcdepth_ros.surround_sets.synchronizer import (
    SurroundSet,
    SurroundSynchronizer,
    SynchronizerStatistics,
)

Handlers = Mapping[str, Callable[[RecordedMessage], None]]

_IMAGES_TO_EXPLAIN = 1000


class RecordedImage(NamedTuple):
    """An image message and when it was recorded (ns)."""

    message: Any
    log_time: int


class SurroundReplay:
    """The surround sets of a recording, matched as the live node would match them."""

    def __init__(self, recorded: RecordedRig, matching: MatchingSettings, min_cameras: int = 0) -> None:
        """Match the images of a rig's recording.

        `min_cameras` below the rig's number gives sets that lack the images of dead cameras; 0 gives only whole ones.
        """
        self.recorded = recorded
        self.recording = recorded.recording
        self.layout = recorded.layout
        self.unreadable = Refusals()
        """Images and CameraInfos that cannot be deserialised."""
        self._assembler, self._recalibrated = recorded.open_assembler()
        self._last_infos: dict[str, tuple[Any, ...]] = {}
        self._rig: Rig | RigError = self._assembler.rig()
        self._tolerance = matching.tolerance
        self._synchroniser: SurroundSynchronizer[RecordedImage] = SurroundSynchronizer.from_layout(
            self.layout, matching.tolerance, matching.queue_size, min_cameras
        )

    @property
    def rig(self) -> Rig:
        """The rig as of the last set: a new one whenever a CameraInfo changes; RigError while one is impossible."""
        if isinstance(self._rig, RigError):
            raise self._rig
        return self._rig

    @property
    def required(self) -> int:
        """Images without which there is no set."""
        return self._synchroniser.required

    @property
    def frame_ids(self) -> dict[str, str]:
        """The optical frame of each camera's picture."""
        return {name: self._assembler.view_frame_id(name) or "" for name in self.layout.names}

    @property
    def calibration_changes(self) -> list[str]:
        """Which cameras' calibrations changed in what was read so far, when and how."""
        return [f"{change}, {moment_of(time, self.recording)}" for time, change in self._assembler.changes]

    @property
    def notes(self) -> list[str]:
        """What is odd about the recording and its rig, and how it was understood, a line each."""
        return [*self.recording.notes, *self._assembler.notes, *self.calibration_changes]

    @property
    def statistics(self) -> SynchronizerStatistics:
        """Counts of the images so far: matched, queued, dropped."""
        return self._synchroniser.statistics()

    def sets(
        self, start: int | None = None, stop: int | None = None, handlers: Handlers | None = None
    ) -> Iterator[SurroundSet[RecordedImage]]:
        """Yield the sets of the messages with start <= log_time < stop (ns), in order.

        `handlers` are given the messages of further topics in between, at their time; topics that are not in the
        recording are passed over.
        """
        cameras = self.layout.views_by_image
        infos = {camera.camera_info_topic for camera in self.layout.cameras}
        handlers = handlers or {}
        topics = {*cameras, *infos, *handlers} & self.recording.topics.keys()
        for message in self.recording.messages(topics, start, stop):
            if message.topic in cameras:
                yield from self._add_image(cameras[message.topic], message)
            if message.topic in infos:
                self._add_camera_info(message)
            if message.topic in handlers:
                handlers[message.topic](message)
        yield from self._synchroniser.flush()

    def why_no_set(self, start: int | None = None, stop: int | None = None) -> str:
        """Return why `sets` yielded none: which cameras are silent, or too far apart for the tolerance."""
        silent = [name for name, camera in self.statistics.cameras.items() if not camera.received]
        if silent:
            return f"no image of camera {', '.join(silent)}"
        offsets = self._firing_offsets(start, stop)
        first, last = min(offsets, key=offsets.__getitem__), max(offsets, key=offsets.__getitem__)
        apart = offsets[last] - offsets[first]
        return f"images of {first} and {last} are {apart:.3f} s apart, the tolerance is {self._tolerance:g} s"

    def _firing_offsets(self, start: int | None, stop: int | None) -> dict[str, float]:
        """Median seconds by which each camera's nearest image is later than the anchor's, stamp offsets subtracted."""
        cameras = self.layout.views_by_image
        offsets_ns = {camera.name: camera.stamp_offset_ns for camera in self.layout.cameras}
        stamps: dict[str, list[float]] = {name: [] for name in self.layout.names}
        for message in islice(self.recording.messages(cameras, start, stop), _IMAGES_TO_EXPLAIN):
            with suppress(RecordingError):
                stamp = stamp_ns(self.recording.deserialize(message))
                for camera in cameras[message.topic]:
                    stamps[camera].append(exposure_times(stamp, offsets_ns[camera]) / NANOSECONDS)
        anchor = np.array(stamps[self.layout.anchor_camera])
        return {name: _median_distance(anchor, np.array(found)) for name, found in stamps.items()}

    def _add_image(self, cameras: Sequence[str], message: RecordedMessage) -> Iterator[SurroundSet[RecordedImage]]:
        """Add an image for each of the cameras that are views of its lens."""
        try:
            image = self.recording.deserialize(message)
        except RecordingError as error:
            self.unreadable.add(f"camera {', '.join(cameras)}: {error}")
            return
        for camera in cameras:
            yield from self._synchroniser.add(camera, stamp_ns(image), RecordedImage(image, message.log_time))

    def _add_camera_info(self, message: RecordedMessage) -> None:
        try:
            info = self.recording.deserialize(message)
        except RecordingError as error:
            self.unreadable.add(str(error))
            return
        if self._says_nothing_new(message.topic, info):
            return
        if self._assembler.add_camera_info_on(message.topic, info):
            try:
                self._rig = self._assembler.rig()
            except RigError as error:
                self._rig = error

    def _says_nothing_new(self, topic: str, info: Any) -> bool:
        """Say whether a CameraInfo is as the last one, or invalid where the recording's own calibration is used."""
        content = content_of(info)
        if self._last_infos.get(topic) == content:
            return True
        self._last_infos[topic] = content
        cameras = {camera.name for camera in self.layout.cameras if camera.camera_info_topic == topic}
        return cameras <= self._recalibrated and not is_usable(info)


class DepthReplay:
    """Estimates every set of a replay. A set that cannot be estimated is left out and counted in `refused`."""

    def __init__(
        self,
        replay: SurroundReplay,
        estimator: DepthPredictor,
        latencies: StageLatencies | None = None,
        settings: ModelSettings | None = None,
        wants_confidence: bool = False,
        wants_poses: bool = False,
    ) -> None:
        """Prepare for the replay's rig; RigError names a mask that does not fit.

        `settings` say whether depth is refined (None: it is not); without, confidence may be wanted all the same, or
        where the vehicle was at the exposures.
        """
        self._wants_poses = wants_poses
        self.refused = Refusals()
        self.latencies = latencies or StageLatencies()
        self.estimator = estimator
        self._replay = replay
        self._surround = SurroundDepthEstimator(replay.rig, estimator)
        settings = settings or ModelSettings.model_validate({"refine": "off"})
        is_compared = wants_confidence or settings.refine != "off"
        self._motion = motion = RecordedSetMotion.of(replay.recorded) if is_compared or wants_poses else None
        self.refinement = RefinementStage(
            settings,
            motion.poses_at if motion else lambda _: None,
            lambda: wants_confidence,
            self.latencies,
            knows_motion=lambda: motion is not None,
            wants_poses=wants_poses,
        )

    def sets(
        self,
        start: int | None = None,
        stop: int | None = None,
        handlers: Handlers | None = None,
        stamp_ns: int | None = None,
    ) -> Iterator[EstimatedSet[RecordedImage]]:
        """Yield the sets of `SurroundReplay.sets` with their depth; with a stamp, the set of that stamp only.

        Those before it are estimated all the same where its depth is refined with them.
        """
        for surround_set in self._replay.sets(start, stop, handlers):
            is_wanted = stamp_ns in (None, surround_set.stamp_ns)
            if not is_wanted and not self.refinement.is_active:
                continue
            try:
                surround = self._current_surround()
                messages = {name: image.message for name, image in surround_set.images.items()}
                result = estimate_set(messages, surround, self.latencies, self._replay.required)
                estimated = self._finished(surround, surround_set, result)
            except CvcDepthError as error:
                self.refused.add(f"set at {surround_set.stamp_ns} ns: {error}")
            else:
                if is_wanted:
                    yield estimated

    def why_no_set(self, start: int | None = None, stop: int | None = None) -> str:
        """Return why `sets` yielded none: what was refused, else `SurroundReplay.why_no_set`."""
        for refusals in (self.refused, self._replay.unreadable):
            if refusals.count:
                return str(refusals)
        return self._replay.why_no_set(start, stop)

    @property
    def surround(self) -> SurroundDepthEstimator:
        """What estimated the last set."""
        return self._surround

    def _finished(
        self, surround: SurroundDepthEstimator, surround_set: SurroundSet[RecordedImage], result: SurroundDepth
    ) -> EstimatedSet[RecordedImage]:
        if self._motion is not None and (self._wants_poses or self.refinement.is_active):
            with self.latencies.measure("motion"):
                self._motion.read_to(max(image.log_time for image in surround_set.images.values()))
        return self.refinement.finished(surround, surround_set, result)

    def _current_surround(self) -> SurroundDepthEstimator:
        if self._surround.rig is not self._replay.rig:
            self._surround = SurroundDepthEstimator(self._replay.rig, self.estimator, self._surround)
        return self._surround


def _median_distance(anchor: NDArray[np.float64], stamps: NDArray[np.float64]) -> float:
    """Median over the anchor's stamps [n] of the signed distance to the nearest of `stamps` [m].

    As for the synchroniser, a later stamp counts its distance 1.25 times.
    """
    if not anchor.size or not stamps.size:
        return math.inf
    distances = stamps[None, :] - anchor[:, None]
    nearest = np.where(distances > 0, 1.25 * distances, -distances).argmin(axis=1)
    return float(np.median(np.take_along_axis(distances, nearest[:, None], axis=1)))
