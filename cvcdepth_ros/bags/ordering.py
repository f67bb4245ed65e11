# SPDX-License-Identifier: Apache-2.0
"""Merging of time-ordered sources with flat memory: a source is opened only when its first message is due."""

import heapq
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from cvcdepth_ros.bags.topics import RecordedMessage


class Source(NamedTuple):
    """A file of a recording, or a chunk of a file."""

    start: int
    """No message of this source is older, ns."""
    messages: Callable[[], Iterator[RecordedMessage]]
    """Opens the source; the messages come in time order."""


def in_time_order(sources: Iterable[Source]) -> Iterator[RecordedMessage]:
    """Give the messages of all sources by log time; equal times keep the order of the sources."""
    waiting = sorted(enumerate(sources), key=lambda item: item[1].start, reverse=True)
    active: list[tuple[int, int, RecordedMessage, Iterator[RecordedMessage]]] = []
    while waiting or active:
        while waiting and (not active or waiting[-1][1].start <= active[0][0]):
            rank, source = waiting.pop()
            _advance(active, rank, source.messages())
        if active:
            _, rank, message, rest = heapq.heappop(active)
            yield message
            _advance(active, rank, rest)


def _advance(
    active: list[tuple[int, int, RecordedMessage, Iterator[RecordedMessage]]],
    rank: int,
    messages: Iterator[RecordedMessage],
) -> None:
    message = next(messages, None)
    if message is not None:
        heapq.heappush(active, (message.log_time, rank, message, messages))
