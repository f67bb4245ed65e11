# SPDX-License-Identifier: Apache-2.0
"""Strangers' recordings, rig files and checkpoints given to the real tool: each fault with what the tool must do.

Nothing may execute, hang or take memory without measure; the answer is one line, or a result that tells the damage.
The table in docs/reliability.md is made of these names (`--fault-table FILE`).
"""

import bz2
import json
import os
import pickle
import resource
import sqlite3
import struct
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lz4.frame
import mcap.writer
import numpy as np
import pytest
import recordings
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Schema
from mcap.writer import CompressionType
from recordings import SAMPLE_MCAP, Entry

from cvcdepth_ros.bag_replay import main
from faults.table import FaultTable

MIB = 2**20
CPU_SECONDS = 20.0
FRONT = "/camera/front/image_raw/compressed"
INFO = "/camera/front/camera_info"


@pytest.fixture(scope="module")
def sample() -> list[Entry]:
    return recordings.sample_entries(2)


@dataclass(frozen=True)
class Fault:
    """What is wrong, the command that meets it, and what the command must answer."""

    make: Callable[[Path, list[Entry]], list[str]]
    """Makes the file in a folder and returns the tool's arguments."""
    code: int
    says: str
    """Part of what it prints, to stderr when it fails."""


def _inspected(make: Callable[[Path, list[Entry]], Path]) -> Callable[[Path, list[Entry]], list[str]]:
    return lambda folder, sample: ["inspect", str(make(folder, sample)), "--json"]


def _with_content(name: str, content: bytes) -> Callable[[Path, list[Entry]], list[str]]:
    def make(folder: Path, sample: list[Entry]) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return _inspected(make)


def _mcap(folder: Path, sample: list[Entry], **options: Any) -> Path:
    return recordings.write_mcap(folder / "a.mcap", sample, **options)


def _flipped(folder: Path, sample: list[Entry]) -> Path:
    whole = _mcap(folder, sample, compression=CompressionType.NONE)
    chunk = recordings.stored_chunks(whole)[1]
    return recordings.flipped_byte(whole, folder / "b.mcap", (chunk.start + chunk.end) // 2)


def _chunk_file(path: Path, chunks: list[Chunk]) -> Path:
    """An mcap without index that consists of these chunks."""
    builder = RecordBuilder()
    for chunk in chunks:
        chunk.write(builder)
    path.write_bytes(b"\x89MCAP0\r\n" + builder.end())
    return path


def _packed_zeros(compression: str) -> bytes:
    """A few kilobytes that unpack to 2 GiB."""
    piece, count = bytes(16 * MIB), 128
    if compression == "zstd":
        packer = zstandard.ZstdCompressor().compressobj()
        return b"".join(packer.compress(piece) for _ in range(count)) + packer.flush()
    if compression == "bz2":  # streams one behind the other are one
        return bz2.compress(piece) * count
    with lz4.frame.LZ4FrameCompressor() as packer:
        return packer.begin() + b"".join(packer.compress(piece) for _ in range(count)) + packer.flush()


def _bomb(compression: str, announced: int = 2048 * MIB) -> Callable[[Path, list[Entry]], Path]:
    def make(folder: Path, sample: list[Entry]) -> Path:
        chunk = Chunk(compression, _packed_zeros(compression), 10, 0, 0, announced)
        return _chunk_file(folder / "bomb.mcap", [chunk])

    return make


def _ros1_bomb(compression: str, announced: int = 2048 * MIB) -> Callable[[Path, list[Entry]], Path]:
    def make(folder: Path, sample: list[Entry]) -> Path:
        return recordings.ros1_chunk(folder / "bomb.bag", compression, announced, _packed_zeros(compression))

    return make


def _large_ros1_header(folder: Path, sample: list[Entry]) -> Path:
    with (folder / "a.bag").open("wb") as stream:
        stream.write(b"#ROSBAG V2.0\n" + struct.pack("<I", 1100 * MIB))
        stream.truncate(1200 * MIB)  # of nothing, which takes no place on disk
    return folder / "a.bag"


def _repeated_ros1_index(folder: Path, sample: list[Entry]) -> Path:
    """Nine million messages in 400 kB: the index lists one chunk and its thirty thousand messages again and again."""
    return recordings.ros1_chunk(folder / "a.bag", "none", 1, b"a", messages=30_000, times=300)


def _ros1_nothings(definition: str) -> Callable[[Path, list[Entry]], Path]:
    """A ROS 1 message of four bytes: the number of its elements."""

    def make(folder: Path, sample: list[Entry]) -> Path:
        content = recordings.ros1_message(struct.pack("<I", 300_000_000))
        return recordings.ros1_chunk(folder / "a.bag", "none", len(content), content, definition=definition)

    return make


def _million_records(folder: Path, sample: list[Entry]) -> Path:
    records = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0) * 3_000_000
    chunk = Chunk("zstd", zstandard.compress(records), 10, 0, 0, len(records))
    return _chunk_file(folder / "records.mcap", [chunk])


def _definitions(number: int, size: int) -> Callable[[Path, list[Entry]], Path]:
    """Chunks with one definition each; all are kept until the last message is read."""

    def make(folder: Path, sample: list[Entry]) -> Path:
        return _chunk_file(folder / "definitions.mcap", [_definition(id_, size) for id_ in range(1, number + 1)])

    return make


def _definition(id_: int, size: int) -> Chunk:
    builder = RecordBuilder()
    Schema(id=id_, name="x/msg/A", encoding="ros2msg", data=bytes(size)).write(builder)
    content = builder.end()
    return Chunk("zstd", zstandard.compress(content), 10, 0, 0, len(content))


def _large_summary(folder: Path, sample: list[Entry]) -> Path:
    """The index describes something with 65 MiB of text."""
    with (folder / "a.mcap").open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema("x/msg/A", "ros2msg", b"")
        writer.add_message(writer.register_channel("/a", "cdr", schema, {"a": "a" * 65 * MIB}), 5, bytes(64), 5)
        writer.finish()
    return folder / "a.mcap"


def _overlapping(folder: Path, sample: list[Entry]) -> Path:
    """A hundred chunks of 16 MiB each from the same moment on: all must be held at once."""
    stream = (folder / "overlap.mcap").open("wb")
    writer = mcap.writer.Writer(stream, chunk_size=1, compression=CompressionType.ZSTD)
    writer.start()
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"")
    channel = writer.register_channel("/a", "cdr", schema)
    for number in range(100):
        writer.add_message(channel, number, bytes(16 * MIB), number)
    writer.finish()
    stream.close()
    content = bytearray((folder / "overlap.mcap").read_bytes())
    return _with_all_chunks_at_zero(folder / "overlap.mcap", content)


def _with_all_chunks_at_zero(path: Path, content: bytearray) -> Path:
    position = 8
    while position + 9 <= len(content):
        opcode, length = struct.unpack_from("<BQ", content, position)
        if opcode in (6, 8):  # a chunk, and its entry in the index
            struct.pack_into("<Q", content, position + 9, 0)
        position += 9 + length
    path.write_bytes(content)
    return path


def _summary_of_chunks(folder: Path, sample: list[Entry]) -> Path:
    """The footer says that the index begins where the messages do."""
    path = _mcap(folder, sample)
    content = bytearray(path.read_bytes())
    struct.pack_into("<Q", content, len(content) - 28, 8)
    path.write_bytes(content)
    return path


def _offered_as(profiles: str) -> Callable[[Path, list[Entry]], Path]:
    """One topic's publishers offer this as QoS."""
    return _with_topic(b"", {"offered_qos_profiles": profiles})


def _defined_as(definition: str) -> Callable[[Path, list[Entry]], Path]:
    """The type of one topic is unknown and defined so by the recording."""
    return _with_topic(definition.encode(), {})


def _with_topic(definition: bytes, metadata: dict[str, str]) -> Callable[[Path, list[Entry]], Path]:
    def make(folder: Path, sample: list[Entry]) -> Path:
        with (folder / "a.mcap").open("wb") as stream:
            writer = mcap.writer.Writer(stream)
            writer.start(profile="ros2")
            schema = writer.register_schema("x/msg/A", "ros2msg", definition)
            writer.add_message(writer.register_channel("/a", "cdr", schema, metadata), 5, bytes(64), 5)
            writer.finish()
        return folder / "a.mcap"

    return make


def _packed_message(folder: Path, sample: list[Entry]) -> Path:
    bomb = zstandard.compress(bytes(1024 * MIB))
    return recordings.write_rosbag2(folder / "bag", [*sample, sample[-1]._replace(cdr=bomb)])


def _packed_file(folder: Path, sample: list[Entry]) -> Path:
    (folder / "bag.mcap.zstd").write_bytes(zstandard.compress(bytes(1024 * MIB)))
    return folder / "bag.mcap.zstd"


def _with_metadata(text: str) -> Callable[[Path, list[Entry]], Path]:
    def make(folder: Path, sample: list[Entry]) -> Path:
        bag = recordings.write_rosbag2(folder / "bag", sample)
        (bag / "metadata.yaml").write_text(text)
        return bag

    return make


def _file_packed_twice(folder: Path, sample: list[Entry]) -> Path:
    once = recordings.zstd_file(_mcap(folder, sample), folder / "once.mcap.zstd")
    return recordings.zstd_file(once, folder / "twice.mcap.zstd")


def _sqlite(*statements: str) -> Callable[[Path, list[Entry]], Path]:
    def make(folder: Path, sample: list[Entry]) -> Path:
        path = recordings.sqlite_copy(folder / "bag", sets=1) / "bag.db3"
        with closing(sqlite3.connect(path)) as database:
            for statement in statements:
                database.execute(statement)
            database.commit()
        return path

    return make


_ENDLESS = """CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)
SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000000) AS data FROM n"""


def _transforms(change: Callable[[Any], None]) -> Callable[[Path, list[Entry]], list[str]]:
    def make(folder: Path, sample: list[Entry]) -> list[str]:
        bag = recordings.write_rosbag2(folder / "bag", recordings.changed(sample, "/tf_static", change))
        return ["rig", str(bag), "-o", str(folder / "rig.yaml")]

    return make


def _loop(message: Any) -> None:
    first = message.transforms[0]
    first.header.frame_id, first.child_frame_id = "a", "b"
    message.transforms[1].header.frame_id, message.transforms[1].child_frame_id = "b", "a"


def _not_a_unit(message: Any) -> None:
    message.transforms[0].transform.rotation.w = 7.0


def _not_a_number(message: Any) -> None:
    message.transforms[0].transform.translation.x = float("nan")


def _two_parents(message: Any) -> None:
    message.transforms[1].child_frame_id = message.transforms[0].child_frame_id
    message.transforms[1].header.frame_id = "elsewhere"


def _camera_info(change: Callable[[Any], None]) -> Callable[[Path, list[Entry]], list[str]]:
    def make(folder: Path, sample: list[Entry]) -> list[str]:
        bag = recordings.write_rosbag2(folder / "bag", recordings.changed(sample, INFO, change))
        return ["rig", str(bag), "-o", str(folder / "rig.yaml")]

    return make


def _nan_intrinsics(message: Any) -> None:
    message.k = np.full(9, np.nan)


def _million_coefficients(message: Any) -> None:
    message.d = np.zeros(10**6)


def _ran(change: Callable[[Any], None]) -> Callable[[Path, list[Entry]], list[str]]:
    def make(folder: Path, sample: list[Entry]) -> list[str]:
        bag = recordings.write_rosbag2(folder / "bag", recordings.changed(sample, FRONT, change))
        return ["run", str(bag), "-o", str(folder / "out"), "--untrained", "--height", "64", "--width", "96"]

    return make


def _jpeg_bomb(message: Any) -> None:
    jpeg = bytes(message.data)
    frame = jpeg.index(b"\xff\xc0")
    message.data = np.frombuffer(jpeg[: frame + 5] + b"\xfd\xe8\xfd\xe8" + jpeg[frame + 9 :], np.uint8)


def _emptied(message: Any) -> None:
    message.data = np.zeros(0, np.uint8)


def _rig(text: str) -> Callable[[Path, list[Entry]], list[str]]:
    def make(folder: Path, sample: list[Entry]) -> list[str]:
        (folder / "rig.yaml").write_text(text)
        return [
            "run",
            str(recordings.SAMPLE),
            "-o",
            str(folder / "out"),
            "--untrained",
            "--rig",
            str(folder / "rig.yaml"),
        ]

    return make


_LAUGHS = "a0: &a0 [ha, ha, ha, ha, ha, ha, ha, ha, ha]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 10)
)


def _merges(levels: int) -> str:
    """Mappings, each merged from nine times the one before it."""
    merged = (f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 9)}]}}\n" for n in range(1, levels))
    return "a0: &a0 {ha: ha}\n" + "".join(merged)


class _Executes:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {_Executes.marker}",)

    marker = ""


def _checkpoint(name: str, content: bytes | None) -> Callable[[Path, list[Entry]], list[str]]:
    def make(folder: Path, sample: list[Entry]) -> list[str]:
        path = folder / name
        _Executes.marker = str(folder / "executed")
        path.write_bytes(pickle.dumps(_Executes()) if content is None else content)
        return ["run", str(recordings.SAMPLE), "-o", str(folder / "out"), "--checkpoint", str(path)]

    return make


FAULTS = {
    "empty file": Fault(_with_content("a.mcap", b""), 1, "is empty (0 bytes)"),
    "wrong magic": Fault(_with_content("a.mcap", b"GIF89a" + bytes(99)), 1, "begins with b'GIF89a"),
    "only a magic": Fault(_with_content("a.mcap", b"\x89MCAP0\r\n"), 1, "holds no readable message"),
    "file name with newlines": Fault(_with_content("a\nb\nc.mcap", b""), 1, "a b c.mcap: is empty"),
    "cut in the middle": Fault(
        _inspected(lambda f, s: recordings.cut(SAMPLE_MCAP, f / "cut.mcap")), 0, "cut or unreadable from byte"
    ),
    "one byte flipped": Fault(_inspected(_flipped), 0, "skipped"),
    "chunk that unpacks to 2 GiB (zstd)": Fault(_inspected(_bomb("zstd")), 1, "at most 268435456 are read at once"),
    "the same, announced as 1 kB": Fault(_inspected(_bomb("zstd", 1000)), 1, "chunk at byte 8 skipped"),
    "chunk that unpacks to 2 GiB (lz4)": Fault(_inspected(_bomb("lz4")), 1, "at most 268435456 are read at once"),
    "the same in lz4, announced as 1 kB": Fault(_inspected(_bomb("lz4", 1000)), 1, "chunk at byte 8 skipped"),
    "chunk that announces 2^62 bytes": Fault(_inspected(_bomb("lz4", 2**62)), 1, "at most 268435456 are read"),
    "ROS 1 chunk that unpacks to 2 GiB (bz2)": Fault(_inspected(_ros1_bomb("bz2")), 0, "at most 268435456 are read"),
    "the same in bz2, announced as 1 kB": Fault(_inspected(_ros1_bomb("bz2", 1000)), 0, "does not hold the 1000 bytes"),
    "ROS 1 chunk that unpacks to 2 GiB (lz4)": Fault(_inspected(_ros1_bomb("lz4")), 0, "at most 268435456 are read"),
    "ROS 1 chunk in lz4, announced as 1 kB": Fault(
        _inspected(_ros1_bomb("lz4", 1000)), 0, "does not hold the 1000 bytes"
    ),
    "ROS 1 header of 1 GiB": Fault(_inspected(_large_ros1_header), 1, "header of 1153433600 bytes at byte 13"),
    "ROS 1 index that repeats itself": Fault(_inspected(_repeated_ros1_index), 1, "they overlap"),
    "ROS 1 message of 300 million nothings": Fault(
        _inspected(_ros1_nothings(f"y/B[] a\n{'=' * 80}\nMSG: y/B\n")), 0, "elements without bytes"
    ),
    "three million records in a chunk": Fault(_inspected(_million_records), 1, "more than 1048576 records"),
    "25 definitions of 60 MiB": Fault(_inspected(_definitions(25, 60 * MIB)), 1, "topics and types of more than 67"),
    "definition of 65 MiB": Fault(_inspected(_definitions(1, 65 * MIB)), 1, "topics and types of more than 67108864"),
    "channel of 65 MiB": Fault(_inspected(_large_summary), 1, "index unreadable (topics and types of more than 67"),
    "a hundred chunks at the same time": Fault(_inspected(_overlapping), 0, "bytes at the same time"),
    "index that leads to the messages": Fault(_inspected(_summary_of_chunks), 0, '"intact"'),
    "type defined by itself": Fault(_inspected(_defined_as("A a\n")), 0, '"/a"'),
    "type with 2 million strings": Fault(_inspected(_defined_as("string[2000000] a\n")), 0, '"/a"'),
    "type of an unknown type": Fault(_inspected(_defined_as("y/B b\n")), 0, '"/a"'),
    "QoS with a date that is none": Fault(_inspected(_offered_as("- 2001-99-99")), 0, '"/a"'),
    "QoS nested 100 000 deep": Fault(_inspected(_offered_as("[" * 100_000)), 0, '"/a"'),
    "QoS with 43 million merged entries": Fault(_inspected(_offered_as(_merges(9))), 0, '"/a"'),
    "message that unpacks to 1 GiB": Fault(_inspected(_packed_message), 0, "unpacks to more than 268435456 bytes"),
    "file that unpacks to 1 GiB of zeros": Fault(_inspected(_packed_file), 1, "500 times its size"),
    "file that was packed twice": Fault(_inspected(_file_packed_twice), 1, "twice.mcap.zstd (unpacked): begins with"),
    "metadata.yaml with 43 million merged entries": Fault(
        _inspected(_with_metadata(_merges(9))), 0, "metadata.yaml: unreadable (YAMLError)"
    ),
    "view that goes on for ever": Fault(
        _inspected(_sqlite("DROP TABLE messages", _ENDLESS)), 1, "messages is no plain table"
    ),
    "column that computes a gigabyte": Fault(
        _inspected(_sqlite("ALTER TABLE messages ADD COLUMN x BLOB AS (zeroblob(1000000000)) VIRTUAL")),
        1,
        "messages is no plain table",
    ),
    "timestamps that are text": Fault(_inspected(_sqlite("UPDATE messages SET timestamp = 'soon'")), 1, "not integers"),
    "messages that are numbers": Fault(_inspected(_sqlite("UPDATE messages SET data = 7")), 0, "was skipped"),
    "message of 257 MiB": Fault(
        _inspected(_sqlite(f"UPDATE messages SET data = zeroblob({257 * MIB}) WHERE id = 1")),
        0,
        "269484032 bytes; at most 268435456 are read at once",
    ),
    "transforms in a loop": Fault(_transforms(_loop), 1, "closes a loop"),
    "quaternion of length 7": Fault(_transforms(_not_a_unit), 1, "has norm 7"),
    "translation that is no number": Fault(_transforms(_not_a_number), 1, "want 3 + 4 finite numbers"),
    "frame with two parents": Fault(_transforms(_two_parents), 1, "has two parents"),
    "intrinsics that are no numbers": Fault(_camera_info(_nan_intrinsics), 1, "is not finite"),
    "a million distortion coefficients": Fault(_camera_info(_million_coefficients), 1, "1000000 numbers in d"),
    "JPEG of 65000 x 65000": Fault(_ran(_jpeg_bomb), 1, "65000x65000"),
    "images without bytes": Fault(_ran(_emptied), 1, "begins with nothing"),
    "YAML that is no rig": Fault(_rig("- a\n- b\n"), 1, "rig.yaml"),
    "YAML that is no YAML": Fault(_rig("a: [\n"), 1, "cannot be read"),
    "YAML with a billion words": Fault(_rig(f"{_LAUGHS}cameras: *a9\n"), 1, "rig.yaml"),
    "YAML with 43 million merged entries": Fault(_rig(_merges(9)), 1, "more than 10000 entries are merged (<<)"),
    "YAML with a time that is none": Fault(_rig("!!timestamp soon"), 1, "cannot be read"),
    "YAML nested 100 000 deep": Fault(_rig("[" * 100_000), 1, "rig.yaml"),
    "YAML that calls a function": Fault(_rig("!!python/object/apply:os.system [touch executed]"), 1, "cannot be read"),
    "checkpoint that executes (pickle)": Fault(_checkpoint("model.pth", None), 1, "model.pth"),
    "pickle called safetensors": Fault(_checkpoint("model.safetensors", None), 1, "model.safetensors"),
    "checkpoint with a header of 2^60 bytes": Fault(
        _checkpoint("model.safetensors", struct.pack("<Q", 2**60) + bytes(64)), 1, "model.safetensors"
    ),
    "checkpoint cut after its header": Fault(
        _checkpoint("model.safetensors", struct.pack("<Q", 70) + json.dumps({"a": {}}).encode()), 1, "model.safetensors"
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_tool_meets_the_fault_with_one_line_or_a_result_that_tells_it(
    name: str, sample: list[Entry], tmp_path: Path, capsys: pytest.CaptureFixture[str], fault_table: FaultTable
):
    fault = FAULTS[name]
    arguments = fault.make(tmp_path, sample)
    memory, begin, clock = _peak_mib(), time.process_time(), time.monotonic()
    code = main(arguments)
    seconds = time.process_time() - begin
    printed = capsys.readouterr()
    assert code == fault.code, printed
    if code:
        assert len([line for line in printed.err.splitlines() if not line.startswith("warning: untrained")]) == 1
        assert fault.says in printed.err
    else:
        assert fault.says in printed.out
    assert seconds < CPU_SECONDS
    assert _peak_mib() - memory < 1024
    assert not (tmp_path / "executed").exists()
    assert not Path("executed").exists()
    answer = (
        printed.err.rpartition("cvcdepth: ")[2].replace(str(tmp_path), "") if code else f"exit 0, tells `{fault.says}`"
    )
    fault_table.add(name, f"`cvcdepth {arguments[0]}`", answer, time.monotonic() - clock)


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
