# SPDX-License-Identifier: Apache-2.0
"""The stage between the network's depth and what becomes of it: refinement and confidence, live and recorded alike.

It is given every set in its order. What it remembers belongs to one rig and one network: another begins anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.estimator import SurroundDepthEstimator
from cvcdepth_core.refinement.drive import DriveRefiner, MotionSource, RefinedSet
from cvcdepth_core.refinement.moments import SurroundMoment
from cvcdepth_core.refinement.settings import RefinementSettings
from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_ros.settings import ModelSettings
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

T = TypeVar("T")

PosesAt = Callable[[Mapping[str, int]], Mapping[str, Pose] | None]
"""Takes each camera's exposure (ns) to the vehicle's pose then, world_T_base [4, 4]; None while that is not known."""


def _nowhere(times_ns: Mapping[str, int]) -> None:
    """Know of no motion."""


class LastSet(NamedTuple):
    """The cameras of a set, and what became of it."""

    cameras: list[str]
    refined: RefinedSet


class RefinementStage:
    """Refines sets, or only says how sure their depth is, or leaves them as they are."""

    def __init__(
        self,
        settings: ModelSettings,
        poses_at: PosesAt = _nowhere,
        wants_confidence: Callable[[], bool] = lambda: False,
        latencies: StageLatencies | None = None,
        follows_always: bool = False,
        knows_motion: Callable[[], bool] = lambda: False,
        wants_poses: bool = False,
    ) -> None:
        """`wants_confidence` is asked for every set where depth is not refined; `follows_always`: for odometry.

        `knows_motion` is asked where `refine` is auto: whether anything tells how the vehicle moves. `wants_poses` has
        every set carry where the vehicle was at the exposures, where that is known.
        """
        self._refine = settings.refine
        self._knows_motion = knows_motion
        self._wants_poses = wants_poses
        self._grid = RefinementSettings(max_grid_width=settings.refine_width)
        self._poses_at = poses_at
        self._wants_confidence = wants_confidence
        self._latencies = latencies or StageLatencies()
        self._follows_always = follows_always
        self._surround: SurroundDepthEstimator | None = None
        self._refiner: DriveRefiner | None = None
        self._counts: Counter[MotionSource] = Counter()
        self._odometry_problem = ""
        self.last: LastSet | None = None
        """What became of the last set; None where nothing was done."""

    @property
    def is_active(self) -> bool:
        """Whether the next set's pictures are compared; all cameras are needed then."""
        return self._refines or self._follows_always or self._wants_confidence()

    @property
    def needs_motion(self) -> bool:
        """Whether the vehicle's motion is of use, where there is any."""
        return self._refine != "off" or self._wants_poses or self.is_active

    @property
    def _refines(self) -> bool:
        return self._refine == "geometry" or (self._refine == "auto" and self._knows_motion())

    def summary(self) -> dict[str, Any] | None:
        """Return for how many sets motion was taken from where, with JSON's types; None where nothing was done."""
        if not self._counts:
            return None
        counts = {source: self._counts[source] for source in get_args(MotionSource)}
        return {"motion": counts, "odometry_problem": self._odometry_problem or None}

    def finished(
        self, surround: SurroundDepthEstimator, surround_set: SurroundSet[T], result: SurroundDepth
    ) -> EstimatedSet[T]:
        """Return the set with what is published of it; `result` is what `surround` has estimated."""
        if not self.is_active:
            self._surround = self._refiner = self.last = None
            world_T_base = self._poses(surround_set, surround.rig.names) if self._wants_poses else None
            return EstimatedSet(surround_set, surround.rig, result, world_T_base=world_T_base)
        refiner = self._refiner_of(surround)
        poses = self._poses_at(surround_set.times_ns)
        with self._latencies.measure("refinement"):
            found = refiner.refine(moment_of(surround, surround_set, result, poses))
        self.last = LastSet(surround.rig.names, found)
        self._counts[found.source] += 1
        self._odometry_problem = self._odometry_problem or found.odometry_problem
        depth, confidence = found.depth.depth, found.depth.confidence
        if not self._refines:
            depth, confidence = result.depth, found.depth.prior_confidence
        finished = replace(result, depth=depth, confidence=confidence)
        return EstimatedSet(surround_set, surround.rig, finished, found.visual, found.world_T_base)

    def _poses(self, surround_set: SurroundSet[T], names: Sequence[str]) -> NDArray[np.float64] | None:
        poses = self._poses_at(surround_set.times_ns)
        return None if poses is None else _stacked(poses, names, surround_set.anchor)

    def _refiner_of(self, surround: SurroundDepthEstimator) -> DriveRefiner:
        if self._refiner is None or self._surround is not surround:
            self._surround = surround
            self._refiner = DriveRefiner(
                surround.rig.neighbour_indices, self._grid, follows_always=self._follows_always
            )
        return self._refiner


def moment_of(
    surround: SurroundDepthEstimator,
    surround_set: SurroundSet[T],
    result: SurroundDepth,
    poses: Mapping[str, Pose] | None,
) -> SurroundMoment:
    """Put a set together for `DriveRefiner`; of an absent camera, time and pose are another's and mean nothing."""
    times, names, anchor = surround_set.times_ns, surround.rig.names, surround_set.anchor
    return SurroundMoment(
        depth=result.depth,
        pictures=result.pictures,
        present=result.present,
        intrinsics=result.intrinsics,
        valid=surround.preprocessor.valid,
        base_T_camera=np.stack([camera.base_T_camera for camera in surround.rig.cameras]),
        times_ns=np.array([times.get(name, surround_set.time_ns) for name in names], dtype=np.int64),
        world_T_base=None if poses is None else _stacked(poses, names, anchor),
    )


def _stacked(poses: Mapping[str, Pose], names: Sequence[str], anchor: str) -> NDArray[np.float64]:
    """Return the poses [N, 4, 4] of the cameras; that of an absent one is the anchor's."""
    return np.stack([poses.get(name, poses[anchor]) for name in names])
