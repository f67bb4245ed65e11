# SPDX-License-Identifier: Apache-2.0
"""Recordings for the tests: the shipped sample, and the sample stored and damaged in every other way.

They are made with rosbags, mcap and sqlite3, never with our own reader or writer: those are tested against them.
"""

import itertools
import shutil
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import mcap.writer
import numpy as np
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk
from repository import ROOT
from rosbags.interfaces import ConnectionExtRosbag2, Qos
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

SAMPLE = ROOT / "samples" / "pandaset_002_excerpt"
SAMPLE_MCAP = SAMPLE / "pandaset_002_excerpt.mcap"
CAMERAS = ("front", "front_left", "left", "back", "right", "front_right")

JAZZY = get_typestore(Stores.ROS2_JAZZY)


class Entry(NamedTuple):
    """One message to be stored."""

    topic: str
    type: str
    log_time: int
    cdr: bytes
    qos: tuple[Qos, ...] = ()


def sample_entries(sets: int = 10) -> list[Entry]:
    """The sample's messages in time order; of every topic only as many as belong to the first `sets` sets."""
    entries: list[Entry] = []
    counts: Counter[str] = Counter()
    with Reader(SAMPLE) as reader:
        per_set = {topic: max(1, info.msgcount // 10) for topic, info in reader.topics.items()}
        for connection, log_time, cdr in reader.messages(reader.connections):
            counts[connection.topic] += 1
            if counts[connection.topic] <= sets * per_set[connection.topic]:
                qos = connection.ext.offered_qos_profiles if isinstance(connection.ext, ConnectionExtRosbag2) else []
                entries.append(Entry(connection.topic, connection.msgtype, log_time, bytes(cdr), tuple(qos)))
    return entries


def entries_of(path: Path) -> list[Entry]:
    """All messages of a rosbag2 folder in time order."""
    with Reader(path) as reader:
        return [
            Entry(connection.topic, connection.msgtype, log_time, bytes(cdr))
            for connection, log_time, cdr in reader.messages()
        ]


def write_rosbag2(
    path: Path,
    entries: Iterable[Entry],
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Write a rosbag2 folder."""
    writer = Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for entry in entries:
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(
                    entry.topic, entry.type, typestore=JAZZY, offered_qos_profiles=entry.qos
                )
            writer.write(connections[entry.topic], entry.log_time, entry.cdr)
    return path


def write_mcap(path: Path, entries: Iterable[Entry], by_type: bool = False, **options: Any) -> Path:
    """Write a lone .mcap with the mcap library (`options` are its Writer's); it has checksums, rosbags' has not.

    `by_type` gives each type of a topic a channel of its own.
    """
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, **{"chunk_size": 256 * 1024, **options})
        writer.start(profile="ros2", library="tests")
        channels: dict[tuple[str, str], int] = {}
        for entry in entries:
            key = entry.topic, entry.type * by_type
            if key not in channels:
                definition = JAZZY.generate_msgdef(entry.type, ros_version=2)[0].encode()
                schema = writer.register_schema(entry.type, "ros2msg", definition)
                channels[key] = writer.register_channel(entry.topic, "cdr", schema)
            writer.add_message(channels[key], entry.log_time, entry.cdr, entry.log_time)
        writer.finish()
    return path


def with_raw_images(entries: Iterable[Entry], encoding: str) -> Iterator[Entry]:
    """The same recording with `image_raw` topics (bgr8, rgb8, mono8 or bayer_rggb8) in place of the JPEG ones."""
    for entry in entries:
        yield _raw_image(entry, encoding) if entry.type == "sensor_msgs/msg/CompressedImage" else entry


def _raw_image(entry: Entry, encoding: str) -> Entry:
    compressed: Any = JAZZY.deserialize_cdr(entry.cdr, entry.type)
    pixels = _ENCODERS[encoding](cv2.imdecode(compressed.data, cv2.IMREAD_COLOR))
    type_ = "sensor_msgs/msg/Image"
    image = JAZZY.types[type_](
        header=compressed.header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=pixels.reshape(-1),
    )
    topic = entry.topic.removesuffix("/compressed")
    return entry._replace(topic=topic, type=type_, cdr=bytes(JAZZY.serialize_cdr(image, type_)))


def changed(entries: Iterable[Entry], topic: str, change: Callable[[Any], None]) -> Iterator[Entry]:
    """The same recording after `change` was applied to every message of one topic; arrays are to be replaced."""
    for entry in entries:
        if entry.topic != topic:
            yield entry
            continue
        message = JAZZY.deserialize_cdr(entry.cdr, entry.type)
        change(message)
        yield entry._replace(cdr=bytes(JAZZY.serialize_cdr(message, entry.type)))


def without(entries: Iterable[Entry], *prefixes: str) -> list[Entry]:
    """The same recording without the topics that begin so."""
    return [entry for entry in entries if not entry.topic.startswith(prefixes)]


def restamped(entries: Iterable[Entry], topic: str, stamp: Callable[[int, int], int]) -> Iterator[Entry]:
    """The same recording with other header stamps on one topic: `stamp(number of the message, ns)`; log times stay."""
    count = itertools.count()

    def change(message: Any) -> None:
        time = message.header.stamp
        time.sec, time.nanosec = divmod(stamp(next(count), time.sec * 10**9 + time.nanosec), 10**9)

    return changed(entries, topic, change)


def thinned(entries: Iterable[Entry], every: int) -> list[Entry]:
    """The same recording with every n-th image of each camera only."""
    seen: Counter[str] = Counter()
    kept = []
    for entry in entries:
        seen[entry.topic] += 1
        if "/image_raw" not in entry.topic or (seen[entry.topic] - 1) % every == 0:
            kept.append(entry)
    return kept


def with_gap(entries: Iterable[Entry], topic: str, first: int, last: int) -> Iterator[Entry]:
    """The same recording, in which the messages number `first` to `last` of one topic were lost."""
    number = itertools.count()
    return (entry for entry in entries if entry.topic != topic or not first <= next(number) <= last)


def _bayer_rggb(bgr: Any) -> Any:
    mosaic = np.empty(bgr.shape[:2], np.uint8)
    mosaic[0::2, 0::2] = bgr[0::2, 0::2, 2]
    mosaic[0::2, 1::2] = bgr[0::2, 1::2, 1]
    mosaic[1::2, 0::2] = bgr[1::2, 0::2, 1]
    mosaic[1::2, 1::2] = bgr[1::2, 1::2, 0]
    return mosaic


_ENCODERS: dict[str, Callable[[Any], Any]] = {
    "bgr8": lambda bgr: bgr,
    "rgb8": lambda bgr: cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB),
    "mono8": lambda bgr: cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY),
    "bayer_rggb8": _bayer_rggb,
}


def raw_copy(path: Path, encoding: str, sets: int = 10) -> Path:
    """The sample as a rosbag2 folder with raw images."""
    return write_rosbag2(path, with_raw_images(sample_entries(sets), encoding))


def sqlite_copy(path: Path, sets: int = 10) -> Path:
    """The sample as a rosbag2 folder with sqlite3 storage."""
    return write_rosbag2(path, sample_entries(sets), StoragePlugin.SQLITE3)


def ros1_copy(path: Path, sets: int = 10, compression: Ros1Writer.CompressionFormat | None = None) -> Path:
    """The sample as a ROS 1 bag."""
    noetic = get_typestore(Stores.ROS1_NOETIC)
    noetic.register({"tf2_msgs/msg/TFMessage": JAZZY.fielddefs["tf2_msgs/msg/TFMessage"]})
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        connections: dict[str, Any] = {}
        for entry in sample_entries(sets):
            if entry.topic not in connections:
                latching = 1 if entry.topic == "/tf_static" else None
                connections[entry.topic] = writer.add_connection(
                    entry.topic, entry.type, typestore=noetic, latching=latching
                )
            raw = JAZZY.cdr_to_ros1(entry.cdr, entry.type)
            writer.write(connections[entry.topic], entry.log_time, raw)
    return path


def sqlite_with_types(path: Path, entries: Iterable[Entry]) -> Path:
    """A .db3 in which each type of a topic has a row of its own, as rosbag2 writes it."""
    named = [entry._replace(topic=f"{entry.topic}@{entry.type}") for entry in entries]
    database_path = write_rosbag2(path, named, StoragePlugin.SQLITE3) / f"{path.name}.db3"
    with closing(sqlite3.connect(database_path)) as database:
        database.execute("UPDATE topics SET name = substr(name, 1, instr(name, '@') - 1)")
        database.commit()
    return path


def ros1_with_types(path: Path, entries: Iterable[Entry]) -> Path:
    """A ROS 1 bag in which each type of a topic has a connection of its own."""
    noetic = get_typestore(Stores.ROS1_NOETIC)
    noetic.register({"tf2_msgs/msg/TFMessage": JAZZY.fielddefs["tf2_msgs/msg/TFMessage"]})
    with Ros1Writer(path) as writer:
        connections: dict[str, Any] = {}
        for entry in entries:
            if entry.type not in connections:
                connections[entry.type] = writer.add_connection(entry.topic, entry.type, typestore=noetic)
            writer.write(connections[entry.type], entry.log_time, JAZZY.cdr_to_ros1(entry.cdr, entry.type))
    return path


def ros1_chunk(
    path: Path,
    compression: str,
    size: int,
    packed: bytes,
    messages: int = 1,
    times: int = 1,
    definition: str = "string data\n",
) -> Path:
    """A ROS 1 bag with one chunk, announced to unpack to `size` bytes, that its index lists so many times."""
    chunk = _ros1_record(packed, op=b"\5", compression=compression.encode(), size=_u32(size))
    entries = _ros1_record(bytes(12) * messages, ver=_u32(1), conn=_u32(0), count=_u32(messages), op=b"\4")
    fields = {"topic": b"/a", "type": b"x/A", "md5sum": b"*", "message_definition": definition.encode()}
    connection = _ros1_record(_ros1_header(**fields), op=b"\7", conn=_u32(0), topic=b"/a")
    known = {"op": b"\3", "conn_count": _u32(1), "chunk_count": _u32(times)}
    start = len(b"#ROSBAG V2.0\n" + _ros1_record(b"", **known, index_pos=bytes(8)))
    info = {"op": b"\6", "ver": _u32(1), "chunk_pos": struct.pack("<Q", start), "count": _u32(1)}
    infos = _ros1_record(_u32(0) + _u32(messages), **info, start_time=bytes(8), end_time=bytes(8)) * times
    index = struct.pack("<Q", start + len(chunk) + len(entries))
    beginning = b"#ROSBAG V2.0\n" + _ros1_record(b"", **known, index_pos=index)
    path.write_bytes(beginning + chunk + entries + connection + infos)
    return path


def ros1_message(data: bytes) -> bytes:
    """The first message in the chunk of a ROS 1 bag."""
    return _ros1_record(data, op=b"\2", conn=_u32(0), time=bytes(8))


def _ros1_record(data: bytes, **fields: bytes) -> bytes:
    """One record of a ROS 1 bag."""
    header = _ros1_header(**fields)
    return _u32(len(header)) + header + _u32(len(data)) + data


def _ros1_header(**fields: bytes) -> bytes:
    """The fields of a record's header, or of what a connection record holds, without their length."""
    return b"".join(_u32(len(name) + 1 + len(value)) + name.encode() + b"=" + value for name, value in fields.items())


def _u32(number: int) -> bytes:
    return struct.pack("<I", number)


def split_copy(path: Path, parts: int = 3, sets: int = 10) -> Path:
    """The sample as one rosbag2 folder with several files."""
    entries = sample_entries(sets)
    size = -(-len(entries) // parts)
    path.mkdir()
    names, files, topics = [], [], {}
    for part in range(parts):
        folder = write_rosbag2(path / f"{path.name}_{part}", entries[part * size : (part + 1) * size])
        information = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        shutil.move(folder / f"{folder.name}.mcap", path / f"{folder.name}.mcap")
        shutil.rmtree(folder)
        names += information["relative_file_paths"]
        files += information["files"]
        topics.update({topic["topic_metadata"]["name"]: topic for topic in information["topics_with_message_count"]})
    duration = entries[-1].log_time - entries[0].log_time
    information.update(relative_file_paths=names, files=files, message_count=len(entries))
    information.update(topics_with_message_count=[*topics.values()], duration={"nanoseconds": duration})
    information.update(starting_time={"nanoseconds_since_epoch": entries[0].log_time})
    (path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    return path


def lone_mcap(path: Path) -> Path:
    """The sample's .mcap without its folder."""
    return Path(shutil.copy(SAMPLE_MCAP, path))


def cut(source: Path, path: Path, fraction: float = 0.6) -> Path:
    """The beginning of a file, as a power loss leaves it."""
    content = source.read_bytes()
    path.write_bytes(content[: int(len(content) * fraction)])
    return path


def flipped_byte(source: Path, path: Path, position: int) -> Path:
    """A copy with one byte wrong."""
    content = bytearray(source.read_bytes())
    content[position] ^= 0xFF
    path.write_bytes(content)
    return path


def zstd_file(source: Path, path: Path) -> Path:
    """The file compressed as a whole, as `ros2 bag record --compression-mode file` does."""
    path.write_bytes(zstandard.compress(source.read_bytes()))
    return path


def crashed_sqlite(path: Path, entries: list[Entry], unsaved: int) -> Path:
    """A .db3 as a recorder leaves it when it dies: the last `unsaved` messages are only in the write-ahead log."""
    whole = write_rosbag2(path.with_name("whole"), entries, StoragePlugin.SQLITE3) / "whole.db3"
    with closing(sqlite3.connect(whole)) as database:
        rows = database.execute("SELECT * FROM messages ORDER BY id DESC LIMIT ?", (unsaved,)).fetchall()
        database.execute("DELETE FROM messages WHERE id >= ?", (rows[-1][0],))
        database.commit()
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("PRAGMA wal_autocheckpoint=0")
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", reversed(rows))
        database.commit()
        shutil.copy(whole, path)  # while the recorder still has it open
        shutil.copy(f"{whole}-wal", f"{path}-wal")
    return path


class StoredChunk(NamedTuple):
    """One chunk of an intact .mcap."""

    start: int
    end: int
    messages: list[tuple[str, int]]
    """Topic and log time."""


def stored_chunks(path: Path) -> list[StoredChunk]:
    """All chunks of an intact .mcap: which bytes they occupy and what they hold."""
    chunks = []
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        for index in summary.chunk_indexes:
            stream.seek(index.chunk_start_offset + 9)
            records = breakup_chunk(Chunk.read(ReadDataStream(stream)))
            messages = [(summary.channels[r.channel_id].topic, r.log_time) for r in records if isinstance(r, Message)]
            chunks.append(StoredChunk(index.chunk_start_offset, stream.tell(), messages))
    return chunks
