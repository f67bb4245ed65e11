# SPDX-License-Identifier: Apache-2.0
"""Reading of one ROS 1 .bag file; its messages are converted to CDR, its types to their ROS 2 form.

Memory is bounded whatever a file declares: no record is larger than `MAX_BLOCK_BYTES`, a chunk unpacks to what it
announces, which is no more than that, or not at all, and the index is read once.
"""

import bz2
import io
import struct
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path, PosixPath
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
from rosbags.interfaces import Connection, ConnectionExtRosbag1
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import Chunk, Header, IndexData
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags.topics import (
    LATCHED,
    MAX_BLOCK_BYTES,
    RecordedMessage,
    RecordingFile,
    Topic,
    error_text,
    joined_topics,
)
from cvcdepth_ros.bags.typestores import parsed_definition, typestore, typestore_for

MAGIC = b"#ROSBAG V2.0\n"
# What rosbags and the decompressors raise on damaged bytes. Its reader also asserts, and looks up connections that the
# file does not have; bz2: EOFError, lz4: RuntimeError.
_DAMAGE = (
    ReaderError,
    SerdeError,
    AssertionError,
    LookupError,
    struct.error,
    ValueError,
    EOFError,
    RuntimeError,
    OSError,
    MemoryError,
)
# The types that ROS 1 lays out differently (the header has a sequence number there) or has built in.
_ROS2_TYPES = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


class Ros1File(RecordingFile):
    """One .bag file, see `RecordingFile`."""

    path: Path

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.size = path.stat().st_size
        try:
            with _BoundedReader(path) as reader:
                self.topics = joined_topics([_topic(connection) for connection in reader.connections], path)
                empty = reader.message_count == 0
                self.start = None if empty else reader.start_time
                self.end = None if empty else reader.end_time - 1
        except _DAMAGE as error:
            raise RecordingError(
                f"{path}: {error_text(error)} (`rosbag reindex` repairs a bag that was cut)"
            ) from error
        except TypesysError as error:
            raise RecordingError(f"{path}: message definition not understood: {error}") from error
        self._typestore = typestore_for(self.topics.values())

    def messages(self, topics: Collection[str], start: int, stop: int) -> Iterator[RecordedMessage]:
        """Give the messages of `topics` with start <= log_time < stop, in time order."""
        count = 0
        with _BoundedReader(self.path) as reader:
            wanted = [connection for connection in reader.connections if connection.topic in topics]
            try:
                for connection, log_time, raw in reader.messages(wanted, start, stop) if wanted else ():
                    cdr = self._typestore.ros1_to_cdr(raw, connection.msgtype)
                    yield RecordedMessage(connection.topic, log_time, cdr)
                    count += 1
            except _DAMAGE as error:
                self._report(f"reading stopped after {count} messages", error)


class _BoundedReader(Reader):
    """rosbags' reader, which alone believes whatever sizes a file declares."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.path = _BoundedPath(path)
        self._unread = path.stat().st_size

    def read_chunk(self) -> Chunk:
        """Read the header of a chunk, which also says to how many bytes it unpacks."""
        assert self.bio
        position = self.bio.tell()
        chunk = super().read_chunk()
        end = self.bio.tell()
        self.bio.seek(position)
        header = Header.read(self.bio)
        self.bio.seek(end)
        unpack = partial(_unpacked, position, header.get_string("compression"), header.get_uint32("size"))
        return chunk._replace(decompressor=unpack)

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Read a record of the index; chunks that lead to each other's would make millions of entries out of one."""
        assert self.bio
        position = self.bio.tell()
        super().read_index_data(pos, indexes)
        self._unread -= self.bio.tell() - position
        if self._unread < 0:
            raise ReaderError("the records of the index are larger than the file: they overlap")


class _BoundedPath(PosixPath):
    """A path whose file gives at most `MAX_BLOCK_BYTES` at once."""

    def open(self, *_: Any) -> "_BoundedFile":  # type: ignore[override]
        return _BoundedFile(super().open("rb", buffering=0))


class _BoundedFile(io.BufferedReader):
    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= MAX_BLOCK_BYTES:
            where = f"record of {size} bytes at byte {self.tell()}"
            raise ValueError(f"{where}; at most {MAX_BLOCK_BYTES} are read at once")  # rosbags replaces its own errors
        return super().read(size)


def _unpacked(position: int, compression: str, size: int, packed: bytes) -> bytes:
    """Decompress a chunk into no more memory than it announces, whatever is packed in it."""
    if size > MAX_BLOCK_BYTES:
        raise ReaderError(f"chunk at byte {position}: {size} bytes; at most {MAX_BLOCK_BYTES} are read at once")
    content = packed
    if compression == "bz2":
        content = bz2.BZ2Decompressor().decompress(packed, size + 1)
    elif compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(packed, size + 1)
    if len(content) != size:
        raise ReaderError(f"chunk at byte {position} does not hold the {size} bytes that it announces")
    return content


def _topic(connection: Connection) -> Topic:
    types = parsed_definition(connection.msgdef.data, connection.msgtype)
    if connection.msgtype not in types:
        raise TypesysError(
            f"that of {connection.msgtype}, which is not complete, has elements without bytes, or is none"
        )
    types.update({name: typestore().fielddefs[name] for name in _ROS2_TYPES})
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    definition, _ = store.generate_msgdef(connection.msgtype, ros_version=2)
    latched = isinstance(connection.ext, ConnectionExtRosbag1) and bool(connection.ext.latching)
    return Topic(connection.topic, connection.msgtype, connection.msgcount, (LATCHED,) if latched else None, definition)
