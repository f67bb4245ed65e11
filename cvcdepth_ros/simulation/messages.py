# SPDX-License-Identifier: Apache-2.0
"""Simulated sensors' data as messages of rosbags. No ROS here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.poses import Pose, quaternion_from_rotation
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.worlds.odometry import Told
from cvcdepth_core.worlds.rendering.lidar import Sweep
from cvcdepth_ros.bags import typestore

_COVARIANCE = np.zeros(36)


def message(type_name: str, **fields: Any) -> Any:
    """Build a message of a type like `sensor_msgs/msg/Image`."""
    return typestore().types[type_name](**fields)


def serialized(type_name: str, content: Any) -> bytes:
    """Return a message's CDR bytes."""
    return bytes(typestore().serialize_cdr(content, type_name))


def header(stamp: int, frame_id: str) -> Any:
    """Build a header; `stamp` in nanoseconds."""
    seconds, rest = divmod(stamp, NANOSECONDS)
    return message(
        "std_msgs/msg/Header",
        stamp=message("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest),
        frame_id=frame_id,
    )


def compressed_image(stamp: int, frame_id: str, picture: NDArray[np.uint8], form: str, quality: int) -> Any:
    """Build a CompressedImage of an RGB picture [H, W, 3]; `form` is jpeg or png."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if form == "jpeg" else [cv2.IMWRITE_PNG_COMPRESSION, 6]
    _, encoded = cv2.imencode(".jpg" if form == "jpeg" else ".png", np.ascontiguousarray(picture[..., ::-1]), options)
    return message(
        "sensor_msgs/msg/CompressedImage",
        header=header(stamp, frame_id),
        format=f"bgr8; {form} compressed bgr8",
        data=encoded.reshape(-1),
    )


def image(stamp: int, frame_id: str, pixels: NDArray[Any], encoding: str) -> Any:
    """Build an Image of pixels [H, W] or [H, W, C], little-endian."""
    pixels = np.ascontiguousarray(pixels)
    return message(
        "sensor_msgs/msg/Image",
        header=header(stamp, frame_id),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels[0].nbytes,
        data=pixels.view(np.uint8).reshape(-1),
    )


def camera_info(stamp: int, frame_id: str, calibration: Calibration) -> Any:
    """Build a CameraInfo; without a P in the calibration it is K's, as for a camera that nobody rectified."""
    projection = np.array(calibration.p)
    if not projection.any():
        projection = np.hstack([np.array(calibration.k).reshape(3, 3), np.zeros((3, 1))]).ravel()
    region = calibration.roi
    return message(
        "sensor_msgs/msg/CameraInfo",
        header=header(stamp, frame_id),
        height=calibration.height,
        width=calibration.width,
        distortion_model=calibration.distortion_model,
        d=np.array(calibration.d),
        k=np.array(calibration.k),
        r=np.array(calibration.r),
        p=projection,
        binning_x=calibration.binning_x,
        binning_y=calibration.binning_y,
        roi=message(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=region.x_offset,
            y_offset=region.y_offset,
            height=region.height,
            width=region.width,
            do_rectify=False,
        ),
    )


def point_cloud(stamp: int, frame_id: str, swept: Sweep) -> Any:
    """Build the PointCloud2 of a sweep: x, y, z, intensity, seconds after the stamp, ring."""
    names = ("x", "y", "z", "intensity", "time", "ring")
    columns = [*swept.points.T, swept.intensities, swept.seconds, swept.rings]
    values = np.stack(columns, axis=1).astype("<f4")
    fields = [
        message("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=7, count=1)
        for i, name in enumerate(names)
    ]
    return message(
        "sensor_msgs/msg/PointCloud2",
        header=header(stamp, frame_id),
        height=1,
        width=len(values),
        fields=fields,
        is_bigendian=False,
        point_step=4 * len(names),
        row_step=4 * len(names) * len(values),
        data=values.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def transforms(stamp: int, parent: str, parent_T_frames: Mapping[str, Pose]) -> Any:
    """Build a TFMessage that hangs frames under `parent`."""
    links = [
        message(
            "geometry_msgs/msg/TransformStamped",
            header=header(stamp, parent),
            child_frame_id=frame,
            transform=message(
                "geometry_msgs/msg/Transform", translation=_vector(pose[:3, 3]), rotation=_quaternion(pose)
            ),
        )
        for frame, pose in parent_T_frames.items()
    ]
    return message("tf2_msgs/msg/TFMessage", transforms=links)


def odometry(stamp: int, parent: str, child: str, told: Told) -> Any:
    """Build the Odometry of what a vehicle believes."""
    x, y, z = told.odom_T_base[:3, 3].tolist()
    pose = message(
        "geometry_msgs/msg/Pose",
        position=message("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=_quaternion(told.odom_T_base),
    )
    twist = message(
        "geometry_msgs/msg/Twist",
        linear=_vector(np.array([told.speed, 0.0, 0.0])),
        angular=_vector(np.array([0.0, 0.0, told.yaw_rate])),
    )
    return message(
        "nav_msgs/msg/Odometry",
        header=header(stamp, parent),
        child_frame_id=child,
        pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=_COVARIANCE),
        twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=_COVARIANCE),
    )


def _vector(values: NDArray[np.float64]) -> Any:
    x, y, z = values.tolist()
    return message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _quaternion(pose: Pose) -> Any:
    x, y, z, w = quaternion_from_rotation(pose[:3, :3]).tolist()
    return message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
