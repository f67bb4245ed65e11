# SPDX-License-Identifier: Apache-2.0
"""What was read last, kept for whoever reads the same part of a recording again."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable, Sequence
from typing import NamedTuple

MESSAGE_BYTES = 256
"""What a message's objects take beside its content."""


class StoredMessage(NamedTuple):
    """One message as a file holds it."""

    channel: int
    """The file's id of the topic."""
    log_time: int
    """ns."""
    content: bytes


class RecentBlocks:
    """The unpacked messages of the blocks that were used last, of all files of a process, up to a number of bytes."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._blocks: OrderedDict[Hashable, tuple[int, Sequence[StoredMessage]]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> Sequence[StoredMessage] | None:
        """Return a block's messages, None when they are not kept."""
        with self._lock:
            if key not in self._blocks:
                return None
            self._blocks.move_to_end(key)
            return self._blocks[key][1]

    def put(self, key: Hashable, messages: Sequence[StoredMessage]) -> None:
        """Keep a block's messages, and drop those that were not used for longest until all fit; too large ones too."""
        size = sum(MESSAGE_BYTES + len(message.content) for message in messages)
        with self._lock:
            self._bytes += size - self._blocks.pop(key, (0, ()))[0]
            self._blocks[key] = size, messages
            while self._bytes > self._limit:
                _, (dropped, _) = self._blocks.popitem(last=False)
                self._bytes -= dropped
