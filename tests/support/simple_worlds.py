# SPDX-License-Identifier: Apache-2.0
"""Worlds of a few known shapes, whose depth has a closed form."""

from collections.abc import Sequence

import numpy as np

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout
from cvcdepth_core.worlds.description import Building, Drive, Ground, Motion, Road, Sky, Tree, Vehicle, Wave, WorldSpec
from cvcdepth_core.worlds.drive import DriveSpec
from cvcdepth_core.worlds.rendering.light import Lamps, Light
from cvcdepth_core.worlds.sensors import Lidar, Sensors
from cvcdepth_core.worlds.shapes.meshes import Mesh, joined
from cvcdepth_core.worlds.surfaces.materials import Layer, Material, MaterialTable
from cvcdepth_core.worlds.surfaces.noise import Noise
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
        width=64, height=40, distortion_model="equidistant", k=(36, 0, 31.2, 0, 36, 19.4, 0, 0, 1),
        d=(0.02, -0.004, 0.001, 0.0),
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
        pose[:3, 3] = self._start + np.array([self._speed * time, 0.0, 0.0])
        return pose

    def poses(self, times: np.ndarray) -> np.ndarray:
        return np.stack([self.pose(float(time)) for time in times])

    def speed(self, time: float) -> float:
        return self._speed


def textured(table: MaterialTable) -> int:
    """A surface with clear texture at all scales."""
    return table.add(
        Material((0.4, 0.35, 0.3), coarse=Layer(Noise.CLOUDY, 6.0, 0.25), fine=Layer(Noise.ROUGH, 40.0, 0.15))
    )


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


def street_spec(**changes: object) -> WorldSpec:
    """A short street that is built in a moment: houses, a tree, a parked and a moving car."""
    houses = tuple(
        Building(at=(5.0 + 16 * i, side * 10.0), yaw=90 - side * 90, size=(13, 8, 7), wall=wall, seed=i)
        for i, wall in enumerate(("plaster", "brick", "panels"))
        for side in (-1, 1)
    )
    spec = WorldSpec(
        name="street",
        seed=5,
        sky=Sky(weather="cloudy"),
        ground=Ground(margin=20.0, waves=(Wave(height=0.3, wavelength=80.0),)),
        roads=(Road(start=(-20.0, 0.0, 0.0), bends=((80.0, 0.0),), pavement=(2.0, 2.0)),),
        buildings=houses,
        trees=(Tree(at=(30.0, 5.0)),),
        vehicles=(
            Vehicle(at=(34.0, -2.6)),
            Vehicle(at=(38.0, 1.6), yaw=180.0, motion=Motion(speeds=((0.0, 6.0),))),
        ),
        drive=Drive(at=(20.0, -1.6), speeds=((0.0, 5.0), (2.0, 7.0))),
    )
    return spec.model_copy(update=changes)


def two_cameras(**changes: object) -> RigLayout:
    """A rig of two pinhole cameras of 64 x 40 pixels that overlap."""
    entries = []
    for name, yaw in (("front", 0.0), ("left", 60.0)):
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        pose = np.eye(4)
        pose[:3, :3] = [[s, 0, c], [-c, 0, s], [0, -1, 0]]
        pose[:3, 3] = 1.2 * c, 0.5 * s, 1.6
        entries.append(
            CameraEntry(
                name=name,
                image_topic=f"/camera/{name}/image_raw/compressed",
                camera_info_topic=f"/camera/{name}/camera_info",
                frame_id=f"{name}_optical_frame",
                calibration=LENSES["no distortion"],
                base_T_camera=PoseEntry.from_matrix(pose),
            ).model_copy(update=changes)
        )
    return RigLayout(cameras=tuple(entries))


def short_drive(**sensors: object) -> DriveSpec:
    """Three sets of two small cameras on the street, at once."""
    own = Sensors(stagger=0.4, lidar=Lidar(beams=8, columns=240)).model_copy(update=sensors)
    return DriveSpec(layout=two_cameras(), world=street_spec(), sensors=own, seconds=0.3)
