# SPDX-License-Identifier: Apache-2.0
"""How high the ground lies in the base frame of a recording: as the rig file says, else as the recording shows it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.ground import is_on_ground, unstated_ground
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.ground_height import GroundEstimate, GroundFromSweeps
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags import Recording
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.recordings.ground_pictures import ground_by_pictures
from cvcdepth_ros.recordings.lidar import LidarSweep, read_sweep
from cvcdepth_ros.recordings.refusals import Refusals
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.rig_messages import cloud_topics
from cvcdepth_ros.settings import MatchingSettings

_MOMENTS = 8  # spread over the recording
_SWEEP_WITHIN_NS = NANOSECONDS  # of a moment


@dataclass(frozen=True)
class RecordedGround:
    """Where the ground is, and who says so."""

    height: float
    """Metres in the base frame."""
    source: Literal["stated", "lidar", "pictures", "convention", "assumed"]
    """stated: by the rig file; convention: the frame lies on the ground by its name; assumed: by nobody, so 0."""
    base_frame: str
    estimate: GroundEstimate | None = None
    """None where it was not looked for, or not found."""
    why_not: str = ""
    """Why it was not found, where it was looked for."""

    @property
    def is_assumed(self) -> bool:
        """Whether nobody knows it."""
        return self.source == "assumed"

    @property
    def told(self) -> str:
        """One line for people, the remedy with it where nobody knows it."""
        if self.is_assumed:
            return unstated_ground(self.base_frame, self.why_not)
        unmeasured = "as REP 105 says" if self.source == "convention" else "as stated"
        how = self.estimate.describes if self.estimate else unmeasured
        return f"ground at {self.height:.2f} m in {self.base_frame}: {how}"

    def to_json(self) -> dict[str, Any]:
        """Return the content with JSON's types."""
        estimate = None if self.estimate is None else asdict(self.estimate)
        return {
            "height": self.height,
            "source": self.source,
            "base_frame": self.base_frame,
            "estimate": estimate,
            "why_not_found": self.why_not or None,
            "told": self.told,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> RecordedGround:
        """Undo `to_json`; KeyError or TypeError where the content is another."""
        estimate = None if content["estimate"] is None else GroundEstimate(**content["estimate"])
        told = content["height"], content["source"], content["base_frame"]
        return cls(*told, estimate, content["why_not_found"] or "")


def recorded_ground(
    recorded: RecordedRig, lidar: Sequence[str] | None = None, *, with_pictures: bool = True
) -> RecordedGround:
    """Return where the ground is: as the layout states, else as LiDAR sweeps or else pictures show it, else 0.

    `lidar` names the topics; None: `RecordedRig.lidars`. Pictures cost seconds, and are left out on request.
    """
    layout = recorded.layout
    if layout.ground_height is not None:
        return RecordedGround(layout.ground_height, "stated", layout.base_frame)
    try:
        found = estimated_ground(recorded, lidar, with_pictures=with_pictures)
    except RigError as error:
        source: Literal["convention", "assumed"] = "convention" if is_on_ground(layout.base_frame) else "assumed"
        return RecordedGround(0.0, source, layout.base_frame, why_not=str(error))
    return RecordedGround(round(found.height, 3), found.source, layout.base_frame, found)


def with_ground(
    recorded: RecordedRig,
    lidar: Sequence[str] | None = None,
    height: float | None = None,
    *,
    with_pictures: bool = True,
) -> tuple[RecordedRig, RecordedGround]:
    """Return the rig with the ground's height in its layout, where it is known, and where that is from.

    `height` goes before all others; for the rest see `recorded_ground`.
    """
    if height is not None:
        recorded = _at(recorded, height)
    ground = recorded_ground(recorded, lidar, with_pictures=with_pictures)
    return recorded if ground.estimate is None else _at(recorded, ground.height), ground


def _at(recorded: RecordedRig, height: float) -> RecordedRig:
    return recorded.with_layout(recorded.layout.model_copy(update={"ground_height": height}))


def estimated_ground(
    recorded: RecordedRig, lidar: Sequence[str] | None = None, *, with_pictures: bool = True
) -> GroundEstimate:
    """Return the ground as the recording shows it, whatever the layout states; RigError says why it does not."""
    topics = recorded.lidars if lidar is None else tuple(lidar)
    try:
        return ground_by_lidar(recorded.recording, recorded.assembler().rig(), topics, recorded.transforms)
    except RigError as error:
        if not with_pictures:
            raise
        reason = error
    try:
        return ground_by_pictures(recorded, MatchingSettings())
    except RigError as error:
        raise RigError(f"{reason}; {error}") from error


def ground_by_lidar(recording: Recording, rig: Rig, topics: Sequence[str], transforms: TransformTree) -> GroundEstimate:
    """Return the ground that some sweeps of these LiDARs show; RigError says why they do not."""
    recorded = [topic for topic in topics if topic in cloud_topics(recording)]
    if not recorded:
        raise RigError("no LiDAR")
    search, refused = GroundFromSweeps(rig), Refusals()
    for sweep in _sweeps(recording, recorded, rig.base_frame, transforms, refused):
        pose = sweep.base_T_lidar
        search.add(sweep.points @ pose[:3, :3].T + pose[:3, 3], pose[:3, 3])
    if not search.sweeps:
        raise RigError(str(refused) if refused.count else "no LiDAR sweep")
    return search.estimate()


def _sweeps(
    recording: Recording, topics: Sequence[str], base_frame: str, transforms: TransformTree, refused: Refusals
) -> Iterator[LidarSweep]:
    """Yield one sweep of each LiDAR at a few moments of the recording; those that cannot be used are `refused`."""
    yielded: set[tuple[str, int]] = set()
    for start in _moments(recording):
        for topic in topics:
            message = next(iter(recording.messages([topic], start, start + _SWEEP_WITHIN_NS)), None)
            if message is None or (topic, message.log_time) in yielded:
                continue
            yielded.add((topic, message.log_time))
            with refused.instead_of_errors():
                yield read_sweep(topic, recording.deserialize(message), base_frame, transforms)


def _moments(recording: Recording) -> list[int]:
    """Return log times in the middle of equal parts of a recording, ns."""
    shares = (np.arange(_MOMENTS) + 0.5) / _MOMENTS
    moments: list[int] = (recording.start + shares * (recording.end - recording.start)).astype(np.int64).tolist()
    return moments
