# SPDX-License-Identifier: Apache-2.0
"""What a recording's own pictures say of its rig and its odometry: how cameras are turned, how the vehicle moves.

Depth for that is the network's, mended by earlier pictures of the same camera alone, so that it knows nothing of the
mounts that are judged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import RigError
from cvcdepth_core.estimator import DepthPredictor
from cvcdepth_core.files import nan_to_null
from cvcdepth_core.refinement.drive import DriveRefiner
from cvcdepth_core.refinement.mounts import MountSearch, RefinedMounts
from cvcdepth_core.refinement.settings import RefinementSettings
from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.recordings.replay import DepthReplay, RecordedImage, SurroundReplay
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.set_motion import RecordedSetMotion
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.surround_sets.refinement import moment_of
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet

Progress = Callable[[float], None]
"""Called with the share that is done."""

_FOR_MOUNTS = RefinementSettings(max_grid_width=320, use_neighbours=False)
_FOR_MOTION = RefinementSettings(use_neighbours=False, distances=())  # nothing is refined
_TRUSTED = 0.65  # confidence of depth that mounts are looked for with
_WARM_UP = 4  # sets of a part that only fill the history
_EVERY = 2  # of the others is searched


class Part(NamedTuple):
    """A part of a recording, log times in ns."""

    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class ComparedPictures:
    """What was found."""

    rig: Rig
    sets: int
    """That were looked at."""
    mounts: RefinedMounts
    odometry_problem: str
    """What is wrong with recorded motion; empty where it fits, or there is none."""
    has_odometry: bool
    has_judged_odometry: bool
    """Whether there were enough sets in a row to know whether it fits."""


class JudgedOdometry(NamedTuple):
    """What the pictures say of a recording's odometry."""

    problem: str
    """What is wrong with it; empty where it fits, or too little is known."""
    is_usable: bool
    """False where the pictures contradict it in more than its scale, which depth may have wrong."""


def parts_of(start: int, stop: int, count: int, seconds: float) -> list[Part]:
    """Return `count` parts of so many seconds, spread evenly over the time from start to stop (ns), or all of it."""
    length = round(seconds * NANOSECONDS)
    if stop - start <= count * length:
        return [Part(start, stop)]
    return [Part(begin, begin + length) for begin in np.linspace(start, stop - length, count).astype(int).tolist()]


def compare_pictures(
    recorded: RecordedRig,
    predictor: DepthPredictor,
    parts: list[Part],
    matching: MatchingSettings,
    progress: Progress = lambda _: None,
) -> ComparedPictures:
    """Look at the sets of these parts; RigError when there are too few."""
    rig = recorded.layout.complete()
    search = MountSearch(rig.neighbour_indices, rig.names.index(rig.anchor))
    problems: list[str] = []
    sets, is_judged = 0, False
    for number, part in enumerate(parts):
        found = _Compared(recorded, predictor, matching, _FOR_MOUNTS, search)
        sets += found.look_at(part)
        problems += [found.problem] if found.problem else []
        is_judged |= found.has_judged_odometry
        progress((number + 1) / len(parts))
    if sets <= _WARM_UP:
        raise RigError(
            f"{recorded.recording.path}: {sets} sets, more than {_WARM_UP} in a row are needed to compare pictures"
        )
    problem = problems[0] if problems else ""
    return ComparedPictures(rig, sets, search.result(), problem, recorded.vehicle_motion() is not None, is_judged)


def judge_odometry(
    recorded: RecordedRig, predictor: DepthPredictor, parts: list[Part], matching: MatchingSettings
) -> JudgedOdometry:
    """Compare recorded motion with the pictures of these parts, by the predictor's own depth."""
    problem, is_usable = "", True
    for part in parts:
        found = _Compared(recorded, predictor, matching, _FOR_MOTION)
        found.look_at(part)
        problem, is_usable = problem or found.problem, is_usable and not found.contradicts_odometry
    return JudgedOdometry(problem, is_usable)


def turned_layout(layout: RigLayout, mounts: RefinedMounts) -> RigLayout:
    """Return the layout, which is complete, with the mounts that were found; views of one lens turn together."""
    rig, poses = layout.complete(), dict[int, Pose]()
    for lens in rig.lenses:
        # The anchor keeps its mount, and with it the other views of its lens.
        judged = [i for i in lens if not np.isnan(mounts.turns[i]).any()]
        told = [i for i in judged if rig.names[i] == rig.anchor] or judged
        turn = _mean_turn([mounts.base_T_camera[i] @ inverse(rig.cameras[i].base_T_camera) for i in told])
        for i in lens:
            is_plain = len(lens) == 1 and layout.cameras[i].view is None
            poses[i] = mounts.base_T_camera[i] if is_plain else _turned(layout.cameras[i], turn)
    cameras = tuple(
        camera.model_copy(update={"base_T_camera": PoseEntry.from_matrix(poses[i])})
        for i, camera in enumerate(layout.cameras)
    )
    return layout.model_copy(update={"cameras": cameras})


def _mean_turn(motions: Sequence[Pose]) -> NDArray[np.float64]:
    """Return the rotation [3, 3] nearest to the mean of those of the poses (Moakher 2002); of none, no turn."""
    u, _, v = np.linalg.svd(np.mean([motion[:3, :3] for motion in motions] or [np.eye(3)], axis=0))
    turn: NDArray[np.float64] = u @ v
    return turn


def _turned(camera: CameraEntry, turn: NDArray[np.float64]) -> Pose:
    """Return the pose of a lens, of which the camera is a view, turned in its place."""
    if camera.base_T_camera is None:
        raise RigError(f"camera {camera.name}: no base_T_camera")
    pose = camera.base_T_camera.matrix(f"camera {camera.name}: base_T_camera")
    pose[:3, :3] = turn @ pose[:3, :3]
    return pose


def mounts_to_json(rig: Rig, mounts: RefinedMounts) -> dict[str, Any]:
    """Return what was found, with JSON's types, null for what is not known; angles are in degrees."""
    pairs = [
        {
            "camera": rig.names[pair.camera],
            "neighbour": rig.names[pair.neighbour],
            "patches": pair.patches,
            "turn": [round(angle, 3) for angle in pair.turn.tolist()],
            **nan_to_null({"before": pair.before, "after": pair.after}),
            "problem": pair.problem,
        }
        for pair in mounts.pairs
    ]
    turns = {
        name: None if np.isnan(turn).any() else [round(angle, 3) for angle in turn.tolist()]
        for name, turn in zip(rig.names, mounts.turns, strict=True)
    }
    return {"pairs": pairs, "turns": turns}


class _Compared:
    """One part of a recording, refined from its beginning."""

    def __init__(
        self,
        recorded: RecordedRig,
        predictor: DepthPredictor,
        matching: MatchingSettings,
        settings: RefinementSettings,
        search: MountSearch | None = None,
    ) -> None:
        self._depths = DepthReplay(SurroundReplay(recorded, matching), predictor)
        self._motion = RecordedSetMotion.of(recorded)
        self._refiner = DriveRefiner(
            self._depths.surround.rig.neighbour_indices, settings, follows_always=search is None
        )
        self._search = search
        self.problem = ""

    @property
    def has_judged_odometry(self) -> bool:
        return self._refiner.has_judged_odometry

    @property
    def contradicts_odometry(self) -> bool:
        return self._refiner.contradicts_odometry

    def look_at(self, part: Part) -> int:
        """Take in all sets, every second one also for the search; return how many there are."""
        number = -1
        for number, estimated in enumerate(self._estimated(part)):
            moment = moment_of(self._depths.surround, estimated.surround_set, estimated.result, self._poses(estimated))
            found = self._refiner.refine(moment)
            self.problem = found.odometry_problem or self.problem
            if self._search is not None and number >= _WARM_UP and number % _EVERY == 0:
                trusted = np.where(found.depth.confidence > _TRUSTED, found.depth.depth, np.float32(np.nan))
                self._search.add(replace(moment, world_T_base=found.world_T_base), trusted)
        return number + 1

    def _estimated(self, part: Part) -> Iterator[EstimatedSet[RecordedImage]]:
        return self._depths.sets(part.start, part.stop)

    def _poses(self, estimated: EstimatedSet[RecordedImage]) -> dict[str, np.ndarray] | None:
        if self._motion is None:
            return None
        self._motion.read_to(max(image.log_time for image in estimated.surround_set.images.values()))
        return self._motion.poses_at(estimated.surround_set.times_ns)
