# SPDX-License-Identifier: Apache-2.0
"""Refinement along a drive: by recorded motion as long as the pictures agree with it, else by motion from the pictures.

What odometry tells is compared with what the pictures show, at first in every set, then about three times a second, and
odometry that does not fit is named and not used. Where there is none, alignment and refinement take turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.refinement.alignment import AlignedMotion, Twist
from cvcdepth_core.refinement.moments import SurroundMoment
from cvcdepth_core.refinement.odometry_check import ComparedMotion, OdometryCheck, recorded_twist
from cvcdepth_core.refinement.refiner import RefinedDepth, SurroundRefiner
from cvcdepth_core.refinement.settings import RefinementSettings
from cvcdepth_core.refinement.visual_odometry import VisualOdometry
from cvcdepth_core.rig.poses import Pose

MotionSource = Literal["odometry", "alignment", "unknown"]
"""Where the vehicle's motion was taken from."""

_TRUSTED = 0.65  # confidence of depth that the next set is aligned to
_WATCH_NS = 250_000_000  # between two looks at whether odometry is right
_PATIENCE_NS = 10**9  # that odometry may be silent before alignment takes its place
_SPREAD_NS = 200_000_000  # by which a set without its last camera may seem earlier than the one before
_FASTEST_CHANGE = 20.0  # metres per second from one set to the next: more is a jump


class VisualMotion(NamedTuple):
    """What the pictures tell of the vehicle's motion."""

    time_ns: int
    """The mean of the exposures."""
    world_T_base: Pose
    """[4, 4]; the world is the base frame where the pictures could first be followed, and another after every gap."""
    covariance: NDArray[np.float64]
    """[6, 6] of that pose, along and about the world's axes."""
    aligned: AlignedMotion
    """Since the set before."""


@dataclass(frozen=True, eq=False)
class RefinedSet:
    """One set after refinement."""

    depth: RefinedDepth
    source: MotionSource
    world_T_base: NDArray[np.float64] | None
    """[N, 4, 4] where the vehicle was at each exposure, as it was used; None where that is not known."""
    visual: VisualMotion | None
    """None where the pictures were not followed, or could not be."""
    odometry_problem: str
    """Why recorded motion is not used, or what is odd about it; empty where it fits, or there is none."""


class DriveRefiner:
    """Refines one rig's sets in their order; the state is what it remembers of the last seconds."""

    def __init__(
        self,
        neighbours: Sequence[tuple[int, int]],
        settings: RefinementSettings | None = None,
        device: torch.device | str = "cpu",
        follows_always: bool = False,
    ) -> None:
        """`neighbours` as for `SurroundRefiner`; `follows_always` has every set aligned, for visual odometry."""
        self._refiner = SurroundRefiner(neighbours, settings, device)
        self._visual = VisualOdometry()
        self._follows_always = follows_always
        self._check = OdometryCheck()
        self._source: MotionSource = "unknown"
        self._last: SurroundMoment | None = None
        self._watched: SurroundMoment | None = None
        self._seen: Twist | None = None
        self._checked_ns: int | None = None
        self._odometry_ns: int | None = None
        self._velocity: NDArray[np.float64] | None = None

    def reset(self) -> None:
        """Forget all earlier sets: after a jump in time, or when the rig has changed."""
        self._refiner.reset()
        self._visual.reset()
        self._check = OdometryCheck()
        self._source = "unknown"
        self._last = self._watched = self._velocity = self._seen = None
        self._checked_ns = self._odometry_ns = None

    @property
    def has_judged_odometry(self) -> bool:
        """Whether enough sets were compared with odometry to know whether it fits."""
        return self._check.is_ready

    @property
    def contradicts_odometry(self) -> bool:
        """Whether the pictures contradict odometry in more than its scale."""
        return self._check.is_contradicted()

    def refine(self, moment: SurroundMoment) -> RefinedSet:
        """Refine the next set; its `world_T_base` is the recorded motion, None where that is not known now."""
        if self._last is not None and moment.time_ns < self._last.time_ns - _SPREAD_NS:
            self.reset()
        last = self._last
        jump = self._jump(moment)
        motion = self._followed(moment, last)
        problem = self._check.problem() or jump
        poses, source = self._placed(moment, is_trusted=jump is None and self._check.is_usable())
        if source != self._source and source != "unknown":
            self._refiner.reset()
            self._source = source
        refined = self._refiner.refine(replace(moment, world_T_base=poses))
        self._keep(moment, refined, source)
        return RefinedSet(refined, source, poses, _visual_motion(self._visual, motion, moment), problem or "")

    def _jump(self, moment: SurroundMoment) -> str | None:
        """Say that odometry has jumped since the set before, and forget what lies before that."""
        last, self._last = self._last, moment
        twist = None if last is None else _recorded_twist(last, moment)
        before, self._velocity = self._velocity, None if twist is None else twist[:3]
        if before is None or twist is None:
            return None
        change = float(np.linalg.norm(twist[:3] - before))
        if change <= _FASTEST_CHANGE:
            return None
        self._refiner.reset()
        self._velocity = None
        return f"odometry jumps: its speed changes by {change:.0f} m/s from one set to the next"

    def _followed(self, moment: SurroundMoment, last: SurroundMoment | None) -> AlignedMotion | None:
        """Align the set to the one before, `last`, where that is of use; compare with odometry."""
        is_rare = moment.world_T_base is not None and not self._follows_always and self._is_odometry_right()
        if is_rare and self._checked_ns is not None and moment.time_ns - self._checked_ns < _WATCH_NS:
            return None
        watched, self._watched = self._watched, moment
        if watched is None or watched is not last:
            self._visual.reset()
        twist = None if watched is None else _recorded_twist(watched, moment)
        motion = self._visual.track(moment, [guess for guess in (twist, self._seen) if guess is not None])
        if motion is None or motion.problem is not None:
            return motion
        self._seen, self._checked_ns = motion.twist, moment.time_ns
        if watched is not None and twist is not None:
            self._check.add(ComparedMotion((watched.time_ns + moment.time_ns) / 2e9, motion.twist, twist))
        return motion

    def _is_odometry_right(self) -> bool:
        return self._check.is_ready and self._check.is_usable()

    def _placed(self, moment: SurroundMoment, is_trusted: bool) -> tuple[NDArray[np.float64] | None, MotionSource]:
        """Return world_T_base [N, 4, 4], and from where; odometry that is late by a little is not replaced at once."""
        if moment.world_T_base is not None and is_trusted:
            self._odometry_ns = moment.time_ns
            return moment.world_T_base, "odometry"
        is_late = self._odometry_ns is not None and moment.time_ns - self._odometry_ns <= _PATIENCE_NS
        if is_trusted and is_late:
            return None, "unknown"
        poses = self._visual.base_poses() if self._watched is moment else None
        return poses, "unknown" if poses is None else "alignment"

    def _keep(self, moment: SurroundMoment, refined: RefinedDepth, source: MotionSource) -> None:
        """Let the next set be aligned to this one, if it was looked at.

        Depth that odometry has refined follows odometry's scale, and would confirm it whatever it is: then the
        network's own is kept.
        """
        if self._watched is not moment:
            return
        sure = refined.confidence > _TRUSTED
        if source == "odometry" or not sure.any():
            self._visual.keep(moment.depth)
        else:
            self._visual.keep(np.where(sure, refined.depth, np.float32(np.nan)))


def _recorded_twist(before: SurroundMoment, now: SurroundMoment) -> Twist | None:
    """Return the motion that odometry tells between two sets, by a camera that both have; None where it is unknown."""
    if before.world_T_base is None or now.world_T_base is None or before.present.shape != now.present.shape:
        return None
    both = np.flatnonzero(before.present & now.present)
    seconds = (now.times_ns - before.times_ns)[both] / 1e9
    if not both.size or seconds[0] <= 0:
        return None
    camera = int(both[0])
    return recorded_twist(before.world_T_base[camera], now.world_T_base[camera], float(seconds[0]))


def _visual_motion(
    odometry: VisualOdometry, motion: AlignedMotion | None, moment: SurroundMoment
) -> VisualMotion | None:
    found = odometry.reference()
    if motion is None or found is None:
        return None
    return VisualMotion(int(moment.times_ns[moment.present].mean()), *found, motion)
