# SPDX-License-Identifier: Apache-2.0
"""Whether recorded odometry and the pictures tell of the same motion, and if not, what is wrong with the odometry."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.refinement.alignment import Twist, logarithm
from cvcdepth_core.rig.poses import Pose, inverse

STEPS_TO_JUDGE = 10
"""Steps that must have been compared before anything is said."""

_KEPT = 50
_SLOW, _MOVING = 0.1, 0.5  # metres per second
_FASTEST_CHANGE = 20.0  # metres per second from one step to the next: more is a jump
_SCALE = 1.2  # depth's own scale is hardly better
_USABLE_SCALE = 2.0
_LARGEST_ANGLE = 15.0  # degrees between the two directions
_STEADY = 0.8  # length of the mean of unit vectors: below, directions vary too much to speak of one
_LONGEST_LAG, _LAG_STEP, _LEAST_LAG = 0.5, 0.05, 0.15  # seconds
_LAG_GAIN = 0.5  # of the squared differences that must go when the lag is taken out
_LEAST_VARIATIONS = (0.1, 0.02)  # standard deviations of speed (m/s) and turn rate (rad/s) that a lag can be seen in
_AXES = {0: "x", 1: "y", 2: "z"}


class ComparedMotion(NamedTuple):
    """One step's motion, told twice."""

    time: float
    """Seconds, in the middle of the step."""
    seen: Twist
    """By the pictures."""
    recorded: Twist
    """By odometry."""


def recorded_twist(world_T_before: Pose, world_T_now: Pose, seconds: float) -> Twist:
    """Return the constant motion that leads from one recorded pose of the base frame to the next."""
    return logarithm(inverse(world_T_before) @ world_T_now) / seconds


class OdometryCheck:
    """Follows the last fifty steps of a drive."""

    def __init__(self) -> None:
        self._steps: deque[ComparedMotion] = deque(maxlen=_KEPT)

    def add(self, step: ComparedMotion) -> None:
        """Take in the next step; only those whose aligned motion has no problem tell anything."""
        self._steps.append(step)

    @property
    def is_ready(self) -> bool:
        """Whether enough is known to judge."""
        return len(self._steps) >= STEPS_TO_JUDGE

    def is_usable(self) -> bool:
        """Whether the odometry may be used.

        Of a scale that differs by less than a factor of two it may: on a rig that is new to the network it is rather
        the depth's scale that is wrong, and matching by odometry mends that.
        """
        if self.problem() is None:
            return True
        times, seen, recorded = (np.array(column) for column in zip(*self._steps, strict=True))
        moving = np.linalg.norm(seen[:, :3], axis=1) > _MOVING
        others = _worse_than_scale(times, seen, recorded, moving)
        return others is None and 1 / _USABLE_SCALE <= _scale(seen[moving], recorded[moving]) <= _USABLE_SCALE

    def is_contradicted(self) -> bool:
        """Whether the pictures contradict the odometry in more than its scale, which depth may have wrong."""
        if not self.is_ready:
            return False
        times, seen, recorded = (np.array(column) for column in zip(*self._steps, strict=True))
        moving = np.linalg.norm(seen[:, :3], axis=1) > _MOVING
        return _worse_than_scale(times, seen, recorded, moving) is not None

    def problem(self) -> str | None:
        """Say what is wrong with the odometry, in one line; None while nothing is, or too little is known."""
        if not self.is_ready:
            return None
        times, seen, recorded = (np.array(column) for column in zip(*self._steps, strict=True))
        moving = np.linalg.norm(seen[:, :3], axis=1) > _MOVING
        return _worse_than_scale(times, seen, recorded, moving) or _wrong_scale(seen[moving], recorded[moving])


def _worse_than_scale(
    times: NDArray[np.float64], seen: NDArray[np.float64], recorded: NDArray[np.float64], moving: NDArray[np.bool_]
) -> str | None:
    return (
        _jump(times, recorded)
        or _standing(seen[moving], recorded[moving])
        or _other_frame(seen[moving], recorded[moving])
        or _lag(times, seen, recorded)
    )


def _jump(times: NDArray[np.float64], recorded: NDArray[np.float64]) -> str | None:
    change = np.linalg.norm(np.diff(recorded[:, :3], axis=0), axis=1)
    if change.max() <= _FASTEST_CHANGE:
        return None
    at = int(change.argmax()) + 1
    return f"odometry jumps: its speed changes by {change.max():.0f} m/s within a step, at {times[at]:.2f} s"


def _standing(seen: NDArray[np.float64], recorded: NDArray[np.float64]) -> str | None:
    if len(seen) < STEPS_TO_JUDGE or np.median(np.linalg.norm(recorded[:, :3], axis=1)) > _SLOW:
        return None
    speed = np.median(np.linalg.norm(seen[:, :3], axis=1))
    return f"odometry stands still while the pictures move at {speed:.1f} m/s"


def _other_frame(seen: NDArray[np.float64], recorded: NDArray[np.float64]) -> str | None:
    if len(seen) < STEPS_TO_JUDGE:
        return None
    ways = [_mean_direction(twists[:, :3]) for twists in (seen, recorded)]
    if min(np.linalg.norm(way) for way in ways) < _STEADY:
        return None
    mine, theirs = (way / np.linalg.norm(way) for way in ways)
    angle = float(np.degrees(np.arccos(np.clip(mine @ theirs, -1.0, 1.0))))
    if angle <= _LARGEST_ANGLE:
        return None
    return f"odometry is in another frame: it drives along {_axis(theirs)}, the pictures along {_axis(mine)}"


def _mean_direction(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray((vectors / np.maximum(lengths, 1e-9)).mean(axis=0))


def _axis(direction: NDArray[np.float64]) -> str:
    """Name the axis that is nearest, and how far away it is."""
    nearest = int(np.abs(direction).argmax())
    sign = "-" if direction[nearest] < 0 else ""
    degrees = float(np.degrees(np.arccos(min(1.0, abs(direction[nearest])))))
    return f"{sign}{_AXES[nearest]}" + (f" ({degrees:.0f} degrees off)" if degrees >= 1 else "")


def _lag(times: NDArray[np.float64], seen: NDArray[np.float64], recorded: NDArray[np.float64]) -> str | None:
    """Compare speed and turn rate after every shift; what tells are changes, so scale and level are left out."""
    shifts = np.arange(-_LONGEST_LAG, _LONGEST_LAG + _LAG_STEP / 2, _LAG_STEP)
    inner = (times >= times[0] + _LONGEST_LAG) & (times <= times[-1] - _LONGEST_LAG)
    if inner.sum() < STEPS_TO_JUDGE:
        return None
    misfits = np.zeros(len(shifts))
    for mine, theirs, least in zip(_courses(seen), _courses(recorded), _LEAST_VARIATIONS, strict=True):
        if min(np.std(mine[inner]), np.std(theirs[inner])) > least:
            shifted = np.stack([np.interp(times[inner] + shift, times, theirs) for shift in shifts])
            misfits += _unlikeness(mine[inner], shifted)
    best, none = int(misfits.argmin()), int(np.abs(shifts).argmin())
    if not misfits.any() or abs(shifts[best]) < _LEAST_LAG or misfits[best] > (1 - _LAG_GAIN) * misfits[none]:
        return None
    verb = "lags behind" if shifts[best] > 0 else "is ahead of"
    return f"odometry {verb} the pictures by {abs(shifts[best]):.2f} s"


def _courses(twists: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return speed and turn rate [T]."""
    return np.linalg.norm(twists[:, :3], axis=1), twists[:, 5]


def _unlikeness(mine: NDArray[np.float64], shifted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 1 - squared correlation [S] of one course [T] with each of `shifted` [S, T]."""
    a, b = mine - mine.mean(), shifted - shifted.mean(axis=1, keepdims=True)
    scale = (a @ a) * np.maximum((b * b).sum(axis=1), 1e-12)
    return np.asarray(1 - np.square(np.maximum(b @ a, 0.0)) / scale)


def _scale(seen: NDArray[np.float64], recorded: NDArray[np.float64]) -> float:
    return float(np.median(np.linalg.norm(recorded[:, :3], axis=1) / np.linalg.norm(seen[:, :3], axis=1)))


def _wrong_scale(seen: NDArray[np.float64], recorded: NDArray[np.float64]) -> str | None:
    if len(seen) < STEPS_TO_JUDGE:
        return None
    ratio = _scale(seen, recorded)
    if 1 / _SCALE <= ratio <= _SCALE:
        return None
    return f"odometry has another scale: it drives {ratio:.2f} times as far as the pictures show"
