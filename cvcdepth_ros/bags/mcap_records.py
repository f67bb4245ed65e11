# SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file (https://mcap.dev/spec), taken apart within limits.

Records longer than what is known of them are of a later version, and what follows the known fields is passed over.
"""

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import IO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Schema, Statistics

from cvcdepth_ros.bags.recent_blocks import StoredMessage
from cvcdepth_ros.bags.topics import MAX_BLOCK_BYTES

KnownRecord = Schema | Channel | ChunkIndex | Statistics

MAX_BLOCK_RECORDS = 2**20
MAX_DESCRIBED_BYTES = 64 * 2**20
"""Of all topics and types, which are kept as long as the file is read; a thousand of them take some MB."""
DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    RuntimeError,
    KeyError,
    OverflowError,
    MemoryError,
)
"""What mcap and the decompressors raise on damaged bytes (lz4: RuntimeError; text that is none: ValueError)."""

_HEADER = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_MESSAGE_INDEX = struct.Struct("<HI")  # channel, bytes of the entries that follow
_INDEX_ENTRY_BYTES = 16
_DESCRIBING = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA)
_READ = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
_KNOWN: dict[int, Callable[[ReadDataStream], KnownRecord]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.STATISTICS: Statistics.read,
}


class Record(NamedTuple):
    """A record and where it is."""

    opcode: int
    start: int
    """Byte of its content, behind opcode and length."""
    end: int


def record_at(stream: IO[bytes], offset: int, size: int) -> Record | None:
    """Return which record begins at `offset`, None when no whole one is there in a file of `size` bytes."""
    stream.seek(offset)
    header = stream.read(_HEADER.size)
    if len(header) < _HEADER.size:
        return None
    opcode, length = _HEADER.unpack(header)
    record = Record(opcode, offset + _HEADER.size, offset + _HEADER.size + length)
    # An opcode of 0 is not in use: it is what a preallocated, never written block reads as.
    return record if opcode and record.end <= size else None


def content_at(stream: IO[bytes], record: Record) -> bytes | None:
    """Return one record of the file as the bytes of whole records, which a chunk holds inside; None for other kinds."""
    length = record.end - record.start
    if record.opcode not in _READ:
        return None
    _check_size(length)
    check_described(length if record.opcode in _DESCRIBING else 0)
    stream.seek(record.start)
    body = stream.read(length)
    if record.opcode == Opcode.CHUNK:
        return _unpacked(Chunk.read(_fields(body)))
    return _HEADER.pack(record.opcode, length) + body


def messages_in(content: bytes) -> list[StoredMessage]:
    """Return the messages of a chunk's content."""
    messages = []
    for opcode, start, end in records_in(content):
        if opcode == Opcode.MESSAGE:
            if end - start < _MESSAGE.size:
                raise McapError(f"a message record of {end - start} bytes")
            channel, _, log_time, _ = _MESSAGE.unpack_from(content, start)
            messages.append(StoredMessage(channel, log_time, content[start + _MESSAGE.size : end]))
    return messages


def records_in(content: bytes) -> Iterator[Record]:
    """Give the records of a chunk's content, or of the index; refuse to make millions of objects out of one."""
    position = described = count = 0
    while position < len(content):
        opcode, length = _HEADER.unpack_from(content, position)
        start = position + _HEADER.size
        position = start + length
        described += length if opcode in _DESCRIBING else 0
        count += 1
        check_described(described)
        if count > MAX_BLOCK_RECORDS:
            raise McapError(f"more than {MAX_BLOCK_RECORDS} records")
        if position > len(content):
            raise McapError(f"a record of {length} bytes does not fit into the {len(content)} around it")
        yield Record(opcode, start, position)


def parsed(content: bytes, record: Record) -> KnownRecord | None:
    """Return a schema, channel or entry of the index; None for other records. Raises some of `DAMAGE`."""
    read = _KNOWN.get(record.opcode)
    return read(_fields(content[record.start : record.end])) if read else None


def index_counts(content: bytes) -> Iterator[tuple[int, int]]:
    """Give channel and number of messages of each message index record behind a chunk."""
    for record in records_in(content):
        if record.opcode == Opcode.MESSAGE_INDEX:
            channel, size = _MESSAGE_INDEX.unpack_from(content, record.start)
            yield channel, size // _INDEX_ENTRY_BYTES


def unpack_zstd(packed: bytes | memoryview, most: int) -> bytes:
    """Decompress into no more than `most` bytes, whatever is declared; raises ZstdError."""
    # The library believes a frame's own size before the limit that it is given.
    if zstandard.frame_content_size(packed) > most:
        raise zstandard.ZstdError(f"unpacks to more than {most} bytes")
    return zstandard.decompress(packed, most)


def _fields(body: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))


def _unpacked(chunk: Chunk) -> bytes:
    """Decompress a chunk into no more memory than it announces, whatever is packed in it."""
    _check_size(chunk.uncompressed_size)
    content = chunk.data
    if chunk.compression == "zstd":
        content = unpack_zstd(chunk.data, chunk.uncompressed_size)
    elif chunk.compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, chunk.uncompressed_size)
    elif chunk.compression:
        raise McapError(f"compression '{chunk.compression:.20}' is neither zstd nor lz4")
    if len(content) != chunk.uncompressed_size:
        raise McapError(f"holds {len(content)} bytes, announces {chunk.uncompressed_size}")
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise McapError(f"its checksum is {zlib.crc32(content)}, not {chunk.uncompressed_crc}")
    return content


def check_described(size: int) -> None:
    """Raise McapError for topics and types beyond measure, in bytes."""
    if size > MAX_DESCRIBED_BYTES:
        raise McapError(f"topics and types of more than {MAX_DESCRIBED_BYTES} bytes")


def _check_size(length: int) -> None:
    if length > MAX_BLOCK_BYTES:
        raise McapError(f"{length} bytes; at most {MAX_BLOCK_BYTES} are read at once")
