# SPDX-License-Identifier: Apache-2.0
"""Write the corpus' beginnings: small, valid inputs of every kind. Regressions beside them are left as they are."""

import io
import sqlite3
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import zstandard
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from cvcdepth_ros.messages.conversion import bag_message_factory  # noqa: E402

JAZZY = get_typestore(Stores.ROS2_JAZZY)
NOETIC = get_typestore(Stores.ROS1_NOETIC)
RNG = np.random.default_rng(0)


def main() -> None:
    """Write every seed into its target's folder."""
    kinds = {"compressed_images": _pictures(), "raw_images": _raw(), "messages": _messages()}
    kinds |= {"recordings": _recordings(), "metadata": _metadata(), "rig_files": _rigs()}
    for target, seeds in kinds.items():
        folder = HERE / "corpus" / target
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in seeds:
            (folder / f"seed_{name}").write_bytes(content)


def _pictures() -> Iterator[tuple[str, bytes]]:
    colour = RNG.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    pictures = {"colour": colour, "grey": colour[..., 0], "alpha": RNG.integers(0, 256, (9, 7, 4), dtype=np.uint8)}
    pictures["deep"] = RNG.integers(0, 65536, (5, 6), dtype=np.uint16)
    for name, picture in pictures.items():
        yield f"png_{name}", b"\0" + cv2.imencode(".png", picture)[1].tobytes()
    for name, options in {
        "baseline": [],
        "progressive": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
        "restarts": [cv2.IMWRITE_JPEG_RST_INTERVAL, 1],
        "444": [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444],
    }.items():
        yield f"jpeg_{name}", b"\1" + cv2.imencode(".jpg", colour, options)[1].tobytes()
    yield "png_mosaic", b"\x0a" + cv2.imencode(".png", colour[..., 0])[1].tobytes()


def _raw() -> Iterator[tuple[str, bytes]]:
    header = struct.Struct("<BBIIII")
    for encoding, bytes_per_pixel in {0: 3, 3: 4, 5: 1, 6: 2, 8: 1, 9: 2}.items():
        step = 8 * bytes_per_pixel + 3
        yield f"{encoding}", header.pack(encoding, encoding & 1, 8, 4, step, 0) + bytes(4 * step)


def _cdr() -> Iterator[tuple[int, str, bytes]]:
    factory = bag_message_factory()
    intrinsics = np.array([[20.0, 0, 7.5], [0, 20, 5.5], [0, 0, 1]])
    image = RNG.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    made = [
        factory.camera_info(10**9, "f", intrinsics, 12, 16),
        factory.point_cloud(10**9, "f", RNG.normal(size=(3, 4, 4)).astype(np.float32)),
        factory.static_transforms(10**9, "base_link", {"a": np.eye(4), "b": np.eye(4)}),
        factory.colour_image(10**9, "f", image),
    ]
    header = made[0].header
    made.append(
        JAZZY.types["sensor_msgs/msg/CompressedImage"](
            header=header, format="jpeg", data=cv2.imencode(".jpg", image)[1].ravel()
        )
    )
    for number, message in enumerate(made):
        yield number, message.__msgtype__, bytes(JAZZY.serialize_cdr(message, message.__msgtype__))


def _messages() -> Iterator[tuple[str, bytes]]:
    for number, type_name, cdr in _cdr():
        yield type_name.split("/")[-1], bytes([number]) + cdr


def _topics() -> list[tuple[str, str, bytes]]:
    cdr = {type_name: content for _, type_name, content in _cdr()}
    image, info = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
    return [
        ("/tf_static", "tf2_msgs/msg/TFMessage", cdr["tf2_msgs/msg/TFMessage"]),
        *((f"/{name}/camera_info", info, cdr[info]) for name in "ab"),
        *((f"/{name}/image/compressed", image, cdr[image]) for name in "ab"),
    ]


def _recordings() -> Iterator[tuple[str, bytes]]:
    for compression in CompressionType:
        yield f"mcap_{compression.name.lower()}", _mcap(compression=compression)
    yield "mcap_unchunked", _mcap(use_chunking=False)
    yield "mcap_definition", _mcap(b"int32 a")
    whole = _mcap(compression=CompressionType.NONE)
    yield "mcap_cut", whole[: len(whole) * 2 // 3]
    yield "mcap_packed", zstandard.compress(_mcap(compression=CompressionType.NONE))
    with tempfile.TemporaryDirectory() as folder:
        yield "sqlite", _sqlite(Path(folder) / "bag")
        yield "ros1", _ros1(Path(folder) / "a.bag")
        for compression in Ros1Writer.CompressionFormat:
            name = compression.name.lower()
            yield f"ros1_{name}", _ros1(Path(folder) / f"{name}.bag", compression)


def _mcap(definition: bytes = b"", **options: object) -> bytes:
    """One message of each topic; known types need no definition, and code is generated for each that is carried."""
    stream = io.BytesIO()
    writer = Writer(stream, enable_crcs=False, **options)  # type: ignore[arg-type]
    writer.start(profile="ros2", library="seed")
    for time, (topic, type_name, cdr) in enumerate(_topics()):
        schema = writer.register_schema(type_name, "ros2msg", definition)
        writer.add_message(writer.register_channel(topic, "cdr", schema), time, cdr, time)
    writer.finish()
    return stream.getvalue()


def _sqlite(path: Path) -> bytes:
    with Ros2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for time, (topic, type_name, cdr) in enumerate(_topics()):
            connection = writer.add_connection(topic, type_name, msgdef="int32 a\n", rihs01="x")
            writer.write(connection, time, cdr)
    file = path / f"{path.name}.db3"
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM message_definitions")
        database.commit()
        database.execute("PRAGMA page_size=512")
        database.execute("VACUUM")
    return file.read_bytes()


def _ros1(path: Path, compression: Ros1Writer.CompressionFormat | None = None) -> bytes:
    NOETIC.register({"tf2_msgs/msg/TFMessage": JAZZY.fielddefs["tf2_msgs/msg/TFMessage"]})
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        for time, (topic, type_name, cdr) in enumerate(_topics()[:2]):
            connection = writer.add_connection(topic, type_name, typestore=NOETIC)
            writer.write(connection, time, NOETIC_FROM_CDR(cdr, type_name))
    return path.read_bytes()


NOETIC_FROM_CDR = JAZZY.cdr_to_ros1


def _metadata() -> Iterator[tuple[str, bytes]]:
    yield "rosbag2", b"rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths: [a.mcap, ../b.db3]\n"


def _rigs() -> Iterator[tuple[str, bytes]]:
    yield from ((path.stem, path.read_bytes()) for path in sorted((HERE.parent / "config" / "rigs").glob("*.yaml")))
    yield (
        "complete",
        b"""base_frame: base_link
anchor: b
cameras:
  - name: a
    image_topic: /a/image
    calibration: {width: 16, height: 12, k: [20, 0, 7.5, 0, 20, 5.5, 0, 0, 1], d: [0.1, 0, 0, 0]}
    base_T_camera: {translation: [0, 0, 1], rotation: [0, 0, 0, 1]}
    neighbours: [b]
  - name: b
    image_topic: /b/image
    mask: b.png
    calibration: {width: 16, height: 12, k: [20, 0, 7.5, 0, 20, 5.5, 0, 0, 1], distortion_model: equidistant}
    base_T_camera: {translation: [0, 1, 1], rotation: [0.5, 0.5, 0.5, 0.5]}
""",
    )


if __name__ == "__main__":
    main()
