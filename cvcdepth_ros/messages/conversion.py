# SPDX-License-Identifier: Apache-2.0
"""Between ROS messages and arrays, for rclpy's message objects and for those of the rosbags library alike.

Both give messages the same attributes, so reading needs neither. Writing needs the classes: a `MessageFactory` is made
from rclpy's (`ros_message_factory`) or from those of rosbags' typestore (`bag_message_factory`).
"""

import array
import sys
from collections.abc import Callable
from importlib import import_module
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError, ImageError
from cvcdepth_core.images.decoding import Picture, Reduction, decode_compressed, decode_raw, reduce_picture
from cvcdepth_core.obstacles.scan import Scan
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.poses import Pose, quaternion_from_rotation
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.messages.camera_info import read_camera_info

_FLOAT32_DATATYPE = 7  # sensor_msgs/PointField.FLOAT32
_POINT_FIELDS = ("x", "y", "z", "rgb", "t")
_MILLIMETRES = 1000.0
_BIG_ENDIAN_HOST = sys.byteorder == "big"


def stamp_ns(message: Any) -> int:
    """Return the stamp of a message with a header, or of a video packet, in nanoseconds since the epoch."""
    stamp = header_of(message).stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def header_of(message: Any) -> Any:
    """Return a message's header, or what stands for it in a `foxglove_msgs/CompressedVideo`."""
    if hasattr(message, "header"):
        return message.header
    return SimpleNamespace(stamp=message.timestamp, frame_id=message.frame_id)


def is_video_packet(message: Any) -> bool:
    """Whether a message is one packet of a video stream, of the types in `VIDEO_TYPES`."""
    return hasattr(message, "pts") or hasattr(message, "timestamp")


def video_codec(packet: Any) -> str:
    """Return what a video packet says of its codec."""
    return str(packet.encoding if hasattr(packet, "encoding") else packet.format)


def picture_from_message(
    message: Any, camera: str, reduce: Reduction = 1, size: tuple[int, int] | None = None
) -> Picture:
    """Decode a `sensor_msgs/Image` or `CompressedImage` to RGB, each `reduce` x `reduce` pixels to one.

    ImageError names the camera and what is wrong, also when the image's width and height are not `size`.
    """
    if hasattr(message, "format"):
        return decode_compressed(message.format, message.data, camera, reduce=reduce, size=size)
    if size is not None and (message.width, message.height) != size:
        raise ImageError(
            f"camera {camera}: image of {message.width}x{message.height}, but its camera_info says {size[0]}x{size[1]}"
        )
    picture = decode_raw(
        message.width, message.height, message.encoding, message.step, bool(message.is_bigendian), message.data, camera
    )
    return reduce_picture(picture, reduce)


def calibration_from_message(message: Any, camera: str) -> Calibration:
    """Validate a `sensor_msgs/CameraInfo`, see `read_camera_info`."""
    return read_camera_info(message, camera).calibration


class Covariances(NamedTuple):
    """Of an odometry message, each [6, 6]: along and about x, y and z."""

    pose: NDArray[np.float64]
    twist: NDArray[np.float64]


class MessageFactory:
    """Builds messages from arrays, with the message classes of one library."""

    def __init__(self, find_class: Callable[[str], Any], make_bytes: Callable[[NDArray[np.generic]], Any]) -> None:
        """`find_class` maps a type name to its class, `make_bytes` an array to what a `uint8[]` field takes."""
        self._class = find_class
        self._bytes = make_bytes

    def depth_image(self, stamp: int, frame_id: str, depth: NDArray[np.float32], encoding: str) -> Any:
        """Build the depth image (REP 118) of `depth` [H, W] in metres, NaN where unknown.

        `encoding` is `32FC1`, or `16UC1`: millimetres, 0 where unknown or beyond what 16 bits hold.
        """
        if encoding == "16UC1":
            return self._image(stamp, frame_id, _to_millimetres(depth), encoding)
        if encoding != "32FC1":
            raise ConfigError(f"depth encoding '{encoding}' is not one of 32FC1, 16UC1")
        return self._image(stamp, frame_id, depth, encoding)

    def confidence_image(self, stamp: int, frame_id: str, confidence: NDArray[np.float32]) -> Any:
        """Build the 32FC1 image of `confidence` [H, W] in [0, 1]."""
        return self._image(stamp, frame_id, confidence, "32FC1")

    def colour_image(self, stamp: int, frame_id: str, picture: Picture) -> Any:
        """Build the rgb8 image of `picture` [H, W, 3]."""
        return self._image(stamp, frame_id, picture, "rgb8")

    def camera_info(self, stamp: int, frame_id: str, intrinsics: NDArray[np.float64], height: int, width: int) -> Any:
        """Build the CameraInfo of a rectified picture: K = P's left part = `intrinsics` [3, 3], no distortion."""
        projection = np.hstack([intrinsics, np.zeros((3, 1))])
        return self._class("sensor_msgs/msg/CameraInfo")(
            header=self._header(stamp, frame_id),
            height=height,
            width=width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=intrinsics.ravel(),
            r=np.eye(3).ravel(),
            p=projection.ravel(),
            binning_x=0,
            binning_y=0,
            roi=self._class("sensor_msgs/msg/RegionOfInterest")(
                x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            ),
        )

    def point_cloud(self, stamp: int, frame_id: str, cloud: NDArray[np.float32]) -> Any:
        """Build the PointCloud2 of `cloud` [H, W, C] (organised) or [M, C]: x, y, z in metres and packed rgb.

        A fifth column is t, seconds after the stamp.
        """
        height, width = cloud.shape[:2] if cloud.ndim == 3 else (1, cloud.shape[0])
        point_step = cloud.shape[-1] * cloud.itemsize
        return self._class("sensor_msgs/msg/PointCloud2")(
            header=self._header(stamp, frame_id),
            height=height,
            width=width,
            fields=[self._float_field(name, 4 * i) for i, name in enumerate(_POINT_FIELDS[: cloud.shape[-1]])],
            is_bigendian=_BIG_ENDIAN_HOST,
            point_step=point_step,
            row_step=point_step * width,
            data=self._bytes(cloud),
            is_dense=cloud.ndim == 2,
        )

    def laser_scan(self, stamp: int, frame_id: str, scan: Scan) -> Any:
        """Build the LaserScan of a scan whose beams were all measured at once."""
        return self._class("sensor_msgs/msg/LaserScan")(
            header=self._header(stamp, frame_id),
            angle_min=scan.angle_min,
            angle_max=scan.angle_min + scan.increment * (len(scan.ranges) - 1),
            angle_increment=scan.increment,
            time_increment=0.0,
            scan_time=0.0,
            range_min=scan.range_min,
            range_max=scan.range_max,
            ranges=scan.ranges,
            intensities=np.zeros(0, np.float32),
        )

    def odometry(
        self, stamp: int, frame_id: str, base_frame: str, pose: Pose, twist: NDArray[np.float64], errors: Covariances
    ) -> Any:
        """Build the Odometry of `base_frame` at `pose` in `frame_id`; `twist` [6] is in the base frame (m/s, rad/s)."""
        where, velocity = self._transform(pose), twist.tolist()
        vector = self._class("geometry_msgs/msg/Vector3")
        point = self._class("geometry_msgs/msg/Point")(
            x=where.translation.x, y=where.translation.y, z=where.translation.z
        )
        return self._class("nav_msgs/msg/Odometry")(
            header=self._header(stamp, frame_id),
            child_frame_id=base_frame,
            pose=self._class("geometry_msgs/msg/PoseWithCovariance")(
                pose=self._class("geometry_msgs/msg/Pose")(position=point, orientation=where.rotation),
                covariance=errors.pose.ravel(),
            ),
            twist=self._class("geometry_msgs/msg/TwistWithCovariance")(
                twist=self._class("geometry_msgs/msg/Twist")(
                    linear=vector(**dict(zip("xyz", velocity[:3], strict=True))),
                    angular=vector(**dict(zip("xyz", velocity[3:], strict=True))),
                ),
                covariance=errors.twist.ravel(),
            ),
        )

    def string(self, content: str) -> Any:
        """Build the `std_msgs/String` with this content."""
        return self._class("std_msgs/msg/String")(data=content)

    def static_transforms(self, stamp: int, base_frame: str, base_T_frames: dict[str, Pose]) -> Any:
        """Build the `/tf_static` message that hangs each frame under `base_frame`."""
        transforms = [
            self._class("geometry_msgs/msg/TransformStamped")(
                header=self._header(stamp, base_frame), child_frame_id=frame, transform=self._transform(pose)
            )
            for frame, pose in base_T_frames.items()
        ]
        return self._class("tf2_msgs/msg/TFMessage")(transforms=transforms)

    def _transform(self, pose: Pose) -> Any:
        x, y, z = pose[:3, 3].tolist()
        qx, qy, qz, qw = quaternion_from_rotation(pose[:3, :3]).tolist()
        return self._class("geometry_msgs/msg/Transform")(
            translation=self._class("geometry_msgs/msg/Vector3")(x=x, y=y, z=z),
            rotation=self._class("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
        )

    def _image(self, stamp: int, frame_id: str, pixels: NDArray[Any], encoding: str) -> Any:
        return self._class("sensor_msgs/msg/Image")(
            header=self._header(stamp, frame_id),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(_BIG_ENDIAN_HOST),
            step=pixels[0].nbytes,
            data=self._bytes(pixels),
        )

    def _header(self, stamp: int, frame_id: str) -> Any:
        time = self._class("builtin_interfaces/msg/Time")(sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS)
        return self._class("std_msgs/msg/Header")(stamp=time, frame_id=frame_id)

    def _float_field(self, name: str, offset: int) -> Any:
        return self._class("sensor_msgs/msg/PointField")(name=name, offset=offset, datatype=_FLOAT32_DATATYPE, count=1)


def ros_message_factory() -> MessageFactory:
    """Build rclpy's messages; needs a ROS environment."""
    return MessageFactory(ros_message_class, _to_byte_array)


def ros_message_class(type_name: str) -> Any:
    """Find rclpy's class of a type like `sensor_msgs/msg/Image`; ImportError or AttributeError when there is none."""
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def bag_message_factory() -> MessageFactory:
    """Build rosbags' messages; needs no ROS."""
    from cvcdepth_ros.bags import typestore

    return MessageFactory(lambda type_name: typestore().types[type_name], _to_uint8)


def _to_uint8(values: NDArray[np.generic]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(values).view(np.uint8).ravel()


def _to_byte_array(values: NDArray[np.generic]) -> "array.array[int]":
    """Copy an array to the one type that rclpy takes over without looking at every byte (150 us for 4 MB, not 1 s)."""
    content = array.array("B")
    content.frombytes(_to_uint8(values).data)
    return content


def _to_millimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    millimetres = np.rint(depth * _MILLIMETRES)
    known = (millimetres > 0) & (millimetres <= np.iinfo(np.uint16).max)
    return np.where(known, millimetres, 0).astype(np.uint16)
