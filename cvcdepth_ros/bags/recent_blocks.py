# SPDX-License-Identifier: Apache-2.0
"""What was read last, kept for whoever reads the same part of a recording again."""

from __future__ import annotations

import threading
from collections.abc import Hashable, Sequence

from mcap.records import McapRecord, Message

from cvcdepth_ros.recently_used import RecentlyUsed

MESSAGE_BYTES = 256
"""What a message's objects take beside its content."""


class RecentBlocks:
    """The unpacked records of the blocks that were used last, of all files of a process, up to a number of bytes."""

    def __init__(self, limit: int) -> None:
        self._blocks: RecentlyUsed[Hashable, Sequence[McapRecord]] = RecentlyUsed(limit)
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> Sequence[McapRecord] | None:
        """Return a block's records, None when they are not kept."""
        with self._lock:
            return self._blocks.get(key)

    def put(self, key: Hashable, records: Sequence[McapRecord]) -> None:
        """Keep a block's records, and drop those that were not used for longest until all fit; too large ones too."""
        size = sum(MESSAGE_BYTES + (len(r.data) if isinstance(r, Message) else 0) for r in records)
        with self._lock:
            self._blocks.put(key, records, size)
