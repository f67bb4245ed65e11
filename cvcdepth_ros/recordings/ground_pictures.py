# SPDX-License-Identifier: Apache-2.0
"""The ground of a recording by its pictures: of the same road, taken from two places that recorded motion tells."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from cvcdepth_core.errors import ImageError, RigError
from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.rig.pinhole import PinholeView
from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.ground_height import GroundEstimate
from cvcdepth_core.rig_health.ground_pictures import GroundFromPictures, RoadView, shows_road
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.recordings.replay import RecordedImage, SurroundReplay
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.set_motion import RecordedSetMotion
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.surround_sets.set_estimation import EncodedImage
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

_MOMENTS = 10  # spread over the recording
_WITHIN_NS = 2 * NANOSECONDS  # of a moment
_LEAST_TRAVEL, _MOST_TRAVEL = 0.4, 3.0  # metres between two pictures of a pair
_WIDTH = 640  # pixels


class _PlacedSet(NamedTuple):
    """A set, and the vehicle's pose at each camera's exposure."""

    found: SurroundSet[RecordedImage]
    world_T_base: dict[str, Pose]


def ground_by_pictures(recorded: RecordedRig, matching: MatchingSettings) -> GroundEstimate:
    """Return the ground that the pictures show; RigError says why they do not."""
    if recorded.vehicle_motion() is None:
        raise RigError("no recorded motion, which pictures of the road need")
    whole = recorded.with_layout(recorded.layout.model_copy(update={"aspect": "stretch"}))  # all of each picture
    rig = whole.assembler().rig()
    road = _Road(rig)
    if not road.cameras:
        raise RigError("no camera sees the road ahead of the vehicle or behind it")
    search, standing = GroundFromPictures(rig), 0
    for start in _starts(recorded):
        pair = _pair(whole, matching, start)
        if pair is None:
            standing += 1
            continue
        for first, second in road.views(*pair):
            search.add(first, second)
    if standing > _MOMENTS // 2:
        raise RigError(
            f"at {standing} of {_MOMENTS} moments the vehicle stands still, or its motion or pictures are missing"
        )
    return search.estimate()


class _Road:
    """The cameras of a rig that see the road, and their pictures of it."""

    def __init__(self, rig: Rig) -> None:
        width, height = rig.cameras[0].calibration.image_size
        self._rig = rig
        self._preprocessor = SurroundPreprocessor(rig, round(_WIDTH * height / width), _WIDTH)
        blank = np.zeros((*self._preprocessor.valid.shape[1:], 3), np.uint8)
        self.cameras = [
            i for i in range(len(rig.cameras)) if shows_road(self._view(i, blank, rig.cameras[i].base_T_camera))
        ]

    def views(self, first: _PlacedSet, second: _PlacedSet) -> Iterator[tuple[RoadView, RoadView]]:
        """Yield both pictures of each camera that has them, in the base frame at its first exposure."""
        for i in self.cameras:
            camera = self._rig.cameras[i]
            first_T_second = inverse(first.world_T_base[camera.name]) @ second.world_T_base[camera.name]
            try:
                yield (
                    self._view(i, self._picture(i, first.found), camera.base_T_camera),
                    self._view(i, self._picture(i, second.found), first_T_second @ camera.base_T_camera),
                )
            except ImageError:  # one damaged picture is one pair less
                continue

    def _view(self, index: int, picture: Any, base_T_camera: Pose) -> RoadView:
        valid = self._preprocessor.valid[index]
        view = PinholeView(self._preprocessor.intrinsics[index], base_T_camera, *valid.shape)
        return RoadView(picture, valid, view)

    def _picture(self, index: int, found: SurroundSet[RecordedImage]) -> Any:
        name = self._rig.names[index]
        rectifier = self._preprocessor.rectifiers[name]
        return rectifier(EncodedImage(found.images[name].message).decoded(name, rectifier), name, rectifier.reduction)


def _starts(recorded: RecordedRig) -> list[int]:
    """Return log times spread over the recording, ns."""
    recording = recorded.recording
    last = max(recording.start, recording.end - _WITHIN_NS)
    starts: list[int] = np.linspace(recording.start, last, _MOMENTS).astype(np.int64).tolist()
    return starts


def _pair(recorded: RecordedRig, matching: MatchingSettings, start: int) -> tuple[_PlacedSet, _PlacedSet] | None:
    """Return the first set after a moment, and the next one that is far enough from it; None where there is none."""
    motion = RecordedSetMotion.of(recorded)
    first: _PlacedSet | None = None
    for found in SurroundReplay(recorded, matching).sets(start, start + _WITHIN_NS):
        poses = None
        if motion is not None:
            motion.read_to(max(image.log_time for image in found.images.values()))
            poses = motion.poses_at(found.times_ns)
        if poses is None:
            continue
        if first is None:
            first = _PlacedSet(found, poses)
            continue
        travel = _travel(first, poses, found.anchor)
        if travel > _MOST_TRAVEL:
            return None
        if travel >= _LEAST_TRAVEL:
            return first, _PlacedSet(found, poses)
    return None


def _travel(first: _PlacedSet, poses: dict[str, Pose], anchor: str) -> float:
    return float(np.linalg.norm(poses[anchor][:3, 3] - first.world_T_base[anchor][:3, 3]))
