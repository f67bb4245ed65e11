# SPDX-License-Identifier: Apache-2.0
"""What is in a recording for training: its surround sets and where the vehicle was at each exposure. No ROS here.

An index is built in one pass and kept beside the run; it is built anew when a file of the recording changes.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import CvcDepthError, ImageError, RecordingError, RigError, TransformError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.rig.rig import RigLayout
from cvcdepth_ros.bags import Location, RecordedMessage, Recording, file_identities, open_recording
from cvcdepth_ros.messages.conversion import picture_from_message
from cvcdepth_ros.recordings.lidar import VehicleMotion
from cvcdepth_ros.recordings.replay import RecordedImage, Refusals, SurroundReplay
from cvcdepth_ros.recordings.rig import assemble_rig, discover_rig, topics_without_images
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

_FORMAT = 2
_THUMBNAIL = (40, 24)


@dataclass(frozen=True, eq=False)
class RecordingIndex:
    """The S surround sets of one recording, in time order; N cameras in the rig's order."""

    path: Location
    layout: RigLayout
    """The rig, complete."""
    stamps: NDArray[np.int64]
    """[S, N] each image's own stamp, ns: by which its message is told from others."""
    log_times: NDArray[np.int64]
    """[S, N] when each image was recorded, ns: where it is found again."""
    poses: NDArray[np.float64] | None
    """[S, N, 4, 4] world_T_base at each camera's exposure; None where the recording tells no motion."""
    thumbnails: NDArray[np.uint8] | None
    """[S, h, w] small grey pictures of the anchor camera, to see motion by where none is recorded."""
    unplaced: int = 0
    """Sets left out since the recorded motion does not reach them."""
    unread: tuple[str, ...] = ()
    """What of the recording could not be read or used, in words."""

    @property
    def times(self) -> NDArray[np.int64]:
        """[S, N] when each image was taken, ns: its stamp without its camera's offset."""
        offsets = np.array([camera.stamp_offset_ns for camera in self.layout.cameras], dtype=np.int64)
        times: NDArray[np.int64] = self.stamps - offsets
        return times

    @property
    def losses(self) -> list[str]:
        """What of the recording is not there to learn from, in words."""
        outside = [f"{self.unplaced} sets lie outside of the recorded motion"] if self.unplaced else []
        return [*self.unread, *outside]

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def anchor(self) -> int:
        """Index of the anchor camera."""
        return self.layout.names.index(self.layout.anchor_camera)


def load_index(
    path: Location, directory: Path, matching: MatchingSettings, rig_layout: RigLayout | None = None
) -> RecordingIndex:
    """Return the index of the recording at `path`, from `directory` when a current one is there, else built and kept.

    `rig_layout` names cameras and what the recording does not tell; without it the cameras are found. Raises
    RecordingError, RigError or TransformError, naming the recording, when it has no sets or no complete rig.
    """
    key = _key(path, matching, rig_layout)
    cached = directory / f"{path.name}-{hashlib.sha256(str(path).encode()).hexdigest()[:8]}.npz"
    index = _read(cached, path, key)
    if index is None:
        index = build_index(path, matching, rig_layout)
        directory.mkdir(parents=True, exist_ok=True)
        _write(cached, index, key)
    return index


def build_index(path: Location, matching: MatchingSettings, rig_layout: RigLayout | None = None) -> RecordingIndex:
    """Read the whole recording once; see `load_index`."""
    with open_recording(path) as recording:
        layout = _complete_layout(recording, rig_layout)
        replay = SurroundReplay(recording, layout, matching)
        motion = VehicleMotion.find(recording, layout.base_frame, replay.transforms)
        refused = Refusals()
        sets, thumbnails = _collect(recording, replay, motion, refused)
        if replay.calibration_changes:
            change = replay.calibration_changes[0]
            raise RigError(f"{path}: {change}; take the parts before and after as two recordings")
        if not sets:
            raise RecordingError(f"{path}: no surround set: {replay.why_no_set()}")
        unread = tuple(_unread(recording, replay, refused, len(sets)))
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
        unplaced=len(sets) - len(placed),
        unread=unread,
    )


def _unread(recording: Recording, replay: SurroundReplay, refused: Refusals, sets: int) -> Iterator[str]:
    """Say what of a recording that was read to its end, and gave so many sets, could not be read or used."""
    if recording.damage:
        yield f"not everything could be read: {recording.damage}"
    yield from (str(found) for found in (replay.unreadable, refused) if found.count)
    if undecodable := replay.statistics.sets - sets:
        yield f"{undecodable} sets are left out: no picture of camera {replay.layout.anchor_camera} could be decoded"


def _complete_layout(recording: Recording, layout: RigLayout | None) -> RigLayout:
    if layout is not None:
        complete = assemble_rig(recording, layout).completed_layout()
    else:
        _refuse_blind_cameras(recording)
        complete = discover_rig(recording)
    neighbours = complete.complete().neighbours
    lonely = [name for name, others in neighbours.items() if not others]
    if lonely:
        raise RigError(
            f"{recording.path}: camera {', '.join(lonely)}: shares no view with another camera, so there is no overlap "
            "to learn metric depth from; `bag_replay rig` shows the overlaps"
        )
    return complete


def _refuse_blind_cameras(recording: Recording) -> None:
    for topic in topics_without_images(recording):
        raise RecordingError(
            f"{recording.path}: {topic} is recorded, but no image; a rig file without this camera leaves it out"
        )


def _collect(
    recording: Recording, replay: SurroundReplay, motion: VehicleMotion | None, refused: Refusals
) -> tuple[list[SurroundSet[int]], list[NDArray[np.uint8]]]:
    """Return the sets with the images' log times, and thumbnails when there is no `motion` to fill meanwhile.

    Messages that tell no motion are added to `refused`.
    """

    def add_motion(message: RecordedMessage) -> None:
        try:
            if motion is not None:
                motion.add(recording.deserialize(message))
        except CvcDepthError as error:
            refused.add(str(error))

    handlers = {} if motion is None else {motion.topic: add_motion}
    sets, thumbnails = [], []
    for found in replay.sets(handlers=handlers):
        if motion is None:
            thumbnail = _thumbnail(found, replay.layout.anchor_camera)
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


def _thumbnail(found: SurroundSet[RecordedImage], camera: str) -> NDArray[np.uint8] | None:
    try:
        picture = picture_from_message(found.images[camera].message, camera)
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


def _table(sets: list[SurroundSet[int]], kept: list[int], row: Any) -> NDArray[np.int64]:
    return np.array([row(sets[i]) for i in kept], dtype=np.int64).reshape(len(kept), -1)


def _key(path: Location, matching: MatchingSettings, layout: RigLayout | None) -> str:
    """Everything that an index depends on."""
    return json.dumps(
        {
            "format": _FORMAT,
            "files": file_identities(path),
            "matching": matching.model_dump(),
            "rig": None if layout is None else layout.model_dump(mode="json"),
        }
    )


def _write(cached: Path, index: RecordingIndex, key: str) -> None:
    arrays = {name: getattr(index, name) for name in ("stamps", "log_times", "poses", "thumbnails")}
    content = io.BytesIO()
    np.savez_compressed(
        content,
        key=np.array(key),
        layout=np.array(index.layout.model_dump_json()),
        unplaced=np.array(index.unplaced),
        unread=np.array(json.dumps(index.unread)),
        **{name: array for name, array in arrays.items() if array is not None},
    )
    write_atomically(cached, content.getvalue())


def _read(cached: Path, path: Location, key: str) -> RecordingIndex | None:
    """Return what is kept in `cached` if it was built with the same `key`; None also when it cannot be read."""
    try:
        with np.load(cached, allow_pickle=False) as kept:
            if str(kept["key"]) != key:
                return None
            return RecordingIndex(
                path,
                RigLayout.model_validate_json(str(kept["layout"])),
                kept["stamps"],
                kept["log_times"],
                kept.get("poses"),
                kept.get("thumbnails"),
                int(kept["unplaced"]),
                tuple(json.loads(str(kept["unread"]))),
            )
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None
