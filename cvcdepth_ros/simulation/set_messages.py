# SPDX-License-Identifier: Apache-2.0
"""All messages of one surround set, and those of the motion, on the topics of a simulated recording. No ROS here."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.rig_file import CameraEntry, RigLayout
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.worlds.drive import DriveSpec, SimulatedDrive
from cvcdepth_core.worlds.odometry import Told
from cvcdepth_core.worlds.rendering.lidar import lidar_mount
from cvcdepth_core.worlds.rendering.renderer import Truth
from cvcdepth_ros.simulation.messages import (
    camera_info,
    compressed_image,
    image,
    odometry,
    point_cloud,
    serialized,
    transforms,
)

ImageForm = Literal["jpeg", "png", "raw"]
TruthChoice = Literal["none", "depth", "all"]

START = 1_700_000_000 * NANOSECONDS
"""Stamp at which every drive begins, ns."""
LIDAR_TOPIC, LIDAR_FRAME = "/lidar/points", "lidar"
ODOMETRY_TOPIC, TRUE_ODOMETRY_TOPIC, ODOMETRY_FRAME = "/odom", "/truth/odom", "odom"
_TYPES = {
    "image": "sensor_msgs/msg/Image",
    "compressed": "sensor_msgs/msg/CompressedImage",
    "info": "sensor_msgs/msg/CameraInfo",
    "cloud": "sensor_msgs/msg/PointCloud2",
    "tf": "tf2_msgs/msg/TFMessage",
    "odometry": "nav_msgs/msg/Odometry",
}


class Stored(NamedTuple):
    """One message, ready to be written."""

    topic: str
    type: str
    log_time: int
    """ns"""
    cdr: bytes


class Form(NamedTuple):
    """How pictures and truth are stored."""

    images: ImageForm = "jpeg"
    quality: int = 90
    """Of JPEG, 1 to 100."""
    truth: TruthChoice = "depth"


def recorded_layout(layout: RigLayout, images: ImageForm) -> RigLayout:
    """Return the rig as its recording has it: every camera with a frame, and its topic named for what it carries."""
    return layout.model_copy(update={"cameras": tuple(_recorded(camera, images) for camera in layout.cameras)})


def _recorded(camera: CameraEntry, images: ImageForm) -> CameraEntry:
    topic = camera.image_topic.removesuffix("/compressed")
    if images != "raw" and not topic.endswith("compressed"):
        topic += "/compressed"
    frame = camera.frame_id or f"{camera.name}_optical_frame"
    return camera.model_copy(update={"image_topic": topic, "frame_id": frame, "stamp_offset": 0.0})


def truth_topic(camera: str, what: str) -> str:
    """Topic of a camera's truth: depth, objects, moving, normals or flow."""
    return f"/camera/{camera}/truth/{what}"


def stamp_of(seconds: float) -> int:
    """Stamp, ns, of a time in seconds from the beginning."""
    return START + round(seconds * NANOSECONDS)


def set_messages(drive: SimulatedDrive, number: int, form: Form) -> list[Stored]:
    """Everything that cameras and LiDAR send in one set, in the order of time."""
    found = [
        message for camera in range(len(drive.rig.cameras)) for message in _camera_messages(drive, camera, number, form)
    ]
    swept = drive.sweep(number)
    if swept is not None:
        stamp = stamp_of(drive.spec.set_time(number))
        found.append(_stored(LIDAR_TOPIC, "cloud", stamp, point_cloud(stamp, LIDAR_FRAME, swept)))
    return sorted(found, key=lambda message: (message.log_time, message.topic))


def _camera_messages(drive: SimulatedDrive, camera: int, number: int, form: Form) -> Iterator[Stored]:
    entry, shot = drive.spec.layout.cameras[camera], drive.shoot(camera, number)
    frame = entry.frame_id or entry.name
    stamp = stamp_of(drive.spec.camera_time(drive.rig.cameras[camera], number))
    if form.images == "raw":
        yield _stored(entry.image_topic, "image", stamp, image(stamp, frame, shot.picture, "rgb8"))
    else:
        packed = compressed_image(stamp, frame, shot.picture, form.images, form.quality)
        yield _stored(entry.image_topic, "compressed", stamp, packed)
    info = camera_info(stamp, frame, drive.rig.cameras[camera].calibration)
    yield _stored(entry.camera_info_topic, "info", stamp, info)
    yield from _truth_messages(drive, camera, number, shot.truth, form.truth)


def _truth_messages(
    drive: SimulatedDrive, camera: int, number: int, truth: Truth, choice: TruthChoice
) -> Iterator[Stored]:
    entry = drive.spec.layout.cameras[camera]
    images: dict[str, tuple[NDArray[Any], str]] = {}
    if choice != "none":
        images["depth"] = truth.depth.astype("<f4"), "32FC1"
    if choice == "all":
        images["objects"] = truth.objects.astype("<u2"), "mono16"
        images["moving"] = truth.moving.astype(np.uint8) * 255, "mono8"
        images["normals"] = truth.normals.astype("<f4"), "32FC3"
        images["flow"] = drive.flow(camera, number, truth).astype("<f4"), "32FC2"
    stamp = stamp_of(drive.spec.camera_time(drive.rig.cameras[camera], number))
    for what, (pixels, encoding) in images.items():
        content = image(stamp, entry.frame_id or entry.name, pixels, encoding)
        yield _stored(truth_topic(entry.name, what), "image", stamp, content)


def static_transforms(spec: DriveSpec) -> Stored:
    """Where the sensors are."""
    frames = {
        entry.frame_id or entry.name: camera.base_T_camera
        for entry, camera in zip(spec.layout.cameras, spec.layout.complete().cameras, strict=True)
    }
    if spec.sensors.lidar is not None:
        frames[LIDAR_FRAME] = lidar_mount(spec.sensors.lidar)
    stamp = stamp_of(-0.5)
    return _stored("/tf_static", "tf", stamp, transforms(stamp, spec.layout.base_frame, frames))


def motion_messages(drive: SimulatedDrive) -> list[Stored]:
    """Return what the vehicle believes about its motion, on `/odom` and `/tf`, and the truth where that differs."""
    told = drive.odometry()
    base = drive.spec.layout.base_frame
    found = []
    for each in told:
        stamp = stamp_of(each.seconds)
        found.append(_stored(ODOMETRY_TOPIC, "odometry", stamp, odometry(stamp, ODOMETRY_FRAME, base, each)))
        link = transforms(stamp, ODOMETRY_FRAME, {base: each.odom_T_base})
        found.append(_stored("/tf", "tf", stamp, link))
    if _differs(told, true := drive.true_motion()):
        for each in true:
            stamp = stamp_of(each.seconds)
            found.append(_stored(TRUE_ODOMETRY_TOPIC, "odometry", stamp, odometry(stamp, "world", base, each)))
    return sorted(found, key=lambda message: (message.log_time, message.topic))


def _differs(told: list[Told], true: list[Told]) -> bool:
    return any((a.odom_T_base != b.odom_T_base).any() for a, b in zip(told, true, strict=True))


def _stored(topic: str, kind: str, stamp: int, content: Any) -> Stored:
    type_name = _TYPES[kind]
    return Stored(topic, type_name, stamp, serialized(type_name, content))
