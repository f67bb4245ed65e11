# SPDX-License-Identifier: Apache-2.0
"""How vehicles and people move: along curves, at changing speeds, on the ground as it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.worlds.description import Drive, Motion, Placed
from cvcdepth_core.worlds.paths import Path, eased
from cvcdepth_core.worlds.shapes.meshes import Floats, cross
from cvcdepth_core.worlds.site import Site

_PITCH_PER_ACCELERATION = 0.006  # radians per m/s^2: a sprung body
_ROLL_PER_ACCELERATION = 0.005
_SMOOTHING = 0.35  # seconds to either side over which a body feels a change of speed
_BUMPS = ((3.1, 0.002), (7.3, 0.004), (17.0, 0.008))  # wavelength and height, metres, of what wheels run over


class SpeedProfile:
    """Speed over time: straight lines between (time, speed), constant before and after."""

    def __init__(self, speeds: tuple[tuple[float, float], ...]) -> None:
        self._times = np.array([time for time, _ in speeds], np.float64)
        self._speeds = np.array([speed for _, speed in speeds], np.float64)
        steps = np.diff(self._times) * (self._speeds[1:] + self._speeds[:-1]) / 2
        self._distances = np.r_[0.0, np.cumsum(steps)]
        self._start: Floats = np.zeros(())
        self._start = self.distance(0.0)

    def speed(self, time: Floats | float) -> Floats:
        """Metres per second at each time."""
        return np.asarray(np.interp(time, self._times, self._speeds))

    def distance(self, time: Floats | float) -> Floats:
        """Metres covered since time 0 until each time."""
        i = np.clip(np.searchsorted(self._times, time, side="right") - 1, 0, len(self._times) - 1)
        since = time - self._times[i]
        found: Floats = self._distances[i] + since * (self._speeds[i] + self.speed(time)) / 2 - self._start
        return found

    def acceleration(self, time: Floats | float) -> Floats:
        """Mean over a short while around each time, m/s^2."""
        return (self.speed(time + _SMOOTHING) - self.speed(time - _SMOOTHING)) / (2 * _SMOOTHING)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A way through a world."""

    path: Path
    start: float
    """Metres along the path at time 0."""
    profile: SpeedProfile
    height: Callable[[Floats], Floats]
    """z of what it moves on at x, y [N, 2]."""
    wheelbase: float = 2.7
    track: float = 1.6
    sprung: bool = False
    """Whether the body nods, leans and shakes as a car's does."""

    def speed(self, time: float) -> float:
        """Metres per second, negative backwards."""
        return float(self.profile.speed(time))

    def pose(self, time: float) -> Pose:
        """Return world_T_body [4, 4] at a time in seconds; the body's origin is on the ground, x forward."""
        pose: Pose = self.poses(np.array([time]))[0]
        return pose

    def poses(self, times: Floats) -> Floats:
        """Return world_T_body [T, 4, 4] at all times [T]."""
        s = self.start + self.profile.distance(times)
        xy, heading = self.path.points(s), self.path.heading(s)
        ahead, aside, z = self._slopes(xy, heading)
        if self.sprung:
            pitch, roll, lift = self._body_motion(s, times)
            ahead, aside, z = ahead - pitch, aside + roll, z + lift
        forward = _unit(np.stack([np.cos(heading), np.sin(heading), ahead], axis=-1))
        left = np.stack([-np.sin(heading), np.cos(heading), aside], axis=-1)
        left = _unit(left - forward * (forward * left).sum(axis=-1, keepdims=True))
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = np.stack([forward, left, cross(forward, left)], axis=-1)
        poses[:, :3, 3] = np.c_[xy, z]
        return poses

    def _slopes(self, xy: Floats, heading: Floats) -> tuple[Floats, Floats, Floats]:
        """Slope forward and to the left, and the height, by the places of four wheels."""
        forward = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        half, side = self.wheelbase / 2, self.track / 2
        wheels = [xy + a * half * forward + b * side * left for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
        fl, fr, rl, rr = self.height(np.concatenate(wheels)).reshape(4, -1)
        return (fl + fr - rl - rr) / (4 * half), (fl + rl - fr - rr) / (4 * side), (fl + fr + rl + rr) / 4

    def _body_motion(self, s: Floats, times: Floats) -> tuple[Floats, Floats, Floats]:
        """Nose-down angle, angle to the right and lift of a sprung body."""
        pitch = -_PITCH_PER_ACCELERATION * self.profile.acceleration(times)
        roll = _ROLL_PER_ACCELERATION * self.profile.speed(times) ** 2 * self.path.curvature(s)
        front, rear = _bumps(s + 1.35), _bumps(s - 1.35)
        return pitch - 0.4 * (front - rear) / 2.7, roll, (front + rear) / 4


def _bumps(s: Floats) -> Floats:
    height: Floats = np.sum([h * np.sin(2 * math.pi * s / w) for w, h in _BUMPS], axis=0)
    return height


def _unit(vectors: Floats) -> Floats:
    unit: Floats = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


def vehicle_trajectory(site: Site, placed: Placed, motion: Motion | Drive, length: float = 4.5) -> Trajectory:
    """Return the way of a vehicle: on the terrain, without pavements."""
    path, start = _way(site, placed, motion)
    sprung = isinstance(motion, Drive)
    profile = SpeedProfile(motion.speeds)
    return Trajectory(path, start, profile, site.terrain.height, 0.6 * length, 1.6, sprung)


def person_trajectory(site: Site, placed: Placed, motion: Motion) -> Trajectory:
    """Return the way of somebody on foot or on two wheels, also on pavements."""
    path, start = _way(site, placed, motion)

    def height(points: Floats) -> Floats:
        return site.terrain.height(points) + site.raised(points)

    return Trajectory(path, start, SpeedProfile(motion.speeds), height, 0.3, 0.2)


def _way(site: Site, placed: Placed, motion: Motion | Drive) -> tuple[Path, float]:
    """Return the curve, and how far along it the start is."""
    place = site.place(placed)
    if motion.bends is not None or placed.road is None:
        bends = motion.bends or ()
        return Path((place.x, place.y, place.yaw), eased(bends)), 0.0
    along = math.cos(math.radians(placed.yaw)) >= 0
    path = site.corridors[placed.road].path.offset(placed.at[1])
    path = path if along else path.reversed()
    s, _ = path.locate(np.array([[place.x, place.y]]))
    return path, float(s[0])
