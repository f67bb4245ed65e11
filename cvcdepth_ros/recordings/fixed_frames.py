# SPDX-License-Identifier: Apache-2.0
"""Sensors whose fixed poses are on `/tf`, published repeatedly, as in recordings made from nuScenes. No ROS here."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.poses import Pose, inverse, quaternion_from_rotation
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags import RecordedMessage, Recording
from cvcdepth_ros.messages.recorded_changes import is_quickly_read
from cvcdepth_ros.messages.transform_topics import moving_transform_topics
from cvcdepth_ros.messages.transforms import TransformTree, frame_name, links_of

MOVING_TRANSFORMS = "/tf"
TRANSFORM_TYPE = "tf2_msgs/msg/TFMessage"

# Of a recording that is hours long, or on another machine's disk, so many single seconds, spread over it, are examined.
_SECONDS_EXAMINED = 20
# Noise of rounding, and no more: a camera on a sprung cab or a turning head moves by centimetres or degrees.
_FIXED_METRES, _FIXED_RADIANS = 1e-3, 1e-3


@dataclass
class ObservedLink:
    """One link of `/tf`, and how far it moves over the recording."""

    parent: str
    child: str
    parent_T_child: Pose
    """[4, 4] as it was published first."""
    metres: float = 0.0
    """The greatest distance from that pose."""
    radians: float = 0.0
    """The greatest rotation from that pose."""
    other_parent: str | None = None
    """A second parent that was published for the same child."""

    def observe(self, parent: str, parent_T_child: Pose) -> None:
        """Compare with a pose that was published later."""
        if parent != self.parent:
            self.other_parent = parent
            return
        change = inverse(self.parent_T_child) @ parent_T_child
        self.metres = max(self.metres, float(np.linalg.norm(change[:3, 3])))
        sine = float(np.linalg.norm(quaternion_from_rotation(change[:3, :3])[:3]))
        self.radians = max(self.radians, 2 * math.asin(min(1.0, sine)))

    def problem(self) -> str | None:
        """Return why it is not fixed; None when it is."""
        if self.other_parent is not None:
            return f"frame '{self.child}' has two parents, '{self.parent}' and '{self.other_parent}'"
        if self.metres > _FIXED_METRES or self.radians > _FIXED_RADIANS:
            by = f"{self.metres:.3f} m and {math.degrees(self.radians):.2f} degrees"
            return f"{self.parent} <- {self.child} moves during the recording, by up to {by}"
        return None


def has_transforms(recording: Recording, topic: str) -> bool:
    """Whether the topic is recorded and carries transforms."""
    return topic in recording.topics and recording.topics[topic].type == TRANSFORM_TYPE


def observed_links(recording: Recording) -> dict[str, ObservedLink]:
    """Return the links of `/tf` by child. Raises TransformError for an impossible pose."""
    links: dict[str, ObservedLink] = {}
    for message in _spread_messages(recording):
        for _, parent, child, parent_T_child in links_of(recording.deserialize(message)):
            if child in links:
                links[child].observe(parent, parent_T_child)
            else:
                links[child] = ObservedLink(parent, child, parent_T_child)
    return links


def add_fixed_frames(
    tree: TransformTree, links: Mapping[str, ObservedLink], base_frame: str, frames: Iterable[str]
) -> list[str]:
    """Add the links between `frames` and the base frame to the tree; return the frames that are connected now.

    Raises TransformError naming the link when one is not the same over the whole recording: what moves is no sensor of
    a rig.
    """
    fixed = set(tree.ancestors(base_frame))
    connected = []
    for frame in frames:
        chain = _chain(tree, links, frame_name(frame), fixed)
        connected += [frame] if chain else []
        for link in chain:
            problem = link.problem()
            if problem is not None:
                raise TransformError(
                    f"{MOVING_TRANSFORMS}: {problem}; '{frame}' must be fixed to '{base_frame}', or its pose be given "
                    "in a rig file"
                )
            tree.add(link.parent, link.child, link.parent_T_child)
    return connected


def _chain(tree: TransformTree, links: Mapping[str, ObservedLink], frame: str, fixed: set[str]) -> list[ObservedLink]:
    """Return the links that lead from the frame up to one of the `fixed` ones; none where they do not get there."""
    found: list[ObservedLink] = []
    while True:
        known = tree.ancestors(frame)
        if fixed & set(known):
            return found
        link = links.get(known[-1])
        if link is None or link in found:
            return []
        found.append(link)
        frame = link.parent


def _spread_messages(recording: Recording) -> Iterator[RecordedMessage]:
    topics = moving_transform_topics(recording)
    duration = recording.end + 1 - recording.start
    if duration <= _SECONDS_EXAMINED * NANOSECONDS or is_quickly_read(recording):
        yield from recording.messages(topics)
        return
    for number in range(_SECONDS_EXAMINED):
        start = recording.start + (duration - NANOSECONDS) * number // (_SECONDS_EXAMINED - 1)
        yield from recording.messages(topics, start, start + NANOSECONDS)
