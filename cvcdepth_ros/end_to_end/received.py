# SPDX-License-Identifier: Apache-2.0
"""The surround sets that were sent to a node, and those that its outputs make up."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.visualization import ColouredPoints
from cvcdepth_ros.bags import Recording, open_recording
from cvcdepth_ros.messages.conversion import picture_from_message, stamp_ns
from cvcdepth_ros.surround_sets.output_messages import DEPTH, DEPTH_INFO, MERGED_CLOUD, PICTURE, output_types
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet, SurroundSynchronizer

SentSet = SurroundSet[int]
"""A set as it was sent; its `images` are the log times (ns) of the recording's images."""


@dataclass(frozen=True)
class Output:
    """A topic that the node publishes."""

    topic: str
    type_name: str
    camera: str
    """The camera whose stamp its messages carry."""
    part: str
    """Its name below the camera's, or below the node's for the merged cloud."""


def node_outputs(node: str, cameras: Sequence[str], anchor: str) -> list[Output]:
    """Return the topics of the node called `node` of which one message each makes a set."""
    types = output_types(cameras)
    parts = [(camera, part, f"{camera}/{part}") for camera in cameras for part in (DEPTH, DEPTH_INFO, PICTURE)]
    parts.append((anchor, MERGED_CLOUD, MERGED_CLOUD))
    return [Output(f"{node}/{topic}", types[topic], camera, part) for camera, part, topic in parts]


def sent_sets(recording: Recording, layout: RigLayout, tolerance: float, sent: Mapping[str, int]) -> list[SentSet]:
    """Return the complete sets among the first `sent[topic]` images of each camera, matched without DDS or haste."""
    synchroniser: SurroundSynchronizer[int] = SurroundSynchronizer.from_layout(layout, tolerance)
    cameras = {camera.image_topic: camera.name for camera in layout.cameras}
    counts: Counter[str] = Counter()
    sets: list[SentSet] = []
    for message in recording.messages(cameras):
        counts[message.topic] += 1
        if counts[message.topic] <= sent.get(message.topic, 0):
            stamp = stamp_ns(recording.deserialize(message))
            sets += synchroniser.add(cameras[message.topic], stamp, message.log_time)
    return sets + synchroniser.flush()


@dataclass(frozen=True, eq=False)
class ReceivedSet:
    """A set of which every message arrived; arrays hold the cameras in the rig's order."""

    sent: SentSet
    pictures: NDArray[np.uint8]
    """[N, H, W, 3] RGB."""
    depth: NDArray[np.float32]
    """[N, H, W] metres, NaN where unknown."""
    cloud: ColouredPoints


class ReceivedSets:
    """The complete sets of a recorder's file, one after the other, in the order in which they became complete.

    A set is complete when every one of the node's outputs arrived with exactly the stamp of the set that was sent.
    """

    def __init__(self, path: Path, outputs: Sequence[Output], sets: Sequence[SentSet]) -> None:
        self._path = path
        self._outputs = {output.topic: output for output in outputs}
        self._set_of = {(output.topic, s.stamps_ns[output.camera]): s for s in sets for output in outputs}
        self.missing: dict[int, list[str]] = {}
        """After the iteration: the sets (by sequence) of which only a part arrived, and the topics of the rest."""
        self.foreign: Counter[str] = Counter()
        """After the iteration: messages by topic whose stamp belongs to no set that was sent."""

    def __iter__(self) -> Iterator[ReceivedSet]:
        waiting: dict[int, dict[Output, Any]] = {}
        with open_recording(self._path) as recording:
            for message in recording.messages(self._outputs.keys() & recording.topics.keys()):
                content, output = recording.deserialize(message), self._outputs[message.topic]
                sent = self._set_of.get((message.topic, stamp_ns(content)))
                if sent is None:
                    self.foreign[message.topic] += 1
                    continue
                parts = waiting.setdefault(sent.sequence, {})
                parts[output] = content
                if len(parts) == len(self._outputs):
                    yield _received_set(sent, waiting.pop(sent.sequence))
        everything = set(self._outputs.values())
        self.missing = {sequence: _topics(everything - parts.keys()) for sequence, parts in waiting.items()}


def _received_set(sent: SentSet, parts: Mapping[Output, Any]) -> ReceivedSet:
    of = {(output.part, output.camera): message for output, message in parts.items()}
    cloud = next(message for output, message in parts.items() if output.part == MERGED_CLOUD)
    return ReceivedSet(
        sent,
        pictures=np.stack([picture_from_message(of[PICTURE, camera], camera) for camera in sent.stamps_ns]),
        depth=np.stack([_depth(of[DEPTH, camera]) for camera in sent.stamps_ns]),
        cloud=_coloured_points(cloud),
    )


def _topics(outputs: Iterable[Output]) -> list[str]:
    return sorted(output.topic for output in outputs)


def _depth(message: Any) -> NDArray[np.float32]:
    """Return a 32FC1 image as metres [H, W]."""
    rows = np.frombuffer(message.data, dtype=np.uint8).reshape(message.height, message.step)
    order = ">" if message.is_bigendian else "<"
    return rows[:, : 4 * message.width].view(f"{order}f4").astype(np.float32)


def _coloured_points(message: Any) -> ColouredPoints:
    """Return the node's own cloud, which has x, y, z and rgb as four float32 and nothing else."""
    cloud = np.frombuffer(message.data, dtype=">f4" if message.is_bigendian else "<f4").reshape(-1, 4)
    packed = cloud[:, 3].astype(np.float32).view(np.uint32)
    rgb = np.stack([packed >> shift & 0xFF for shift in (16, 8, 0)], axis=-1).astype(np.uint8)
    return ColouredPoints(cloud[:, :3].astype(np.float32), rgb)
