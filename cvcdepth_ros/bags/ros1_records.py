# SPDX-License-Identifier: Apache-2.0
"""The records of a ROS 1 bag (https://wiki.ros.org/Bags/Format/2.0), taken apart within limits."""

import bz2
import io
import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import IO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]

from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags.topics import MAX_BLOCK_BYTES

DAMAGE = (ValueError, LookupError, struct.error, EOFError, RuntimeError, OSError, MemoryError)
"""What is raised on damaged bytes (bz2: EOFError and OSError, lz4: RuntimeError)."""

_MAX_HEADER_BYTES = 2**20  # real ones take some hundred
_MAX_CHUNK_RECORDS = 2**20
_COMPRESSIONS = ("bz2", "lz4")


class Op(IntEnum):
    """What a record is."""

    MESSAGE = 2
    BAG = 3
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


class Record(NamedTuple):
    """A record's header, and where its data are."""

    fields: dict[str, bytes]
    start: int
    """Byte of its data."""
    end: int
    is_cut: bool = False
    """Whether more was to come."""

    @property
    def op(self) -> int:
        """An `Op`, or a number that is none."""
        return self.fields["op"][0] if self.fields.get("op") else 0

    def number(self, name: str) -> int:
        """Return an unsigned field of 4 or 8 bytes; ValueError names one that is missing or of another size."""
        content = self.fields.get(name, b"")
        if len(content) not in (4, 8):
            raise ValueError(f"field '{name}' has {len(content)} bytes, want 4 or 8")
        return int.from_bytes(content, "little")

    def time(self, name: str) -> int:
        """Return a field with a time in nanoseconds; ValueError names one that is missing or of another size."""
        content = self.fields.get(name, b"")
        if len(content) != 8:
            raise ValueError(f"field '{name}' has {len(content)} bytes, want 8")
        seconds, nanoseconds = struct.unpack("<II", content)
        return int(seconds) * NANOSECONDS + int(nanoseconds)

    def text(self, name: str) -> str:
        """Return a field as text, empty where it is missing; comments in definitions are of any character set."""
        return self.fields.get(name, b"").decode(errors="replace")


def read_record(stream: IO[bytes], offset: int, size: int) -> Record | None:
    """Return the record at `offset`, None when no whole one is there in a stream of `size` bytes.

    Of a chunk the beginning is enough: what was cut when the recorder died holds messages too. A compressed chunk that
    was never finished says that it is empty, and reaches to the end of the file.

    Raises ValueError for a header beyond measure, or that is none.
    """
    stream.seek(offset)
    length = _read_u32(stream)
    if length is None or offset + 8 + length > size:
        return None
    if length > _MAX_HEADER_BYTES:
        raise ValueError(f"header of {length} bytes at byte {offset}; at most {_MAX_HEADER_BYTES} are read")
    fields = fields_in(stream.read(length))
    data = _read_u32(stream)
    start = offset + 8 + length
    if data is None:
        return None
    record = Record(fields, start, start + data)
    is_unfinished = not data and record.op == Op.CHUNK and record.text("compression") in _COMPRESSIONS
    if not is_unfinished and record.end <= size:
        return record
    return record._replace(end=size, is_cut=True) if record.op == Op.CHUNK else None


def data_of(stream: IO[bytes], record: Record) -> bytes:
    """Return what follows a record's header; ValueError for one beyond measure."""
    size = record.end - record.start
    if size > MAX_BLOCK_BYTES:
        raise ValueError(f"record of {size} bytes at byte {record.start}; at most {MAX_BLOCK_BYTES} are read at once")
    stream.seek(record.start)
    return stream.read(size)


def fields_in(header: bytes) -> dict[str, bytes]:
    """Return the fields of a header, or of what a connection record holds; ValueError where they do not fill it."""
    fields = {}
    position = 0
    while position < len(header):
        end = position + 4 + int.from_bytes(header[position : position + 4], "little")
        name, found, value = header[position + 4 : end].partition(b"=")
        if end > len(header) or not found:
            raise ValueError("a header whose fields do not fit")
        fields[name.decode(errors="replace")] = value
        position = end
    return fields


def chunk_content(chunk: Record, data: bytes) -> bytes:
    """Unpack a chunk into no more memory than it announces, whatever is packed in it."""
    compression, size = chunk.text("compression"), chunk.number("size") or chunk.is_cut * MAX_BLOCK_BYTES
    if size > MAX_BLOCK_BYTES:
        raise ValueError(f"{size} bytes; at most {MAX_BLOCK_BYTES} are read at once")
    content = data
    if compression == "bz2":
        content = bz2.BZ2Decompressor().decompress(data, size + 1)
    elif compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
    elif compression != "none":
        raise ValueError(f"compression '{compression:.20}' is neither none, bz2 nor lz4")
    if len(content) != size and not chunk.is_cut:
        raise ValueError(f"does not hold the {size} bytes that it announces")
    return content


def records_in(content: bytes, is_cut: bool) -> Iterator[Record]:
    """Give the records of a chunk's content; ValueError where they do not fill it, or there are endless ones."""
    stream, position = io.BytesIO(content), 0
    for _ in range(_MAX_CHUNK_RECORDS):
        if position >= len(content):
            return
        record = read_record(stream, position, len(content))
        if record is None:
            if is_cut:
                return
            raise ValueError(f"no whole record at byte {position} of its {len(content)}")
        yield record
        position = record.end
    raise ValueError(f"more than {_MAX_CHUNK_RECORDS} records")


def _read_u32(stream: IO[bytes]) -> int | None:
    content = stream.read(4)
    return int.from_bytes(content, "little") if len(content) == 4 else None
