# SPDX-License-Identifier: Apache-2.0
"""Where the vehicle goes, told by its cameras alone: alignment from set to set, chained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.refinement.alignment import AlignedMotion, AlignedSet, Twist, align
from cvcdepth_core.refinement.moments import SurroundMoment, reduced_depth
from cvcdepth_core.rig.poses import Pose

_LONGEST_GAP = 1.0  # seconds between two sets that are aligned


@dataclass(frozen=True, eq=False)
class _Last:
    """The set before."""

    aligned: AlignedSet
    """With refined depth, where there is any."""
    reference_time: float
    world_T_base: Pose
    """At the reference time."""
    covariance: NDArray[np.float64]
    """[6, 6] of that pose, in the world's axes."""
    twist: Twist | None


class _Now(NamedTuple):
    """The set that was tracked last."""

    aligned: AlignedSet
    world_T_base: Pose
    covariance: NDArray[np.float64]
    motion: AlignedMotion | None

    @classmethod
    def anew(cls, aligned: AlignedSet, motion: AlignedMotion | None = None) -> _Now:
        """Begin another world here; `motion` is one that must not be used."""
        return cls(aligned, np.eye(4), np.zeros((6, 6)), motion)

    @property
    def is_placed(self) -> bool:
        return self.motion is not None and self.motion.problem is None


class VisualOdometry:
    """Chains aligned motions; the world is the base frame at some set, and another one after every gap.

    For every set call `track`, then `keep` with the depth that was made of it. Depth refined before makes the motion of
    the next set more exact; its scale is that of the network's depth.
    """

    def __init__(self, max_width: int = 160) -> None:
        """Align on grids of at most so many columns."""
        self._max_width = max_width
        self._last: _Last | None = None
        self._now: _Now | None = None

    def reset(self) -> None:
        """Forget the set before: after a jump in time, or when the rig has changed."""
        self._last = self._now = None

    def track(self, moment: SurroundMoment, guesses: Sequence[Twist] = ()) -> AlignedMotion | None:
        """Return the motion since the set before; None for the first set and after a gap.

        `guesses` are where the search begins beside standstill and the motion before: a pose network's answer, say.
        """
        now = AlignedSet.of(moment, self._max_width)
        last = self._last
        if last is None or not 0 < float(now.times.mean()) - last.reference_time <= _LONGEST_GAP:
            self._now = _Now.anew(now)
            return None
        motion = align(now, last.aligned, _distinct([*guesses, *([] if last.twist is None else [last.twist])]))
        seconds = float(now.times.mean()) - last.reference_time
        self._now = _Now.anew(now, motion) if motion.problem else _moved(last, now, motion, seconds)
        return motion

    def base_poses(self) -> NDArray[np.float64] | None:
        """Return world_T_base [N, 4, 4] at each exposure of the set last tracked; None while it is not known."""
        if self._now is None:
            return None
        now, here, _, motion = self._now
        if motion is None or motion.problem is not None:
            return None
        reference = float(now.times.mean())
        return np.stack([here @ motion.pose(float(time) - reference) for time in now.times])

    def reference(self) -> tuple[Pose, NDArray[np.float64]] | None:
        """Return world_T_base [4, 4] at the mean exposure of the set last tracked and its covariance [6, 6].

        The covariance adds up along the way, by the pictures' noise; None while the pose is not known.
        """
        return (self._now.world_T_base, self._now.covariance) if self._now and self._now.is_placed else None

    def keep(self, depth: NDArray[np.float32]) -> None:
        """Let the next set align to the one last tracked, with this `depth` [N, H, W] (NaN where not trusted)."""
        if self._now is None:
            return
        now, here, covariance, motion = self._now
        aligned = now._replace(depth=reduced_depth(torch.from_numpy(depth), depth.shape[2] // now.depth.shape[2]))
        twist = motion.twist if motion is not None and motion.problem is None else None
        self._last = _Last(aligned, float(now.times.mean()), here, covariance, twist)


def _distinct(twists: Sequence[Twist]) -> list[Twist]:
    """Leave out what is there already."""
    return [one for n, one in enumerate(twists) if not any(np.array_equal(one, other) for other in twists[:n])]


def _moved(last: _Last, now: AlignedSet, motion: AlignedMotion, seconds: float) -> _Now:
    rotation = np.zeros((6, 6))
    rotation[:3, :3] = rotation[3:, 3:] = last.world_T_base[:3, :3]
    covariance = last.covariance + rotation @ (motion.covariance * seconds**2) @ rotation.T
    return _Now(now, last.world_T_base @ motion.pose(seconds), covariance, motion)
