# SPDX-License-Identifier: Apache-2.0
"""A recording of depth: the topics that the node would have published, and transforms to show them. No ROS here."""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.poses import Pose
from cvcdepth_ros.bags import RecordedMessage, RecordingWriter
from cvcdepth_ros.messages.conversion import bag_message_factory
from cvcdepth_ros.messages.point_clouds import POINT_CLOUD_TYPE
from cvcdepth_ros.messages.transform_topics import moving_transform_topics
from cvcdepth_ros.messages.transforms import TransformTree, frame_name
from cvcdepth_ros.recordings.fixed_frames import MOVING_TRANSFORMS, TRANSFORM_TYPE
from cvcdepth_ros.recordings.replay import Handlers, RecordedImage, SurroundReplay
from cvcdepth_ros.recordings.rig_messages import STATIC_TRANSFORMS
from cvcdepth_ros.settings import OutputSettings
from cvcdepth_ros.surround_sets.output_messages import (
    CONFIDENCE,
    GROUND,
    MERGED_CAMERAS,
    MERGED_CLOUD,
    OBSTACLES,
    SCAN,
    OutputLimits,
    SurroundMessages,
    output_types,
)
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet

CloudChoice = Literal["merged", "all", "none"]

_NODE = "/surround_depth"
_SAME_POSE = 1e-6  # metres, and elements of the rotation


class DepthRecorder:
    """Writes a new rosbag2 folder with the depth of a replayed recording; use it as a context manager.

    Every message has the log time of the image that it was computed from, so that both recordings can be shown
    together.
    """

    def __init__(
        self,
        path: Path,
        replay: SurroundReplay,
        settings: OutputSettings,
        clouds: CloudChoice,
        start: int,
        has_confidence: bool = False,
        obstacles: bool = False,
    ) -> None:
        """Create the folder, announce the topics and write the fixed transforms at the log time `start` (ns).

        Raises RecordingError when the folder exists already, and TransformError when the rig file's poses
        contradict the recording's frames.
        """
        self._replay = replay
        self._settings = settings
        self._messages = SurroundMessages(
            bag_message_factory(), settings.depth_encoding, settings.depth_min_confidence, settings.sky
        )
        types = output_types(replay.layout.names)
        self._topics = {
            topic: type_
            for topic, type_ in types.items()
            if _is_wanted(topic, type_, clouds, obstacles) and (has_confidence or not topic.endswith(CONFIDENCE))
        }
        static_transforms = self._static_transforms(start)
        self._writer = RecordingWriter(path)
        for topic, type_ in self._topics.items():
            self._writer.add_topic(f"{_NODE}/{topic}", type_)
        self._writer.add_topic(STATIC_TRANSFORMS, TRANSFORM_TYPE)
        self._writer.write(STATIC_TRANSFORMS, start, static_transforms)
        self.handlers = self._moving_transforms()
        """Handlers for the replayed recording's other topics: `/tf` is copied."""

    def __enter__(self) -> "DepthRecorder":
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(self, estimated: EstimatedSet[RecordedImage]) -> None:
        """Write one set."""
        limits, frame_ids = OutputLimits.of(self._settings), self._replay.frame_ids
        for output in self._messages.of_set(estimated, frame_ids, limits, self._topics.__contains__):
            log_time = estimated.surround_set.images[output.camera].log_time
            self._writer.write(f"{_NODE}/{output.topic}", log_time, output.message)

    def _moving_transforms(self) -> Handlers:
        recording = self._replay.recording
        topics = moving_transform_topics(recording)
        if not topics:
            return {}
        self._writer.add_topic(MOVING_TRANSFORMS, TRANSFORM_TYPE, recording.topics[topics[0]].qos or ())
        return dict.fromkeys(topics, self._copy)

    def _copy(self, message: RecordedMessage) -> None:
        self._writer.write(MOVING_TRANSFORMS, message.log_time, message.cdr)

    def _static_transforms(self, log_time: int) -> Any:
        """Join all fixed transforms to one message: of a latched topic, players and viewers keep the last alone."""
        links = dict(self._replay.recorded.static_links)
        given = bag_message_factory().static_transforms(log_time, self._replay.layout.base_frame, self._given_poses())
        for link in given.transforms:
            links[frame_name(link.child_frame_id)] = link
        given.transforms = list(links.values())
        TransformTree().add_message(given)  # refuses what is no tree
        return given

    def _given_poses(self) -> dict[str, Pose]:
        """Return the rig file's camera poses that the recording lacks or contradicts, by frame."""
        frame_ids, base_frame = self._replay.frame_ids, self._replay.layout.base_frame
        poses = {frame_ids[camera.name]: camera.base_T_camera for camera in self._replay.rig.cameras}
        return {frame: pose for frame, pose in poses.items() if not self._is_recorded(base_frame, frame, pose)}

    def _is_recorded(self, base_frame: str, frame: str, pose: Pose) -> bool:
        try:
            return np.allclose(self._replay.recorded.transforms.lookup(base_frame, frame), pose, atol=_SAME_POSE)
        except TransformError:
            return False


def _is_wanted(topic: str, type_: str, clouds: CloudChoice, obstacles: bool) -> bool:
    if topic in (OBSTACLES, GROUND, SCAN):
        return obstacles
    if topic in (MERGED_CLOUD, MERGED_CAMERAS):
        return clouds != "none"
    return type_ != POINT_CLOUD_TYPE or clouds == "all"
