# SPDX-License-Identifier: Apache-2.0
"""What was read last, kept for whoever reads the same part of a recording again."""

from __future__ import annotations

import threading
from collections.abc import Hashable, Sequence
from typing import NamedTuple

from cvcdepth_ros.recently_used import RecentlyUsed

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
        self._blocks: RecentlyUsed[Hashable, Sequence[StoredMessage]] = RecentlyUsed(limit)
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> Sequence[StoredMessage] | None:
        """Return a block's messages, None when they are not kept."""
        with self._lock:
            return self._blocks.get(key)

    def put(self, key: Hashable, messages: Sequence[StoredMessage]) -> None:
        """Keep a block's messages, and drop those that were not used for longest until all fit; too large ones too."""
        size = sum(MESSAGE_BYTES + len(message.content) for message in messages)
        with self._lock:
            self._blocks.put(key, messages, size)
