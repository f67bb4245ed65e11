# SPDX-License-Identifier: Apache-2.0
"""A drive through a world with all that its sensors see, set by set; the same for the same description."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cvcdepth_core.rig.rig import Camera
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.worlds.building import build_world
from cvcdepth_core.worlds.description import Part, WorldSpec
from cvcdepth_core.worlds.odometry import Told, told_motion
from cvcdepth_core.worlds.rendering.camera_response import daylight_of, develop
from cvcdepth_core.worlds.rendering.flow import flow
from cvcdepth_core.worlds.rendering.lenses import Lens
from cvcdepth_core.worlds.rendering.lidar import Sweep, sweep
from cvcdepth_core.worlds.rendering.renderer import Renderer, Truth
from cvcdepth_core.worlds.sensors import Sensors
from cvcdepth_core.worlds.shapes.own_body import check_start

_BEFORE = 0.3  # seconds of motion that are told before the first set and after the last
_CAMERA, _LIDAR, _ODOMETRY = 1, 2, 3  # streams of noise


class DriveSpec(Part):
    """Everything that a drive depends on."""

    layout: RigLayout
    """Complete: every camera has its calibration and mount."""
    world: WorldSpec
    sensors: Sensors = Sensors()
    seconds: float = Field(default=5.0, gt=0.0, le=3600.0)
    samples: int = Field(default=2, ge=1, le=8)
    """Rays per pixel along each axis."""

    @property
    def sets(self) -> int:
        """Number of surround sets."""
        return max(1, math.floor(self.seconds * self.sensors.rate + 1e-9))

    def set_time(self, number: int) -> float:
        """Seconds from the beginning to the middle of a set; the LiDAR's stamp."""
        return (number + 0.5) / self.sensors.rate

    def camera_time(self, camera: Camera, number: int) -> float:
        """Seconds from the beginning to a camera's exposure: when the LiDAR would look where it looks."""
        axis = camera.base_T_camera[:2, 2]
        yaw = math.atan2(axis[1], axis[0])
        offset = -yaw / (2 * math.pi) / self.sensors.rate * self.sensors.stagger
        return self.set_time(number) + offset


class Shot(NamedTuple):
    """One picture and its truth."""

    picture: NDArray[np.uint8]
    truth: Truth


class SimulatedDrive:
    """A drive, ready to be seen."""

    def __init__(self, spec: DriveSpec) -> None:
        """Build the world.

        Raises RigError for a lens that cannot be inverted, and ConfigError for a vehicle that starts inside of
        something and where the ray engine is not installed.
        """
        self.spec = spec
        self.rig = spec.layout.complete()
        self.lenses = [Lens(camera.name, camera.calibration, camera.rectified) for camera in self.rig.cameras]
        mounts = [camera.base_T_camera for camera in self.rig.cameras]
        self.world, self.way, body = build_world(spec.world, spec.sensors.body, mounts, spec.sensors.seed)
        self.renderer = Renderer(self.world, self.way, body, spec.samples)
        check_start(self.renderer.scene, self.way)
        self._daylight = daylight_of(self.world.light)

    def shoot(self, camera: int, number: int) -> Shot:
        """Take the picture of a camera (by its index in the rig) in a set."""
        sensors, mount = self.spec.sensors, self.rig.cameras[camera]
        time = self.spec.camera_time(mount, number)
        view = self.renderer.view(self.lenses[camera], mount.base_T_camera, time, sensors.readout)
        seed = (camera, number, _CAMERA, sensors.seed)
        return Shot(develop(view.light, sensors.look(camera), self._daylight, seed), view.truth)

    def flow(self, camera: int, number: int, truth: Truth) -> NDArray[np.float32]:
        """Return by how many pixels [H, W, 2] (x, y) everything in a shot's `truth` moves until the camera's next set.

        NaN for the sky and for what is behind the camera then. With a rolling shutter, as if all rows were the middle
        one.
        """
        lens, mount = self.lenses[camera], self.rig.cameras[camera]
        times = (self.spec.camera_time(mount, each) for each in (number, number + 1))
        seen, later = ((lens, mount.base_T_camera, time) for time in times)
        places = flow(self.world, self.way, truth, seen, later)
        rows, columns = np.mgrid[: lens.height, : lens.width]
        return np.asarray(places - np.stack([columns, rows], axis=-1), np.float32)

    def sweep(self, number: int) -> Sweep | None:
        """Turn the LiDAR once; None where there is none."""
        sensors = self.spec.sensors
        if sensors.lidar is None:
            return None
        seed = (number, _LIDAR, sensors.seed)
        scene, time = self.renderer.scene, self.spec.set_time(number)
        return sweep(scene, sensors.lidar, self.way, time, 1.0 / sensors.rate, seed)

    def odometry(self) -> list[Told]:
        """Return what the vehicle believes about its motion, from a little before the first set to after the last."""
        return told_motion(
            self.way, self.spec.sensors.odometry, -_BEFORE, self._end, (_ODOMETRY, self.spec.sensors.seed)
        )

    def true_motion(self) -> list[Told]:
        """Return the true motion at the same times."""
        exact = self.spec.sensors.odometry.model_copy(
            update={"scale": 1.0, "noise": 0.0, "yaw_drift": 0.0, "latency": 0.0}
        )
        return told_motion(self.way, exact, -_BEFORE, self._end, (_ODOMETRY,))

    @property
    def _end(self) -> float:
        return self.spec.sets / self.spec.sensors.rate + _BEFORE
