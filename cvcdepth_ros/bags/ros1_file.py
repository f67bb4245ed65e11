# SPDX-License-Identifier: Apache-2.0
"""Reading of one ROS 1 .bag file, whole, cut or never closed, see `BlockFile`.

Its messages are converted to CDR, its types to their ROS 2 form.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags.blocks import Block, BlockFile, ReadChannel
from cvcdepth_ros.bags.definitions import normal_type_name
from cvcdepth_ros.bags.recent_blocks import StoredMessage
from cvcdepth_ros.bags.ros1_messages import Ros1Converter, ros1_definition
from cvcdepth_ros.bags.ros1_records import (
    DAMAGE,
    Op,
    Record,
    chunk_content,
    data_of,
    fields_in,
    read_record,
    records_in,
)
from cvcdepth_ros.bags.topics import LATCHED, Topic, error_text, joined_topics

MAGIC = b"#ROSBAG V2.0\n"
_MD5_OF_NOTHING = "d41d8cd98f00b204e9800998ecf8427e"
_PAIR_BYTES = 8
# The same message, from before tf2.
_LATER_NAMES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}


class _Connection(NamedTuple):
    """What a publisher said of a topic."""

    topic: str
    type: str
    md5sum: str
    definition: str
    latched: bool


@dataclass
class _Index:
    """What is known of a file's content."""

    connections: dict[int, _Connection] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    """Messages per connection."""
    blocks: list[Block] = field(default_factory=list)
    chunks: int = 0
    """Entries of the file's own index, also those of chunks without messages."""


class Ros1File(BlockFile):
    """One .bag file, see `RecordingFile`."""

    path: Path

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.size = path.stat().st_size
        with path.open("rb") as stream:
            index = self._indexed(stream)
            if index is None:
                self.indexed, index = False, self._scanned(stream)
            else:
                self._declared = index.counts
        self._blocks = index.blocks
        self._set_span()
        self._set_topics(index)

    def _intact_messages(self, stream: IO[bytes], offset: int) -> Sequence[StoredMessage]:
        try:
            record = read_record(stream, offset, self.size)
            if record is None:
                raise ValueError("no whole record there")
            return _messages_in(_inner_records(record, data_of(stream, record)))
        except DAMAGE as error:
            self._report(f"chunk at byte {offset} skipped", error)
            return []

    def _indexed(self, stream: IO[bytes]) -> _Index | None:
        """Read the index at the end of the file; None when there is none or it does not fit the file."""
        try:
            bag = read_record(stream, len(MAGIC), self.size)
        except DAMAGE as error:
            raise RecordingError(f"{self.path}: {error_text(error)}") from error
        if bag is None:
            return None
        if bag.fields.get("encryptor"):
            raise RecordingError(f"{self.path}: is encrypted by {bag.text('encryptor'):.40}")
        try:
            position = bag.number("index_pos")
            return self._index_at(stream, position, bag) if position else None
        except DAMAGE as error:
            self._report("index unreadable", error)
            return None

    def _index_at(self, stream: IO[bytes], position: int, bag: Record) -> _Index:
        index = _Index()
        while position < self.size and (record := read_record(stream, position, self.size)) is not None:
            if record.op == Op.CONNECTION:
                _add_connection(index, record, data_of(stream, record))
            elif record.op == Op.CHUNK_INFO:
                _add_chunk(index, record, data_of(stream, record))
            position = record.end
        wanted = bag.number("conn_count"), bag.number("chunk_count")
        found = len(index.connections), index.chunks
        if found != wanted:
            raise ValueError(f"{found[0]} connections and {found[1]} chunks, want {wanted[0]} and {wanted[1]}")
        if len({block.offset for block in index.blocks}) < len(index.blocks):
            raise ValueError("it lists chunks more than once: they overlap")
        return index

    def _scanned(self, stream: IO[bytes]) -> _Index:
        """Walk through the records from the beginning and index what is whole."""
        index = _Index()
        offset, reason = len(MAGIC), ""
        while offset < self.size:
            try:
                record = read_record(stream, offset, self.size)
            except DAMAGE as error:
                record, reason = None, f" ({error_text(error)})"
            before = index.counts.total(), len(index.blocks)
            if record is not None:
                self._add_record(stream, index, offset, record)
            if record is None or record.is_cut:
                of_cut = index.counts.total() - before[0]
                self._report(
                    f"cut or unreadable from byte {offset} of {self.size} on{reason}, no index: "
                    f"{before[0]} messages of the {before[1]} chunks before it recovered"
                    + (f", and {of_cut} of the one that is cut" if of_cut else "")
                )
                break
            offset = record.end
        return index

    def _add_record(self, stream: IO[bytes], index: _Index, offset: int, record: Record) -> None:
        """Add to the index what one record of the file, at `offset`, holds; damage is reported."""
        if record.op not in (Op.CHUNK, Op.MESSAGE, Op.CONNECTION):
            return
        try:
            records = _inner_records(record, data_of(stream, record))
            for inner, data in records:
                if inner.op == Op.CONNECTION:
                    _add_connection(index, inner, data)
            messages = _messages_in(records)
        except DAMAGE as error:
            self._report(f"chunk at byte {offset} skipped", error)
            return
        if messages:
            times = [message.log_time for message in messages]
            channels = Counter(message.channel for message in messages)
            index.counts.update(channels)
            index.blocks.append(Block(min(times), max(times), offset, frozenset(channels)))

    def _set_topics(self, index: _Index) -> None:
        """Describe every readable topic; the others are reported."""
        found: dict[int, Topic] = {}
        for id_, count in {**dict.fromkeys(index.connections, 0), **index.counts}.items():
            connection = index.connections.get(id_)
            try:
                if connection is None:
                    raise ValueError("no connection record says what they are")  # noqa: TRY301
                found[id_] = _topic(connection, count)
            except ValueError as error:
                what = connection.topic if connection else f"connection {id_}"
                self._report(f"left out {what}: {count} messages", error)
        self.topics, names = joined_topics([*found.values()])
        converter = Ros1Converter(self.topics.values())
        for (id_, topic), name in zip(found.items(), names, strict=True):
            self._channels[id_] = ReadChannel(name, converter.to_cdr(topic.type))


def _inner_records(record: Record, data: bytes) -> list[tuple[Record, bytes]]:
    """Return the records of a chunk with their data; a record that is no chunk holds only itself."""
    if record.op != Op.CHUNK:
        return [(record, data)]
    content = chunk_content(record, data)
    return [(inner, content[inner.start : inner.end]) for inner in records_in(content, record.is_cut)]


def _messages_in(records: Sequence[tuple[Record, bytes]]) -> list[StoredMessage]:
    return [
        StoredMessage(record.number("conn"), record.time("time"), data)
        for record, data in records
        if record.op == Op.MESSAGE
    ]


def _add_connection(index: _Index, record: Record, data: bytes) -> None:
    said = Record(fields_in(data), 0, 0)
    # The topic of the record's own header is the one that was subscribed to.
    topic = record.text("topic") or said.text("topic")
    parts = [part for part in topic.split("/") if part]
    name = "/" * topic.startswith("/") + "/".join(parts)
    type_, definition = normal_type_name(said.text("type")), said.text("message_definition")
    type_ = _LATER_NAMES.get(type_, type_)
    latched = said.text("latching") == "1"
    index.connections[record.number("conn")] = _Connection(name, type_, said.text("md5sum"), definition, latched)


def _add_chunk(index: _Index, record: Record, data: bytes) -> None:
    """Add what a chunk info record says: where the chunk is, when it begins and ends, how many messages it has."""
    pairs = range(0, min(record.number("count") * _PAIR_BYTES, len(data)), _PAIR_BYTES)
    counts = {
        int.from_bytes(data[at : at + 4], "little"): int.from_bytes(data[at + 4 : at + 8], "little") for at in pairs
    }
    index.chunks += 1
    index.counts.update(counts)
    if not counts:
        return
    start, end = record.time("start_time"), record.time("end_time")
    index.blocks.append(Block(start, end, record.number("chunk_pos"), frozenset(counts)))


def _topic(connection: _Connection, count: int) -> Topic:
    """Describe a topic; raises ValueError where its type cannot be known."""
    # The definition of a type without fields is empty, and so is one that is missing; the sum tells the two apart.
    is_empty = connection.md5sum == _MD5_OF_NOTHING
    definition = ros1_definition(connection.definition or "\n" * is_empty, connection.type)
    return Topic(connection.topic, connection.type, count, (LATCHED,) if connection.latched else None, definition)
