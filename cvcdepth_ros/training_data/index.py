# SPDX-License-Identifier: Apache-2.0
"""Index of a recording for training: its surround sets and the vehicle's pose at each exposure. No ROS here.

An index is built in one pass and kept beside the run; it is built anew when a file of the recording changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError, RecordingError, RigError, TransformError
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.stamps import exposure_times
from cvcdepth_ros.bags import Location, Recording, file_identities, open_recording
from cvcdepth_ros.kept import Arrays, KeptResults, Work, document_array, read_document
from cvcdepth_ros.messages.conversion import picture_from_message
from cvcdepth_ros.recordings.motion import VehicleMotion
from cvcdepth_ros.recordings.refusals import Refusals
from cvcdepth_ros.recordings.replay import RecordedImage, SurroundReplay
from cvcdepth_ros.recordings.rig import RecordedRig, topics_without_images
from cvcdepth_ros.recordings.truth import RecordedTruth
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

_FORMAT = 4
_THUMBNAIL = (40, 24)

ScaleSource = Literal["overlaps", "overlaps or motion", "nothing"]
"""What metric scale is to be learnt from: a recording without it is refused."""


@dataclass(frozen=True, eq=False)
class RecordingIndex:
    """The S surround sets of one recording, in time order; N cameras in the rig's order."""

    path: Location
    layout: RigLayout
    """The rig, complete."""
    stamps: NDArray[np.int64]
    """[S, N] each image's own stamp, ns: identifies its message."""
    log_times: NDArray[np.int64]
    """[S, N] when each image was recorded, ns: where it is found again."""
    poses: NDArray[np.float64] | None
    """[S, N, 4, 4] world_T_base at each camera's exposure; None where no motion is recorded."""
    thumbnails: NDArray[np.uint8] | None
    """[S, h, w] small grey pictures of the anchor camera, to measure change by where no motion is recorded."""
    without_motion: int = 0
    """Sets left out since they lie outside of the recorded motion."""
    motion_topic: str | None = None
    """Where the motion is recorded."""
    unread: tuple[str, ...] = ()
    """Descriptions of messages and sets that could not be read or used."""
    motion_problem: str = ""
    """Why recorded motion is not used, though there is some."""

    @property
    def times(self) -> NDArray[np.int64]:
        """[S, N] when each image was taken, ns: its stamp without its camera's offset."""
        offsets = np.array([camera.stamp_offset_ns for camera in self.layout.cameras], dtype=np.int64)
        return exposure_times(self.stamps, offsets)

    @property
    def losses(self) -> list[str]:
        """Descriptions of the parts of the recording that are missing from the index."""
        outside = [f"{self.without_motion} sets lie outside of the recorded motion"] if self.without_motion else []
        return [*self.unread, *outside]

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def anchor(self) -> int:
        """Index of the anchor camera."""
        return self.layout.names.index(self.layout.anchor_camera)


def load_index(
    path: Location,
    directory: Path,
    matching: MatchingSettings,
    rig_layout: RigLayout | None = None,
    base_frame: str = "base_link",
    scale_from: ScaleSource = "overlaps",
    with_motion: bool = True,
) -> RecordingIndex:
    """Return the index of the recording at `path`, from `directory` when a current one is there, else built and kept.

    `rig_layout` names cameras and what the recording lacks; without it the cameras are found, and `base_frame` is the
    vehicle's; `with_motion` False takes it for one without recorded motion. Raises RecordingError, RigError or
    TransformError, naming the recording, when it has no sets, no complete rig, or nothing to learn the scale from.
    """
    kept = KeptResults(directory, _to_arrays, partial(_from_arrays, path))
    return kept.load_or_make(
        str(path),
        {**_work(path, matching, rig_layout, base_frame), **({} if with_motion else {"motion": "not used"})},
        lambda: build_index(path, matching, rig_layout, base_frame, scale_from, with_motion),
    )


def build_index(
    path: Location,
    matching: MatchingSettings,
    rig_layout: RigLayout | None = None,
    base_frame: str = "base_link",
    scale_from: ScaleSource = "overlaps",
    with_motion: bool = True,
) -> RecordingIndex:
    """Return the index of the recording at `path`, read anew; see `load_index`."""
    with open_recording(path) as recording:
        if rig_layout is None:
            _refuse_blind_cameras(recording)
            recorded = RecordedRig.from_recording(recording, base_frame=base_frame)
        else:
            recorded = RecordedRig.from_recording(recording, rig_layout).completed()
        return index_recording(recorded, matching, scale_from, with_motion)


def index_recording(
    recorded: RecordedRig,
    matching: MatchingSettings,
    scale_from: ScaleSource = "overlaps",
    with_motion: bool = True,
) -> RecordingIndex:
    """Return the index of a rig's recording, which is read through; see `load_index`."""
    path, layout = recorded.recording.path, recorded.layout
    truth = RecordedTruth(recorded, lidar=())
    motion = truth.motion if with_motion else None
    if scale_from == "overlaps" or (scale_from == "overlaps or motion" and motion is None):
        _refuse_lonely_cameras(recorded)
    replay = SurroundReplay(recorded, matching)
    sets, thumbnails = _collect(replay, None if motion is None else truth)
    for change in replay.calibration_changes[:1]:
        raise RigError(f"{path}: {change}; take the parts before and after as two recordings")
    if not sets:
        raise RecordingError(f"{path}: no surround set: {replay.why_no_set()}")
    unread = tuple(_unread(replay, truth.refused, len(sets)))
    return index_of_sets(path, layout, sets, motion, thumbnails, unread)


def index_of_sets(
    path: Location,
    layout: RigLayout,
    sets: Sequence[SurroundSet[int]],
    motion: VehicleMotion | None,
    thumbnails: Sequence[NDArray[np.uint8]],
    unread: tuple[str, ...] = (),
) -> RecordingIndex:
    """Return the index of sets that hold their images' log times; thumbnails of each where no motion is recorded.

    Raises RecordingError where the motion reaches none of them.
    """
    poses = None if motion is None else [_poses(motion, surround_set) for surround_set in sets]
    placed = [i for i in range(len(sets)) if poses is None or poses[i] is not None]
    if not placed:
        raise RecordingError(f"{path}: none of its {len(sets)} surround sets lies within the recorded motion")
    return RecordingIndex(
        path=path,
        layout=layout,
        stamps=_table(sets, placed, lambda found: [found.stamps_ns[name] for name in layout.names]),
        log_times=_table(sets, placed, lambda found: [found.images[name] for name in layout.names]),
        poses=None if poses is None else np.array([poses[i] for i in placed]).reshape(-1, len(layout.names), 4, 4),
        thumbnails=np.stack(thumbnails) if motion is None else None,
        without_motion=len(sets) - len(placed),
        motion_topic=None if motion is None else motion.topic,
        unread=unread,
    )


def _unread(replay: SurroundReplay, refused: Refusals, sets: int) -> Iterator[str]:
    """Yield descriptions of what could not be read or used, after the replay's end and with so many sets left."""
    if replay.recording.damage:
        yield f"not everything could be read: {replay.recording.damage}"
    yield from (str(found) for found in (replay.unreadable, refused) if found.count)
    if undecodable := replay.statistics.sets - sets:
        yield f"{undecodable} sets are left out: no picture of camera {replay.layout.anchor_camera} could be decoded"


def _refuse_lonely_cameras(recorded: RecordedRig) -> None:
    neighbours = recorded.layout.complete().neighbours
    lonely = [
        " and ".join(views)
        for views in recorded.layout.views_by_image.values()
        if all(other in views for name in views for other in neighbours[name])
    ]
    if lonely:
        raise RigError(
            f"{recorded.recording.path}: camera {', '.join(lonely)}: shares no view with another camera, so there is "
            "no overlap to learn metric depth from; `cvcdepth rig` shows the overlaps. With recorded motion "
            "(recordings.motion: auto) the scale comes from the odometry"
        )


def _refuse_blind_cameras(recording: Recording) -> None:
    for topic in topics_without_images(recording):
        raise RecordingError(
            f"{recording.path}: {topic} is recorded, but no image; a rig file without this camera leaves it out"
        )


def _collect(
    replay: SurroundReplay, truth: RecordedTruth | None
) -> tuple[list[SurroundSet[int]], list[NDArray[np.uint8]]]:
    """Return the sets with the images' log times, and thumbnails where there is no `truth` to read motion along."""
    sets, thumbnails = [], []
    for found in replay.sets(handlers=None if truth is None else truth.handlers):
        if truth is None:
            anchor = replay.layout.anchor_camera
            thumbnail = thumbnail_of(found.images[anchor].message, anchor)
            if thumbnail is None:
                continue
            thumbnails.append(thumbnail)
        sets.append(_with_log_times(found))
    return sets, thumbnails


def _with_log_times(found: SurroundSet[RecordedImage]) -> SurroundSet[int]:
    images = {name: image.log_time for name, image in found.images.items()}
    return SurroundSet(
        found.sequence, found.anchor, found.stamp_ns, found.stamps_ns, found.times_ns, images, found.spread_ns
    )


def thumbnail_of(message: Any, camera: str) -> NDArray[np.uint8] | None:
    """Return a camera's image as `RecordingIndex.thumbnails` has it; None where it cannot be decoded."""
    try:
        picture = picture_from_message(message, camera)
    except ImageError:
        return None
    small: NDArray[np.uint8] = cv2.resize(
        cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), _THUMBNAIL, interpolation=cv2.INTER_AREA
    )
    return small


def _poses(motion: VehicleMotion, found: SurroundSet[int]) -> NDArray[np.float64] | None:
    try:
        return np.stack([motion.base_pose(time) for time in found.times_ns.values()])
    except TransformError:
        return None


def _table(sets: Sequence[SurroundSet[int]], kept: list[int], row: Any) -> NDArray[np.int64]:
    return np.array([row(sets[i]) for i in kept], dtype=np.int64).reshape(len(kept), -1)


def _work(path: Location, matching: MatchingSettings, layout: RigLayout | None, base_frame: str) -> Work:
    """Return everything that an index depends on."""
    return {
        "format": _FORMAT,
        "files": file_identities(path),
        "matching": matching.model_dump(),
        "rig": {"base_frame": base_frame} if layout is None else layout.model_dump(mode="json"),
    }


def _to_arrays(index: RecordingIndex) -> Arrays:
    described = {
        "layout": index.layout.model_dump_json(),
        "without_motion": index.without_motion,
        "motion_topic": index.motion_topic,
        "unread": index.unread,
    }
    arrays = {name: getattr(index, name) for name in ("stamps", "log_times", "poses", "thumbnails")}
    known = {name: array for name, array in arrays.items() if array is not None}
    return {"described": document_array(described), **known}


def _from_arrays(path: Location, arrays: Arrays) -> RecordingIndex:
    described = read_document(arrays["described"])
    return RecordingIndex(
        path,
        RigLayout.model_validate_json(described["layout"]),
        arrays["stamps"],
        arrays["log_times"],
        arrays.get("poses"),
        arrays.get("thumbnails"),
        described["without_motion"],
        described["motion_topic"],
        tuple(described["unread"]),
    )
