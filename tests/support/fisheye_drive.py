# SPDX-License-Identifier: Apache-2.0
"""A short drive down a street with two fisheyes of 170 degrees, which two thirds of their view overlap."""

import math
from pathlib import Path

import numpy as np
from simple_worlds import street_spec

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout
from cvcdepth_core.worlds.drive import DriveSpec
from cvcdepth_core.worlds.sensors import Lidar, Sensors
from cvcdepth_ros.simulation.recording import record
from cvcdepth_ros.simulation.set_messages import Form, TruthChoice

LENS_DEG = 170.0
WIDTH, HEIGHT = 128, 80
VIEWS = ("_l", "_m", "_r")


def fisheye(hfov: float = LENS_DEG) -> Calibration:
    f = WIDTH / math.radians(hfov)
    k = (f, 0.0, (WIDTH - 1) / 2, 0.0, f, (HEIGHT - 1) / 2, 0.0, 0.0, 1.0)
    return Calibration(width=WIDTH, height=HEIGHT, distortion_model="equidistant", d=(0.0,) * 4, k=k)


def fisheye_rig(
    hfov: float = LENS_DEG, cameras: tuple[tuple[str, float], ...] = (("ahead", 0.0), ("port", 60.0))
) -> RigLayout:
    entries = []
    for name, yaw in cameras:
        c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
        pose = np.eye(4)
        pose[:3, :3] = [[s, 0, c], [-c, 0, s], [0, -1, 0]]
        pose[:3, 3] = 1.2 * c, 0.5 * s, 1.6
        entries.append(
            CameraEntry(
                name=name, image_topic=f"/{name}/image_raw", camera_info_topic=f"/{name}/camera_info",
                frame_id=f"{name}_lens", calibration=fisheye(hfov), base_T_camera=PoseEntry.from_matrix(pose),
            )
        )  # fmt: skip
    return RigLayout(cameras=tuple(entries))


def fisheye_spec(layout: RigLayout, sets: int) -> DriveSpec:
    sensors = Sensors(stagger=0.0, lidar=Lidar(beams=8, columns=240))
    return DriveSpec(layout=layout, world=street_spec(), sensors=sensors, seconds=sets / sensors.rate, samples=1)


def record_fisheyes(folder: Path, layout: RigLayout | None = None, sets: int = 4, truth: TruthChoice = "none") -> Path:
    """Record the drive with raw pictures and a LiDAR."""
    record(fisheye_spec(layout or fisheye_rig(), sets), Form(images="raw", truth=truth), folder)
    return folder
