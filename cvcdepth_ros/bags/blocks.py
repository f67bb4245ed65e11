# SPDX-License-Identifier: Apache-2.0
"""Files that are seen as blocks (a chunk, or a message outside of chunks) that can be read alone: MCAP and ROS 1.

A file's index says where they are; a file without one (cut by a power loss, or still being written) is scanned once
from its beginning. Either way a block that cannot be read is skipped and reported.

Memory is bounded whatever a file declares: no block is larger than `MAX_BLOCK_BYTES` once it is unpacked, and those
that overlap in time, which must be held together, are no larger in all.
"""

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cache, partial
from typing import IO, NamedTuple

from cvcdepth_ros.bags.ordering import Source, in_time_order
from cvcdepth_ros.bags.recent_blocks import MESSAGE_BYTES, RecentBlocks, StoredMessage
from cvcdepth_ros.bags.remote import Location, RemotePath
from cvcdepth_ros.bags.topics import MAX_BLOCK_BYTES, RecordedMessage, RecordingFile

# A window is asked for again and again: for transforms, for CameraInfo, for the pictures of every training sample.
_recent = RecentBlocks(80 * 2**20)
_SHOWN_TOPICS = 3


class Block(NamedTuple):
    """Where a chunk is, or a message outside of chunks."""

    start: int
    """Log time of its first message, ns."""
    end: int
    """Log time of its last message, ns."""
    offset: int
    """Byte at which it begins."""
    channels: frozenset[int]
    """Ids of the channels with messages in it; empty when the index does not say."""
    packed: bool = True
    """Whether it is compressed; so it counts where no index says that it is not."""


class ReadChannel(NamedTuple):
    """Whose messages carry one id."""

    topic: str
    to_cdr: Callable[[bytes], bytes | memoryview] | None = None
    """Converts a message, raising ValueError for one that does not fit its type; None where it is CDR already."""


class BlockFile(RecordingFile):
    """One file of blocks, see `RecordingFile`; subclasses find the blocks and read one."""

    def __init__(self, path: Location) -> None:
        super().__init__(path)
        self._key = object()
        self._held = 0
        self._blocks: Sequence[Block] = ()
        self._channels: dict[int, ReadChannel] = {}
        self._declared: Mapping[int, int] = {}
        """Messages per channel, as the file itself counts them."""

    def messages(self, topics: Collection[str], start: int, stop: int) -> Iterator[RecordedMessage]:
        """Give the messages of `topics` with start <= log_time < stop, in time order."""
        wanted = {id_ for id_, channel in self._channels.items() if channel.topic in topics}
        blocks = [
            block
            for block in self._blocks
            if block.start < stop and block.end >= start and (not block.channels or block.channels & wanted)
        ]
        found: Counter[int] = Counter()
        with ExitStack() as opened:
            stream = _opened_once(self.path, opened)
            for message in in_time_order(
                Source(block.start, partial(self._block_messages, stream, block, wanted, found)) for block in blocks
            ):
                if start <= message.log_time < stop:
                    yield message
        if self.start is not None and self.end is not None and start <= self.start and stop > self.end:
            self._compare_counts(wanted, found)

    @abstractmethod
    def _intact_messages(self, stream: IO[bytes], offset: int) -> Sequence[StoredMessage]:
        """Return the messages of the block at `offset`, none when it is damaged (which is reported)."""

    def _set_span(self) -> None:
        self.start = min((block.start for block in self._blocks), default=None)
        self.end = max((block.end for block in self._blocks), default=None)

    def _block_messages(
        self, stream: Callable[[], IO[bytes]], block: Block, wanted: Collection[int], found: Counter[int]
    ) -> Iterator[RecordedMessage]:
        stored = [message for message in self._kept_messages(stream, block) if message.channel in wanted]
        found.update(message.channel for message in stored)
        size = sum(len(message.content) + MESSAGE_BYTES for message in stored)
        if self._held + size > MAX_BLOCK_BYTES:
            self._report(f"chunk at byte {block.offset} skipped: more than {MAX_BLOCK_BYTES} bytes at the same time")
            return
        self._held += size
        try:
            for message in sorted(stored, key=lambda message: message.log_time):
                yield from self._recorded(message)
        finally:
            self._held -= size

    def _kept_messages(self, stream: Callable[[], IO[bytes]], block: Block) -> Sequence[StoredMessage]:
        """Return what is in a block; what had to be fetched or unpacked is kept for the next time."""
        key = self._key, block.offset
        messages = _recent.get(key)
        if messages is None:
            messages = self._intact_messages(stream(), block.offset)
            if block.packed or isinstance(self.path, RemotePath):
                _recent.put(key, messages)
        return messages

    def _recorded(self, message: StoredMessage) -> Iterator[RecordedMessage]:
        """Give the message as CDR, nothing when it does not fit its type (which is reported)."""
        channel = self._channels[message.channel]
        try:
            cdr = channel.to_cdr(message.content) if channel.to_cdr else message.content
        except ValueError as error:
            self._report(f"{channel.topic} at {message.log_time} ns skipped", error)
            return
        yield RecordedMessage(channel.topic, message.log_time, cdr)

    def _compare_counts(self, wanted: Collection[int], found: Mapping[int, int]) -> None:
        """Report when not as many messages were found as the file itself counts."""
        differing = [id_ for id_ in wanted if found[id_] != self._declared.get(id_, found[id_])]
        told = [f"{self._channels[id_].topic} {found[id_]} of {self._declared[id_]}" for id_ in differing]
        if told:
            more = f" and {len(told) - _SHOWN_TOPICS} more" if len(told) > _SHOWN_TOPICS else ""
            self._report(f"not as many messages as the file itself counts: {', '.join(told[:_SHOWN_TOPICS])}{more}")


def _opened_once(path: Location, opened: ExitStack) -> Callable[[], IO[bytes]]:
    """Return a function that gives the file's stream, opened when it is first asked for and closed with `opened`."""

    @cache
    def stream() -> IO[bytes]:
        return opened.enter_context(path.open("rb"))

    return stream
