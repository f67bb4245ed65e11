# SPDX-License-Identifier: Apache-2.0
"""Reading of one .mcap file, whole or damaged.

The file is seen as blocks (a chunk, or a message outside of chunks) that can be read alone. An intact file's index
says where they are; a file without one (cut by a power loss, or still being written) is scanned once from its
beginning. Either way a block that cannot be read, or whose checksum is wrong, is skipped and reported.

Memory is bounded whatever a file declares: no block is larger than `MAX_BLOCK_BYTES` once it is unpacked, and those
that overlap in time, which must be held together, are no larger in all.
"""

import io
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import IO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary

from cvcdepth_ros.bags.ordering import Source, in_time_order
from cvcdepth_ros.bags.recent_blocks import MESSAGE_BYTES, RecentBlocks
from cvcdepth_ros.bags.remote import Location, RemotePath
from cvcdepth_ros.bags.topics import (
    MAX_BLOCK_BYTES,
    RecordedMessage,
    RecordingFile,
    Topic,
    joined_topics,
    recorded_qos,
)

MAGIC = b"\x89MCAP0\r\n"
MAX_BLOCK_RECORDS = 2**20
# Of all topics and types, which are kept as long as the file is read; a thousand of them take some MB.
_MAX_DESCRIBED_BYTES = 64 * 2**20
_FOOTER_BYTES = 37  # the footer record and the magic after it
# A window is asked for again and again: for transforms, for CameraInfo, for the pictures of every training sample.
_recent = RecentBlocks(80 * 2**20)
_NEEDED = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
_DESCRIBING = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA)
_RECORD_HEADER = struct.Struct("<BQ")  # opcode, length of what follows
# What mcap and the decompressors raise on damaged bytes (lz4: RuntimeError; wrong CRC and text: ValueError).
_DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, RuntimeError, KeyError, OverflowError, MemoryError)


class _Block(NamedTuple):
    start: int
    end: int
    offset: int
    channels: frozenset[int]
    """Ids of the channels with messages in it; empty when the index does not say."""
    packed: bool = True
    """Whether it is compressed; so it counts where no index says that it is not."""


@dataclass
class _Index:
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    """Messages per channel id."""
    blocks: list[_Block] = field(default_factory=list)
    described: int = 0
    """Bytes of schemas and channels."""


class McapFile(RecordingFile):
    """One .mcap file, see `RecordingFile`."""

    def __init__(self, path: Location) -> None:
        super().__init__(path)
        self._key = object()
        with path.open("rb") as stream:
            self.size = stream.seek(0, io.SEEK_END)
            index = self._indexed(stream)
            self.indexed = index is not None
            self._index = index or self._scanned(stream)
        self.start = min((block.start for block in self._index.blocks), default=None)
        self.end = max((block.end for block in self._index.blocks), default=None)
        self.topics = joined_topics([*self._channel_topics()], path)
        self._held = 0

    def messages(self, topics: Collection[str], start: int, stop: int) -> Iterator[RecordedMessage]:
        """Give the messages of `topics` with start <= log_time < stop, in time order."""
        wanted = {id_: channel.topic for id_, channel in self._index.channels.items() if channel.topic in topics}
        blocks = [
            block
            for block in self._index.blocks
            if block.start < stop and block.end >= start and (not block.channels or block.channels & wanted.keys())
        ]
        with ExitStack() as opened:
            stream = _opened_once(self.path, opened)
            for message in in_time_order(
                Source(block.start, partial(self._block_messages, stream, block, wanted)) for block in blocks
            ):
                if start <= message.log_time < stop:
                    yield message

    def _block_messages(
        self, stream: Callable[[], IO[bytes]], block: _Block, wanted: dict[int, str]
    ) -> Iterator[RecordedMessage]:
        found = [
            RecordedMessage(wanted[record.channel_id], record.log_time, record.data)
            for record in self._block_records(stream, block)
            if isinstance(record, Message) and record.channel_id in wanted
        ]
        size = sum(len(message.cdr) + MESSAGE_BYTES for message in found)
        if self._held + size > MAX_BLOCK_BYTES:
            self._report(f"chunk at byte {block.offset} skipped: more than {MAX_BLOCK_BYTES} bytes at the same time")
            return
        self._held += size
        try:
            yield from sorted(found, key=lambda message: message.log_time)
        finally:
            self._held -= size

    def _block_records(self, stream: Callable[[], IO[bytes]], block: _Block) -> Sequence[McapRecord]:
        """Return what is in a block; what had to be fetched or unpacked is kept for the next time."""
        key = self._key, block.offset
        records = _recent.get(key)
        if records is None:
            records = self._intact_records(stream(), block.offset)
            if block.packed or isinstance(self.path, RemotePath):
                _recent.put(key, records)
        return records

    def _indexed(self, stream: IO[bytes]) -> _Index | None:
        """Read the index at the end of the file; None when there is none or it does not cover all messages."""
        stream.seek(max(0, self.size - len(MAGIC)))
        if stream.read() != MAGIC:
            return None
        try:
            summary = self._summary(stream)
        except _DAMAGE as error:
            self._report("index unreadable", error)
            return None
        if summary is None or not _is_complete(summary):
            return None
        return _index_of(summary)

    def _summary(self, stream: IO[bytes]) -> Summary | None:
        """Collect the records of the index; a chunk, which has no place there, is not unpacked."""
        stream.seek(max(0, self.size - _FOOTER_BYTES))
        footer = next(_records(stream.read()))
        if not isinstance(footer, Footer):
            raise McapError(f"{type(footer).__name__} in place of the footer")
        if not footer.summary_start:
            return None
        length = self.size - footer.summary_start
        if not 0 < length <= MAX_BLOCK_BYTES:
            raise McapError(f"of {length} bytes")
        stream.seek(footer.summary_start)
        section = stream.read(length)
        _check_records(memoryview(section)[: -len(MAGIC)])
        summary = Summary()
        for record in _records(section):
            _add_to_summary(summary, record)
        return summary

    def _scanned(self, stream: IO[bytes]) -> _Index:
        """Walk through the records from the beginning and index what is whole."""
        index = _Index()
        offset = len(MAGIC)
        while (header := self._record_header(stream, offset)) and header[0] != Opcode.DATA_END:
            records = self._intact_records(stream, offset)
            try:
                _add_records(index, offset, records)
            except McapError as error:
                self._report(f"chunk at byte {offset} skipped", error)
            offset += _RECORD_HEADER.size + header[1]
        if header is None:
            self._report(
                f"cut or unreadable from byte {offset} of {self.size} on, no index: "
                f"{index.counts.total()} messages of the {len(index.blocks)} chunks before it recovered"
            )
        return index

    def _record_header(self, stream: IO[bytes], offset: int) -> tuple[int, int] | None:
        """Return opcode and length of the record at `offset`, or None when no whole record is there."""
        stream.seek(offset)
        header = stream.read(_RECORD_HEADER.size)
        if len(header) < _RECORD_HEADER.size:
            return None
        opcode, length = _RECORD_HEADER.unpack(header)
        # An opcode of 0 is not in use: it is what a preallocated, never written block reads as.
        return (opcode, length) if opcode and offset + _RECORD_HEADER.size + length <= self.size else None

    def _intact_records(self, stream: IO[bytes], offset: int) -> list[McapRecord]:
        """Return what is in the record at `offset`, nothing when it is damaged (which is reported)."""
        try:
            return self._records_at(stream, offset)
        except _DAMAGE as error:
            self._report(f"chunk at byte {offset} skipped", error)
            return []

    def _records_at(self, stream: IO[bytes], offset: int) -> list[McapRecord]:
        header = self._record_header(stream, offset)
        if header is None:
            raise McapError("no whole record there")
        opcode, length = header
        if opcode not in _NEEDED:
            return []
        _check_size(length)
        _check_described(length if opcode in _DESCRIBING else 0)
        body = ReadDataStream(io.BytesIO(stream.read(length)))
        if opcode == Opcode.CHUNK:
            return _chunk_records(Chunk.read(body))
        if opcode == Opcode.MESSAGE:
            return [Message.read(body, length)]
        return [Schema.read(body) if opcode == Opcode.SCHEMA else Channel.read(body)]

    def _channel_topics(self) -> Iterator[Topic]:
        """Give a topic for every readable channel; the others are reported."""
        for id_, count in self._index.counts.items():
            channel = self._index.channels.get(id_)
            schema = self._index.schemas.get(channel.schema_id) if channel else None
            if channel is None or schema is None or channel.message_encoding != "cdr":
                what = (
                    f"{channel.topic} (encoding {channel.message_encoding!r})" if channel else f"unknown channel {id_}"
                )
                self._report(f"left out {what}: {count} messages are not CDR of a known type")
                continue
            definition = schema.data.decode(errors="replace")
            qos = recorded_qos(channel.metadata.get("offered_qos_profiles"))
            yield Topic(channel.topic, schema.name, count, qos, definition or None)


def _opened_once(path: Location, opened: ExitStack) -> Callable[[], IO[bytes]]:
    """Return a function that gives the file's stream, opened when it is first asked for and closed with `opened`."""

    @cache
    def stream() -> IO[bytes]:
        return opened.enter_context(path.open("rb"))

    return stream


def _is_complete(summary: Summary) -> bool:
    """Say whether the index repeats all channels and knows all chunks; it may leave both out."""
    statistics = summary.statistics
    return (
        statistics is not None
        and len(summary.chunk_indexes) == statistics.chunk_count
        and len({chunk.chunk_start_offset for chunk in summary.chunk_indexes}) == statistics.chunk_count
        and (statistics.chunk_count > 0 or statistics.message_count == 0)
        and statistics.channel_message_counts.keys() <= summary.channels.keys()
        and {channel.schema_id for channel in summary.channels.values()} <= summary.schemas.keys() | {0}
    )


def _index_of(summary: Summary) -> _Index:
    counts = summary.statistics.channel_message_counts if summary.statistics else {}
    blocks = [
        _Block(
            chunk.message_start_time,
            chunk.message_end_time,
            chunk.chunk_start_offset,
            frozenset(chunk.message_index_offsets),
            bool(chunk.compression),
        )
        for chunk in summary.chunk_indexes
    ]
    return _Index(summary.schemas, summary.channels, Counter(counts), blocks)


def _add_records(index: _Index, offset: int, records: list[McapRecord]) -> None:
    """Add to the index what one record of the file, at `offset`, holds."""
    messages = []
    for record in records:
        if isinstance(record, Schema | Channel):
            _describe(index, record)
        elif isinstance(record, Message):
            messages.append((record.log_time, record.channel_id))
    if messages:
        channels = Counter(channel for _, channel in messages)
        index.counts.update(channels)
        index.blocks.append(_Block(min(messages)[0], max(messages)[0], offset, frozenset(channels)))


def _describe(index: _Index, record: Schema | Channel) -> None:
    """Add a schema or channel to the index; chunks repeat them, which takes no more memory."""
    if isinstance(record, Schema):
        known, size = index.schemas.get(record.id) == record, len(record.name) + len(record.data)
    else:
        texts = [record.topic, *record.metadata, *record.metadata.values()]
        known, size = index.channels.get(record.id) == record, sum(map(len, texts))
    index.described += 0 if known else size
    _check_described(index.described)
    if isinstance(record, Schema):
        index.schemas[record.id] = record
    else:
        index.channels[record.id] = record
        index.counts[record.id] += 0


def _records(section: bytes) -> Iterator[McapRecord]:
    return StreamReader(io.BytesIO(section), skip_magic=True, emit_chunks=True).records


def _add_to_summary(summary: Summary, record: McapRecord) -> None:
    if isinstance(record, Statistics):
        summary.statistics = record
    elif isinstance(record, Schema):
        summary.schemas[record.id] = record
    elif isinstance(record, Channel):
        summary.channels[record.id] = record
    elif isinstance(record, ChunkIndex):
        summary.chunk_indexes.append(record)


def _chunk_records(chunk: Chunk) -> list[McapRecord]:
    _check_size(chunk.uncompressed_size)
    content = _unpacked(chunk)
    if len(content) != chunk.uncompressed_size:
        raise McapError(f"holds {len(content)} bytes, announces {chunk.uncompressed_size}")
    _check_records(content)
    return breakup_chunk(replace(chunk, compression="", data=content), validate_crc=True)


def unpack_zstd(packed: bytes | memoryview, most: int) -> bytes:
    """Decompress into no more than `most` bytes, whatever is declared; raises ZstdError."""
    # The library believes a frame's own size before the limit that it is given.
    if zstandard.frame_content_size(packed) > most:
        raise zstandard.ZstdError(f"unpacks to more than {most} bytes")
    return zstandard.decompress(packed, most)


def _unpacked(chunk: Chunk) -> bytes:
    """Decompress a chunk into no more memory than it announces, whatever is packed in it."""
    if chunk.compression == "zstd":
        return unpack_zstd(chunk.data, chunk.uncompressed_size)
    if chunk.compression == "lz4":
        unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, chunk.uncompressed_size)
        return unpacked
    return chunk.data


def _check_records(content: bytes | memoryview) -> None:
    """Refuse to make millions of objects out of one chunk or index."""
    position = described = 0
    for _ in range(MAX_BLOCK_RECORDS):
        if position >= len(content):
            return
        opcode, length = _RECORD_HEADER.unpack_from(content, position)
        position += _RECORD_HEADER.size + length
        described += length if opcode in _DESCRIBING else 0
        _check_described(described)
    raise McapError(f"more than {MAX_BLOCK_RECORDS} records")


def _check_described(size: int) -> None:
    if size > _MAX_DESCRIBED_BYTES:
        raise McapError(f"topics and types of more than {_MAX_DESCRIBED_BYTES} bytes")


def _check_size(length: int) -> None:
    if length > MAX_BLOCK_BYTES:
        raise McapError(f"{length} bytes; at most {MAX_BLOCK_BYTES} are read at once")
