# SPDX-License-Identifier: Apache-2.0
"""Reading of one .mcap file, whole or damaged, see `BlockFile`.

The index at its end is checked against the file: what lies between the chunks that it lists is walked through, for
messages may lie outside of chunks. Its counts are compared with what is read.
"""

import io
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import IO

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics
from mcap.stream_reader import StreamReader

from cvcdepth_ros.bags.blocks import Block, BlockFile, ReadChannel
from cvcdepth_ros.bags.definitions import normal_type_name
from cvcdepth_ros.bags.mcap_records import (
    DAMAGE,
    Record,
    check_described,
    content_at,
    index_counts,
    messages_in,
    parsed,
    record_at,
    records_in,
)
from cvcdepth_ros.bags.recent_blocks import StoredMessage
from cvcdepth_ros.bags.remote import Location
from cvcdepth_ros.bags.ros1_messages import Ros1Converter, ros1_definition
from cvcdepth_ros.bags.topics import MAX_BLOCK_BYTES, Topic, joined_topics, recorded_qos

MAGIC = b"\x89MCAP0\r\n"
_FOOTER_BYTES = 37  # the footer record and the magic after it


@dataclass
class _Summary:
    """The index at the end of a file."""

    begin: int
    """Byte at which it begins."""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    statistics: Statistics | None = None

    @property
    def counts(self) -> dict[int, int]:
        """Messages per channel, empty where they are not told."""
        return self.statistics.channel_message_counts if self.statistics else {}


@dataclass
class _Index:
    """What is known of a file's content."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    """Messages per channel id."""
    blocks: list[Block] = field(default_factory=list)
    described: int = 0
    """Bytes of schemas and channels."""


class McapFile(BlockFile):
    """One .mcap file, see `RecordingFile`."""

    def __init__(self, path: Location) -> None:
        super().__init__(path)
        with path.open("rb") as stream:
            self.size = stream.seek(0, io.SEEK_END)
            summary = self._readable_summary(stream)
            index = self._indexed(stream, summary) if summary else None
            if index is None:
                self.indexed, index = False, self._scanned(stream)
        self._blocks = index.blocks
        self._set_span()
        self._declared = summary.counts if summary else {}
        self._check_total(index, summary)
        self._set_topics(index)

    def _intact_messages(self, stream: IO[bytes], offset: int) -> Sequence[StoredMessage]:
        try:
            record = record_at(stream, offset, self.size)
            if record is None:
                raise McapError("no whole record there")
            return messages_in(content_at(stream, record) or b"")
        except DAMAGE as error:
            self._report(f"chunk at byte {offset} skipped", error)
            return []

    def _readable_summary(self, stream: IO[bytes]) -> _Summary | None:
        """Read the index at the end of the file; None when there is none."""
        stream.seek(max(0, self.size - len(MAGIC)))
        if stream.read() != MAGIC:
            return None
        try:
            return self._summary(stream)
        except DAMAGE as error:
            self._report("index unreadable", error)
            return None

    def _summary(self, stream: IO[bytes]) -> _Summary | None:
        """Collect the records of the index; a chunk, which has no place there, is not unpacked."""
        stream.seek(max(0, self.size - _FOOTER_BYTES))
        footer = next(StreamReader(io.BytesIO(stream.read()), skip_magic=True, emit_chunks=True).records)
        if not isinstance(footer, Footer):
            raise McapError(f"{type(footer).__name__} in place of the footer")
        if not footer.summary_start:
            return None
        length = self.size - footer.summary_start
        if not 0 < length <= MAX_BLOCK_BYTES:
            raise McapError(f"of {length} bytes")
        stream.seek(footer.summary_start)
        section = stream.read(length - len(MAGIC))
        summary = _Summary(footer.summary_start)
        for record in records_in(section):
            _add_to_summary(summary, parsed(section, record))
        return summary

    def _indexed(self, stream: IO[bytes], summary: _Summary) -> _Index | None:
        """Return what the index tells, with what lies outside of its chunks; None when it does not tell all of them."""
        if not _knows_its_channels(summary):
            return None
        chunks = [chunk for chunk in summary.chunks if not _is_to_be_read(chunk, summary)]
        spans = sorted((_span(chunk) for chunk in chunks), key=lambda span: span[0])
        if any(end > start for (_, end), (start, _) in pairwise(spans)):
            return None
        index = _Index(summary.schemas, summary.channels)
        index.blocks += [_block(chunk) for chunk in chunks]
        for begin, end in _gaps(spans, len(MAGIC), summary.begin):
            stopped = self._walk(stream, index, begin, end)
            if stopped is not None:
                self._report(f"no record at byte {stopped}, passed over up to byte {end}")
        self.indexed = len(index.blocks) == len(chunks)
        if not summary.counts:
            self._count(stream, index, chunks)
        index.counts.update({id_: count - index.counts[id_] for id_, count in summary.counts.items()})
        return index

    def _count(self, stream: IO[bytes], index: _Index, chunks: Sequence[ChunkIndex]) -> None:
        """Add the messages of the chunks by the message indexes behind them, without unpacking any."""
        for chunk in chunks:
            stream.seek(chunk.chunk_start_offset + chunk.chunk_length)
            try:
                content = stream.read(min(chunk.message_index_length, MAX_BLOCK_BYTES))
                for channel, count in index_counts(content):
                    index.counts[channel] += count
            except DAMAGE as error:
                self._report(f"message index of the chunk at byte {chunk.chunk_start_offset} unreadable", error)

    def _scanned(self, stream: IO[bytes]) -> _Index:
        """Walk through the records from the beginning and index what is whole."""
        index = _Index()
        end = self._walk(stream, index, len(MAGIC), self.size)
        if end is not None:
            self._report(
                f"cut or unreadable from byte {end} of {self.size} on, no index: "
                f"{index.counts.total()} messages of the {len(index.blocks)} chunks before it recovered"
            )
        return index

    def _walk(self, stream: IO[bytes], index: _Index, offset: int, stop: int) -> int | None:
        """Add the records from one byte to another to the index.

        Return where they could not be followed; None where the messages ended, or `stop` was reached within the file.
        """
        while offset < stop or stop == self.size:
            record = record_at(stream, offset, self.size)
            if record is None:
                return offset
            if record.opcode == Opcode.DATA_END:
                return None
            self._add_record(stream, index, offset, record)
            offset = record.end
        return None

    def _add_record(self, stream: IO[bytes], index: _Index, offset: int, record: Record) -> None:
        """Add to the index what one record of the file, at `offset`, holds; damage is reported."""
        try:
            content = content_at(stream, record)
            if content is None:
                return
            messages = messages_in(content)
            for inner in records_in(content):
                if inner.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._describe(index, content, inner)
        except DAMAGE as error:
            self._report(f"chunk at byte {offset} skipped", error)
            return
        if messages:
            channels = Counter(message.channel for message in messages)
            times = [message.log_time for message in messages]
            index.counts.update(channels)
            index.blocks.append(Block(min(times), max(times), offset, frozenset(channels)))

    def _describe(self, index: _Index, content: bytes, record: Record) -> None:
        """Add a schema or channel to the index; one that cannot be read costs no other."""
        try:
            described = parsed(content, record)
        except DAMAGE as error:
            self._report(f"description of a {'type' if record.opcode == Opcode.SCHEMA else 'topic'} skipped", error)
            return
        _add_description(index, described)

    def _check_total(self, index: _Index, summary: _Summary | None) -> None:
        """Report when the file's own number of all messages is not that of its topics."""
        statistics = summary.statistics if summary else None
        if statistics is not None and statistics.message_count != index.counts.total():
            self._report(
                f"{index.counts.total()} messages found, the file itself counts {statistics.message_count} in all"
            )

    def _set_topics(self, index: _Index) -> None:
        """Describe every readable channel; the others are reported."""
        found = dict(self._readable_channels(index))
        self.topics, names = joined_topics([topic for topic, _ in found.values()])
        converter = Ros1Converter(self.topics.values())
        for (id_, (topic, encoding)), name in zip(found.items(), names, strict=True):
            self._channels[id_] = ReadChannel(name, converter.to_cdr(topic.type) if encoding == "ros1" else None)

    def _readable_channels(self, index: _Index) -> Iterator[tuple[int, tuple[Topic, str]]]:
        for id_, count in index.counts.items():
            channel = index.channels.get(id_)
            schema = index.schemas.get(channel.schema_id) if channel else None
            if channel is None or schema is None or channel.message_encoding not in ("cdr", "ros1"):
                what = (
                    f"{channel.topic} (encoding {channel.message_encoding!r})" if channel else f"unknown channel {id_}"
                )
                self._report(f"left out {what}: {count} messages are neither CDR nor ROS 1 of a known type")
                continue
            try:
                yield id_, (_topic(channel, schema, count), channel.message_encoding)
            except ValueError as error:
                self._report(f"left out {channel.topic}: {count} messages", error)


def _topic(channel: Channel, schema: Schema, count: int) -> Topic:
    """Describe a channel; raises ValueError where the type of its ROS 1 messages cannot be known."""
    type_ = normal_type_name(schema.name)
    definition = schema.data.decode(errors="replace")
    if channel.message_encoding == "ros1":
        definition = ros1_definition(definition, type_)
    qos = recorded_qos(channel.metadata.get("offered_qos_profiles"))
    return Topic(channel.topic, type_, count, qos, definition or None)


def _knows_its_channels(summary: _Summary) -> bool:
    """Say whether the index repeats all channels and schemas, and all chunks; it may leave both out."""
    statistics = summary.statistics
    used = {channel for chunk in summary.chunks for channel in chunk.message_index_offsets} | summary.counts.keys()
    return (
        used <= summary.channels.keys()
        and {channel.schema_id for channel in summary.channels.values()} <= summary.schemas.keys() | {0}
        and (statistics is None or len(summary.chunks) == statistics.chunk_count)
    )


def _is_to_be_read(chunk: ChunkIndex, summary: _Summary) -> bool:
    """Say whether the index leaves open what is in a chunk: topics that nothing else tells, or nothing at all."""
    seems_empty = chunk.message_start_time == chunk.message_end_time == 0
    return not chunk.message_index_offsets and (seems_empty or not summary.counts)


def _span(chunk: ChunkIndex) -> tuple[int, int]:
    """Return the bytes of a chunk with the message indexes behind it."""
    return chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length


def _gaps(spans: Sequence[tuple[int, int]], begin: int, end: int) -> Iterator[tuple[int, int]]:
    """Give the bytes from `begin` to `end` that are in none of the spans, which are sorted."""
    for start, stop in spans:
        if start > begin:
            yield begin, start
        begin = max(begin, stop)
    if end > begin:
        yield begin, end


def _block(chunk: ChunkIndex) -> Block:
    return Block(
        chunk.message_start_time,
        chunk.message_end_time,
        chunk.chunk_start_offset,
        frozenset(chunk.message_index_offsets),
        bool(chunk.compression),
    )


def _add_description(index: _Index, record: object) -> None:
    """Add a schema or channel to the index; chunks repeat them, which takes no more memory."""
    if isinstance(record, Schema):
        index.described += 0 if index.schemas.get(record.id) == record else len(record.name) + len(record.data)
        check_described(index.described)
        index.schemas[record.id] = record
    elif isinstance(record, Channel):
        texts = [record.topic, *record.metadata, *record.metadata.values()]
        index.described += 0 if index.channels.get(record.id) == record else sum(map(len, texts))
        check_described(index.described)
        index.channels[record.id] = record
        index.counts[record.id] += 0


def _add_to_summary(summary: _Summary, record: object) -> None:
    if isinstance(record, Statistics):
        summary.statistics = record
    elif isinstance(record, Schema):
        summary.schemas[record.id] = record
    elif isinstance(record, Channel):
        summary.channels[record.id] = record
    elif isinstance(record, ChunkIndex):
        summary.chunks.append(record)
