# SPDX-License-Identifier: Apache-2.0
"""Worlds of a few known shapes, whose depth has a closed form."""

from collections.abc import Sequence

import numpy as np

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.worlds.light import Lamps, Light
from cvcdepth_core.worlds.materials import Layer, Material, MaterialTable
from cvcdepth_core.worlds.meshes import Mesh, joined
from cvcdepth_core.worlds.noise import Noise
from cvcdepth_core.worlds.world import Mover, World

FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""base_T_camera of a camera that looks along x."""
LENSES = {
    "no distortion": Calibration(width=64, height=40, k=(40, 0, 31.2, 0, 41, 19.4, 0, 0, 1)),
    "plumb_bob": Calibration(
        width=64, height=40, d=(-0.12, 0.03, 0.001, -0.002, 0.0), k=(40, 0, 31.2, 0, 41, 19.4, 0, 0, 1)
    ),
    "rational_polynomial": Calibration(
        width=64, height=40, distortion_model="rational_polynomial", k=(42, 0, 31.2, 0, 41, 19.4, 0, 0, 1),
        d=(0.3, 0.05, 0.0005, -0.0004, 0.001, 0.35, 0.06, 0.002),
    ),
    "equidistant": Calibration(
        width=64, height=40, distortion_model="equidistant", d=(0.02, -0.004, 0.001, 0.0), k=(36, 0, 31.2, 0, 36, 19.4, 0, 0, 1)
    ),
}  # fmt: skip


class Standing:
    """The way of something that stands or moves evenly along x, and turns evenly."""

    def __init__(self, speed: float = 0.0, yaw_rate: float = 0.0, start: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        self._speed, self._yaw_rate, self._start = speed, yaw_rate, np.array(start)

    def pose(self, time: float) -> np.ndarray:
        angle = self._yaw_rate * time
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = self._start + (self._speed * time, 0.0, 0.0)
        return pose

    def poses(self, times: np.ndarray) -> np.ndarray:
        return np.stack([self.pose(float(time)) for time in times])

    def speed(self, time: float) -> float:
        return self._speed


def textured(table: MaterialTable) -> int:
    """A surface with clear texture at all scales."""
    return table.add(Material((0.4, 0.35, 0.3), coarse=Layer(Noise.CLOUDY, 6.0, 0.25), fine=Layer(Noise.ROUGH, 40.0, 0.15)))


def daylight() -> Light:
    """A plain grey sky without sun."""
    grey = np.full(3, 0.8)
    return Light(
        sun=np.array([0.0, 0.0, 1.0]), sunlight=np.zeros(3), zenith=grey, horizon=grey, ground=0.3 * grey, glow=0.0,
        cloud=grey, cover=0.0, cloud_scale=40.0, cloud_offset=(0.0, 0.0), visibility=1e9, lamps=Lamps.none(),
    )  # fmt: skip


def simple_world(meshes: Sequence[Mesh], table: MaterialTable, movers: Sequence[Mover] = ()) -> World:
    """A world of these meshes, each an object, numbered from 2."""
    numbers = np.repeat(np.arange(len(meshes)) + 2, [len(mesh.faces) for mesh in meshes]).astype(np.int32)
    names = ("sky", "own vehicle", *(f"object {i}" for i in range(len(meshes) + len(movers))))
    return World(joined(meshes), numbers, names, tuple(movers), table.array(), daylight())
