# SPDX-License-Identifier: Apache-2.0
"""A robot that nobody has seen before: four fisheye cameras, odd names, base `chassis`, raw bgr8, no odometry."""

import math
from pathlib import Path

import numpy as np
from recordings import JAZZY, Entry, write_rosbag2
from simple_worlds import street_spec

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout, save_rig_layout
from cvcdepth_core.worlds.world_file import save_world
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import RecordedMessage, open_recording

WIDTH, HEIGHT = 128, 96
YAWS = {"a7": 0.0, "b2": 90.0, "c9": 180.0, "d4": -90.0}
IMAGE = "sensor_msgs/msg/Image"
_NOT_RECORDED = ("/odom", "/tf")


def robot() -> RigLayout:
    """Lenses of 114 degrees, of which P = K shows 90."""
    focal = WIDTH / 2 / math.radians(57.5)
    x, y = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    calibration = Calibration(
        width=WIDTH, height=HEIGHT, distortion_model="equidistant", d=(0.01, -0.003, 0.0, 0.0),
        k=(focal, 0, x, 0, focal, y, 0, 0, 1), p=(focal, 0, x, 0, 0, focal, y, 0, 0, 0, 1, 0),
    )  # fmt: skip
    cameras = tuple(
        CameraEntry(
            name=name,
            image_topic=f"/robo/eyes/{name}/picture",
            camera_info_topic=f"/robo/eyes/{name}/camera_info",
            frame_id=f"eye_{name}",
            calibration=calibration,
            base_T_camera=PoseEntry.from_matrix(_mount(yaw)),
        )
        for name, yaw in YAWS.items()
    )
    return RigLayout(base_frame="chassis", cameras=cameras)


def recorded_drive(folder: Path, seconds: float) -> Path:
    """Simulate a drive, and record what the robot would: neither odometry nor truth, and bgr8."""
    save_rig_layout(folder / "simulated.yaml", robot())
    save_world(folder / "world.yaml", street_spec())
    options = ["--rig", folder / "simulated.yaml", "--world", folder / "world.yaml", "--seconds", seconds]
    more = ["--size", f"{WIDTH}x{HEIGHT}", "--images", "raw", "--truth", "none", "--no-lidar", "--samples", "1"]
    output = ["--workers", "1", "--quiet", "-o", folder / "simulated"]
    assert main(["simulate", *map(str, [*options, *more, *output])]) == 0
    with open_recording(folder / "simulated") as recording:
        kept = [message for message in recording.messages() if message.topic not in _NOT_RECORDED]
        entries = [_entry(message, recording.topics[message.topic].type) for message in kept]
    return write_rosbag2(folder / "robot", entries)


def _entry(message: RecordedMessage, type_: str) -> Entry:
    cdr = bytes(message.cdr)
    if type_ == IMAGE:
        image = JAZZY.deserialize_cdr(cdr, type_)
        assert image.encoding == "rgb8"
        image.encoding, image.data = "bgr8", np.ascontiguousarray(image.data.reshape(-1, 3)[:, ::-1]).ravel()
        cdr = bytes(JAZZY.serialize_cdr(image, type_))
    return Entry(message.topic, type_, message.log_time, cdr)


def _mount(yaw: float) -> np.ndarray:
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    pose = np.eye(4)
    pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = 0.5 * c, 0.4 * s, 1.1
    return pose
