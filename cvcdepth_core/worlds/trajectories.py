# SPDX-License-Identifier: Apache-2.0
"""How vehicles and people move: along curves, at changing speeds, on the ground as it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.worlds.description import Drive, Motion, Placed
from cvcdepth_core.worlds.meshes import Floats
from cvcdepth_core.worlds.paths import Path, eased
from cvcdepth_core.worlds.site import Site

_PITCH_PER_ACCELERATION = 0.006  # radians per m/s^2: a sprung body
_ROLL_PER_ACCELERATION = 0.005
_SMOOTHING = 0.35  # seconds to either side over which a body feels a change of speed
_BUMPS = ((1.7, 0.0022), (4.3, 0.004), (11.0, 0.006))  # wavelength and height, metres, of what wheels run over


class SpeedProfile:
    """Speed over time: straight lines between (time, speed), constant before and after."""

    def __init__(self, speeds: tuple[tuple[float, float], ...]) -> None:
        self._times = np.array([time for time, _ in speeds], np.float64)
        self._speeds = np.array([speed for _, speed in speeds], np.float64)
        steps = np.diff(self._times) * (self._speeds[1:] + self._speeds[:-1]) / 2
        self._distances = np.r_[0.0, np.cumsum(steps)]
        self._start = 0.0
        self._start = self.distance(0.0)

    def speed(self, time: float) -> float:
        """Metres per second."""
        return float(np.interp(time, self._times, self._speeds))

    def distance(self, time: float) -> float:
        """Metres covered since time 0."""
        i = int(np.clip(np.searchsorted(self._times, time, side="right") - 1, 0, len(self._times) - 1))
        since, first = time - self._times[i], self._speeds[i]
        return float(self._distances[i] + since * (first + self.speed(time)) / 2) - self._start

    def acceleration(self, time: float) -> float:
        """Mean over a short while around a time, m/s^2."""
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
        return self.profile.speed(time)

    def pose(self, time: float) -> Pose:
        """world_T_body [4, 4] at a time in seconds; the body's origin is on the ground, x forward."""
        s = self.start + self.profile.distance(time)
        x, y = self.path.points(s).tolist()
        heading = float(self.path.heading(s))
        rear_front, right_left, z = self._slopes(x, y, heading)
        pitch, roll, lift = (0.0, 0.0, 0.0)
        if self.sprung:
            pitch, roll, lift = self._body_motion(s, time)
        forward = np.array([math.cos(heading), math.sin(heading), rear_front - pitch])
        leftward = np.array([-math.sin(heading), math.cos(heading), right_left + roll])
        forward /= np.linalg.norm(forward)
        leftward -= forward * (forward @ leftward)
        leftward /= np.linalg.norm(leftward)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([forward, leftward, np.cross(forward, leftward)], axis=1)
        pose[:3, 3] = x, y, z + lift
        return pose

    def _slopes(self, x: float, y: float, heading: float) -> tuple[float, float, float]:
        """Slope forward and to the left, and the height, by the places of four wheels."""
        c, s = math.cos(heading), math.sin(heading)
        half, side = self.wheelbase / 2, self.track / 2
        corners = np.array([(half, side), (half, -side), (-half, side), (-half, -side)])
        places = np.array([x, y]) + corners @ np.array([[c, s], [-s, c]])
        fl, fr, rl, rr = self.height(places).tolist()
        return (fl + fr - rl - rr) / (4 * half), (fl + rl - fr - rr) / (4 * side), (fl + fr + rl + rr) / 4

    def _body_motion(self, s: float, time: float) -> tuple[float, float, float]:
        """Nose-down angle, angle to the right and lift of a sprung body."""
        speed = self.profile.speed(time)
        pitch = -_PITCH_PER_ACCELERATION * self.profile.acceleration(time)
        roll = _ROLL_PER_ACCELERATION * speed * speed * float(self.path.curvature(s))
        front, rear = (sum(h * math.sin(2 * math.pi * (s + d) / w) for w, h in _BUMPS) for d in (1.35, -1.35))
        return pitch - 0.4 * (front - rear) / 2.7, roll, (front + rear) / 4


def vehicle_trajectory(site: Site, placed: Placed, motion: Motion | Drive, length: float = 4.5) -> Trajectory:
    """The way of a vehicle: on the terrain, without pavements."""
    path, start = _way(site, placed, motion)
    sprung = isinstance(motion, Drive)
    profile = SpeedProfile(motion.speeds)
    return Trajectory(path, start, profile, site.terrain.height, 0.6 * length, 1.6, sprung)


def person_trajectory(site: Site, placed: Placed, motion: Motion) -> Trajectory:
    """The way of somebody on foot or on two wheels, also on pavements."""
    path, start = _way(site, placed, motion)

    def height(points: Floats) -> Floats:
        return site.terrain.height(points) + site.raised(points)

    return Trajectory(path, start, SpeedProfile(motion.speeds), height, 0.3, 0.2)


def _way(site: Site, placed: Placed, motion: Motion | Drive) -> tuple[Path, float]:
    """The curve, and how far along it the start is."""
    place = site.place(placed)
    if motion.bends is not None or placed.road is None:
        bends = motion.bends or ()
        return Path((place.x, place.y, place.yaw), eased(bends)), 0.0
    along = math.cos(math.radians(placed.yaw)) >= 0
    path = site.corridors[placed.road].path.offset(placed.at[1])
    path = path if along else path.reversed()
    s, _ = path.locate(np.array([[place.x, place.y]]))
    return path, float(s[0])
