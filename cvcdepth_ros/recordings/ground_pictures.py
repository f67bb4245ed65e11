# SPDX-License-Identifier: Apache-2.0
"""The ground of a recording by its pictures: of the same road, from two places of the moving vehicle or two cameras."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
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
_LEAST_TRAVEL, _MOST_TRAVEL = 0.4, 5.0  # metres between two pictures of a pair
_TOGETHER_NS = 5_000_000  # between shutters of neighbours that are compared: at 10 m/s 5 cm
_WIDTH = 640  # pixels


class _PlacedSet(NamedTuple):
    """A set, and the vehicle's pose at each camera's exposure, none where its motion is not known."""

    found: SurroundSet[RecordedImage]
    world_T_base: dict[str, Pose]


class _Moment(NamedTuple):
    """What is compared of a moment."""

    first: _PlacedSet | None
    second: _PlacedSet | None
    """From elsewhere; None where the vehicle stands, or its motion is not known."""


def ground_by_pictures(recorded: RecordedRig, matching: MatchingSettings) -> GroundEstimate:
    """Return the ground that the pictures show; RigError says why they do not.

    Pictures of one camera are compared along the recorded motion, and those of neighbours where their shutters are
    together, whatever the vehicle does.
    """
    whole = recorded.with_layout(recorded.layout.model_copy(update={"aspect": "stretch"}))  # all of each picture
    rig = whole.assembler().rig()
    road = _Road(rig)
    if not road.cameras:
        raise RigError("no camera sees the road ahead of the vehicle or behind it")
    search, moved, sets = GroundFromPictures(rig), 0, 0
    for start in _starts(recorded):
        pair = _pair(whole, matching, start)
        sets += pair.first is not None
        moved += pair.second is not None
        for first, second in road.views(pair):
            search.add(first, second)
    if not sets:
        raise RigError(f"no surround set at any of {_MOMENTS} moments")
    try:
        return search.estimate()
    except RigError as error:
        raise RigError(f"{error}{_without_motion(recorded, moved)}") from error


def _without_motion(recorded: RecordedRig, moved: int) -> str:
    if recorded.vehicle_motion() is None:
        return "; no motion is recorded, so that only neighbours that fire together could be compared"
    if moved < _MOMENTS // 2:
        told = f"; at {_MOMENTS - moved} of {_MOMENTS} moments the vehicle stands still, is too fast for the pictures"
        return f"{told}, or its motion is not known"
    return ""


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

    def views(self, pair: _Moment) -> Iterator[tuple[RoadView, RoadView]]:
        """Yield pairs of pictures with their places: each camera's along the way, and neighbours' at once."""
        first, second = pair
        if first is not None and second is not None:
            yield from self._along_the_way(first, second)
        elif first is not None:
            yield from self._between_neighbours(first.found)

    def _along_the_way(self, first: _PlacedSet, second: _PlacedSet) -> Iterator[tuple[RoadView, RoadView]]:
        """Yield both pictures of each camera that has them, in the base frame at its first exposure."""
        for i in self.cameras:
            camera = self._rig.cameras[i]
            first_T_second = inverse(first.world_T_base[camera.name]) @ second.world_T_base[camera.name]
            with suppress(ImageError):  # one damaged picture is one pair less
                yield (
                    self._view(i, self._picture(i, first.found), camera.base_T_camera),
                    self._view(i, self._picture(i, second.found), first_T_second @ camera.base_T_camera),
                )

    def _between_neighbours(self, found: SurroundSet[RecordedImage]) -> Iterator[tuple[RoadView, RoadView]]:
        for i, j in self._rig.neighbour_indices:
            names = self._rig.names[i], self._rig.names[j]
            if i not in self.cameras or not set(names) <= found.images.keys():
                continue
            if abs(found.times_ns[names[0]] - found.times_ns[names[1]]) <= _TOGETHER_NS:
                with suppress(ImageError):
                    yield self._own_view(i, found), self._own_view(j, found)

    def _own_view(self, index: int, found: SurroundSet[RecordedImage]) -> RoadView:
        return self._view(index, self._picture(index, found), self._rig.cameras[index].base_T_camera)

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


def _pair(recorded: RecordedRig, matching: MatchingSettings, start: int) -> _Moment:
    """Return the first set after a moment, and the next one that is far enough from it."""
    motion = RecordedSetMotion.of(recorded)
    first: _PlacedSet | None = None
    for found in SurroundReplay(recorded, matching).sets(start, start + _WITHIN_NS):
        placed = _placed(found, motion)
        if first is None:
            first = placed
        if motion is None:
            break
        travel = _travel(first, placed)
        if travel > _MOST_TRAVEL:
            break
        if travel >= _LEAST_TRAVEL:
            return _Moment(first, placed)
    return _Moment(first, None)


def _placed(found: SurroundSet[RecordedImage], motion: RecordedSetMotion | None) -> _PlacedSet:
    if motion is None:
        return _PlacedSet(found, {})
    motion.read_to(max(image.log_time for image in found.images.values()))
    return _PlacedSet(found, motion.poses_at(found.times_ns) or {})


def _travel(first: _PlacedSet, second: _PlacedSet) -> float:
    """Return the metres between two sets; 0 where they are not known."""
    if not first.world_T_base or not second.world_T_base:
        return 0.0
    anchor = first.found.anchor
    return float(np.linalg.norm(second.world_T_base[anchor][:3, 3] - first.world_T_base[anchor][:3, 3]))
