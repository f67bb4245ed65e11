# SPDX-License-Identifier: Apache-2.0
"""What a vehicle believes about its way: exact, or with the errors of wheels."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.worlds.sensors import Odometry
from cvcdepth_core.worlds.shapes.meshes import yaw_rotation
from cvcdepth_core.worlds.world import Way


class Told(NamedTuple):
    """One message."""

    seconds: float
    """Its stamp, from the beginning."""
    odom_T_base: Pose
    speed: float
    """Metres per second, as believed."""
    yaw_rate: float
    """Radians per second, as believed."""


def told_motion(way: Way, odometry: Odometry, start: float, stop: float, seed: tuple[int, ...]) -> list[Told]:
    """Return all messages from `start` to `stop` (seconds), the first pose as it is.

    Without errors every pose is the true one of its stamp.
    """
    count = round((stop - start) * odometry.rate) + 1
    times = [start + i / odometry.rate for i in range(count)]
    poses = list(way.poses(np.array(times) - odometry.latency))
    speeds = [way.speed(time - odometry.latency) for time in times]
    steps = [inverse(a) @ b for a, b in itertools.pairwise(poses)]
    turns = [float(np.arctan2(step[1, 0], step[0, 0])) * odometry.rate for step in steps]
    turns.append(turns[-1] if turns else 0.0)
    if odometry.scale != 1.0 or odometry.noise or odometry.yaw_drift:
        poses = _erring(poses[0], steps, odometry, seed)
    told = [speed * odometry.scale for speed in speeds]
    return [Told(*values) for values in zip(times, poses, told, turns, strict=True)]


def _erring(first: Pose, steps: list[Pose], odometry: Odometry, seed: tuple[int, ...]) -> list[Pose]:
    """Add up steps with errors."""
    rng = np.random.default_rng(seed)
    poses = [first]
    for step in steps:
        length = float(np.linalg.norm(step[:3, 3]))
        wrong = step.copy()
        wrong[:3, 3] *= odometry.scale * (1.0 + odometry.noise * rng.standard_normal())
        turn = odometry.yaw_drift / odometry.rate + odometry.noise * 0.01 * length * rng.standard_normal()
        wrong[:3, :3] = step[:3, :3] @ yaw_rotation(turn)
        poses.append(poses[-1] @ wrong)
    return poses
