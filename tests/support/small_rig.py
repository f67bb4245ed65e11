# SPDX-License-Identifier: Apache-2.0
"""A made-up vehicle with three cameras, as messages of a few kilobytes, to be stored in every odd way.

The messages are rosbags' objects. `entries` gives the recording; what a test is about is changed before or after.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from recordings import JAZZY, Entry, write_rosbag2
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

BEGIN = 1_800_000_000 * 10**9
WIDTH, HEIGHT = 96, 64
YAWS = {"ahead": 0.0, "port": 1.1, "starboard": -1.1}
"""The cameras, and where they look, radians to the left."""
IMAGE, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
TRANSFORMS, CLOUD = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/PointCloud2"

_NOETIC = get_typestore(Stores.ROS1_NOETIC)
_NOETIC.register({TRANSFORMS: JAZZY.fielddefs[TRANSFORMS]})


def make(type_: str, **fields: Any) -> Any:
    return JAZZY.types[type_](**fields)


def header(time: int, frame: str) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=time // 10**9, nanosec=time % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def entry(topic: str, type_: str, time: int, message: Any) -> Entry:
    return Entry(topic, type_, time, bytes(JAZZY.serialize_cdr(message, type_)))


def picture(camera: str, number: int = 0) -> NDArray[np.uint8]:
    """BGR, smooth and coloured, another for each camera and moment."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    phase = 2 * YAWS.get(camera, 0.5) + 0.2 * number
    waves = [np.sin(columns / 9 + phase + k) + np.cos(rows / 7 - k * phase) for k in range(3)]
    return np.stack([np.uint8(128 + 55 * wave) for wave in waves], axis=-1)


def compressed(time: int, frame: str, bgr: NDArray[np.uint8]) -> Any:
    data = np.frombuffer(cv2.imencode(".jpg", bgr)[1].tobytes(), np.uint8)
    return make(COMPRESSED, header=header(time, frame), format="jpeg", data=data)


def raw(time: int, frame: str, pixels: NDArray[Any], encoding: str = "bgr8", step: int | None = None) -> Any:
    data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
    return make(
        IMAGE,
        header=header(time, frame),
        height=HEIGHT,
        width=WIDTH,
        encoding=encoding,
        is_bigendian=0,
        step=data.size // HEIGHT if step is None else step,
        data=data,
    )


def info(time: int, frame: str, **changes: Any) -> Any:
    k = np.array([50.0, 0, 47.5, 0, 50.0, 31.5, 0, 0, 1])
    fields: dict[str, Any] = {
        "header": header(time, frame),
        "height": HEIGHT,
        "width": WIDTH,
        "distortion_model": "plumb_bob",
        "d": np.zeros(5),
        "k": k,
        "r": np.eye(3).ravel(),
        "p": np.hstack([k.reshape(3, 3), np.zeros((3, 1))]).ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    }
    return make(INFO, **{**fields, **changes})


def transform(
    time: int, parent: str, child: str, xyz: Sequence[float], xyzw: Sequence[float] = (0.0, 0.0, 0.0, 1.0)
) -> Any:
    t = dict(zip("xyz", map(float, xyz), strict=True))
    q = dict(zip("xyzw", map(float, xyzw), strict=True))
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(time, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", **t),
            rotation=make("geometry_msgs/msg/Quaternion", **q),
        ),
    )


def mount(time: int, camera: str, height: float = 1.6) -> Any:
    """Where a camera is on the vehicle: at its middle, looking along its yaw, optical axes (z ahead, y down)."""
    half = YAWS[camera] / 2
    c, s = math.cos(half), math.sin(half)
    # The yaw's quaternion times that of an optical frame that looks ahead, (-0.5, 0.5, -0.5, 0.5).
    xyzw = ((-c - s) / 2, (c - s) / 2, (-c + s) / 2, (c + s) / 2)
    return transform(time, "base_link", f"{camera}_optical", (1.0, 0.0, height), xyzw)


def entries(
    image: str = "/{}/image_raw/compressed",
    image_type: str = COMPRESSED,
    encode: Callable[[int, str, NDArray[np.uint8]], Any] = compressed,
    info_topic: str = "/{}/camera_info",
    change: Callable[[Any], None] | None = None,
    frames: int = 3,
    begin: int = BEGIN,
) -> list[Entry]:
    """The recording; `change` is done to every CameraInfo. Without `info_topic` there are only images."""
    mounts = make(TRANSFORMS, transforms=[mount(begin, camera) for camera in YAWS])
    found = [entry("/tf_static", TRANSFORMS, begin, mounts)] if info_topic else []
    for number in range(frames):
        time = begin + number * 10**8
        if info_topic:
            moved = transform(time, "odom", "base_link", (0.5 * number, 0, 0))
            found.append(entry("/tf", TRANSFORMS, time, make(TRANSFORMS, transforms=[moved])))
        for camera in YAWS:
            frame = f"{camera}_optical"
            if info_topic:
                message = info(time, frame)
                if change:
                    change(message)
                found.append(entry(info_topic.format(camera), INFO, time, message))
            found.append(entry(image.format(camera), image_type, time, encode(time, frame, picture(camera, number))))
    return found


def more_images(
    image: str,
    encode: Callable[[int, str, NDArray[np.uint8]], Any] = compressed,
    image_type: str = COMPRESSED,
    frames: int = 3,
) -> list[Entry]:
    """Further images of the three cameras, without CameraInfo."""
    return entries(image, image_type, encode, info_topic="", frames=frames)


def in_time(*parts: Iterable[Entry]) -> list[Entry]:
    return sorted((found for part in parts for found in part), key=lambda found: found.log_time)


# ROS 1


def ros1_bytes(found: Entry) -> bytes:
    return bytes(JAZZY.cdr_to_ros1(found.cdr, found.type))


def write_ros1(
    path: Path,
    recorded: Iterable[Entry],
    more: Callable[[Ros1Writer], None] | None = None,
    chunk_bytes: int = 4000,
    compression: Ros1Writer.CompressionFormat | None = None,
    changed: Callable[[Entry, bytes], bytes] = lambda _, content: content,
) -> Path:
    """Write a .bag in small chunks; `changed` has the last word on each message's bytes."""
    writer = Ros1Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(compression)
    with writer:
        connections: dict[str, Any] = {}
        for found in recorded:
            if found.topic not in connections:
                connections[found.topic] = writer.add_connection(found.topic, found.type, typestore=_NOETIC)
            writer.write(connections[found.topic], found.log_time, changed(found, ros1_bytes(found)))
        if more:
            more(writer)
    return path


def add_ros1_topic(writer: Ros1Writer, topic: str, type_: str, definition: str, content: bytes, md5: str = "*") -> None:
    writer.write(writer.add_connection(topic, type_, msgdef=definition, md5sum=md5), BEGIN, content)


def ros1_definition(type_: str) -> str:
    return _NOETIC.generate_msgdef(type_)[0]


# MCAP, record by record, for what no writer of a library gives


class McapRecords:
    """Puts together an .mcap of any layout that the specification allows."""

    def __init__(self, padding: bytes = b"") -> None:
        self._content = b"\x89MCAP0\r\n" + _record(1, _text("ros2") + _text("tests"))
        self._padding = padding
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._described = b""
        self._chunks = b""
        self._number_of_chunks = 0
        self._counts: Counter[int] = Counter()
        self._times: list[int] = []

    def outside(self, recorded: Iterable[Entry]) -> McapRecords:
        """Append messages that are in no chunk."""
        for found in recorded:
            self._content += self._description(found) + self._message(found)
        return self

    def chunk(self, recorded: Iterable[Entry], indexed: bool = True) -> McapRecords:
        """Append a chunk, with message indexes behind it or without."""
        body, times, places = b"", [], dict[int, list[tuple[int, int]]]()
        for found in recorded:
            body += self._description(found)
            places.setdefault(self._channels[found.topic], []).append((found.log_time, len(body)))
            body += self._message(found)
            times.append(found.log_time)
        span = struct.pack("<QQ", min(times, default=0), max(times, default=0))
        size = struct.pack("<Q", len(body))
        chunk = _record(6, span + size + struct.pack("<I", zlib.crc32(body)) + _text("") + size + body)
        start = len(self._content)
        self._content += chunk
        offsets = self._message_indexes(places) if indexed else {}
        behind = len(self._content) - start - len(chunk)
        index = span + struct.pack("<QQ", start, len(chunk)) + _map("<HQ", offsets) + struct.pack("<Q", behind)
        self._chunks += _record(8, index + _text("") + size + size)
        self._number_of_chunks += 1
        return self

    def finish(self, path: Path, by_topic: bool = True, miscounted: int = 0) -> Path:
        """Write the file; its statistics count by topic or not, and may count wrong."""
        begin = len(self._content) + len(_record(15, bytes(4)))
        counts = dict(self._counts) if by_topic else {}
        if miscounted and counts:
            counts[1] += miscounted
        numbers = len(self._schemas), len(self._channels), 0, 0, self._number_of_chunks
        statistics = struct.pack("<QHIIII", self._counts.total() + miscounted, *numbers)
        statistics += struct.pack("<QQ", min(self._times), max(self._times)) + _map("<HQ", counts)
        end = _record(15, bytes(4)) + self._described + _record(11, statistics + self._padding) + self._chunks
        footer = _record(2, struct.pack("<QQI", begin, 0, 0))
        path.write_bytes(self._content + end + footer + b"\x89MCAP0\r\n")
        return path

    def _message_indexes(self, places: dict[int, list[tuple[int, int]]]) -> dict[int, int]:
        offsets = {}
        for channel, places_of in places.items():
            offsets[channel] = len(self._content)
            listed = b"".join(struct.pack("<QQ", *place) for place in places_of)
            self._content += _record(7, struct.pack("<HI", channel, len(listed)) + listed)
        return offsets

    def _description(self, found: Entry) -> bytes:
        new = b""
        if found.type not in self._schemas:
            self._schemas[found.type] = len(self._schemas) + 1
            text = JAZZY.generate_msgdef(found.type, ros_version=2)[0]
            schema = struct.pack("<H", self._schemas[found.type]) + _text(found.type) + _text("ros2msg") + _text(text)
            new += _record(3, schema + self._padding)
        if found.topic not in self._channels:
            self._channels[found.topic] = len(self._channels) + 1
            ids = struct.pack("<HH", self._channels[found.topic], self._schemas[found.type])
            new += _record(4, ids + _text(found.topic) + _text("cdr") + bytes(4) + self._padding)
        self._described += new
        return new

    def _message(self, found: Entry) -> bytes:
        channel = self._channels[found.topic]
        self._counts[channel] += 1
        self._times.append(found.log_time)
        return _record(5, struct.pack("<HIQQ", channel, 0, found.log_time, found.log_time) + found.cdr)


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def _map(layout: str, content: dict[int, int]) -> bytes:
    packed = b"".join(struct.pack(layout, *item) for item in content.items())
    return struct.pack("<I", len(packed)) + packed


def write_drive(folder: Path, recorded: Iterable[Entry]) -> Path:
    """A rosbag2 folder."""
    return write_rosbag2(folder / "drive", list(recorded))
