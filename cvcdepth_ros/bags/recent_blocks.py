# SPDX-License-Identifier: Apache-2.0
"""What was read last, kept for whoever reads the same part of a recording again."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable, Sequence

from mcap.records import McapRecord, Message

MESSAGE_BYTES = 256
"""What a message's objects take beside its content."""


class RecentBlocks:
    """The unpacked records of the blocks that were used last, of all files of a process, up to a number of bytes."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._blocks: OrderedDict[Hashable, tuple[int, Sequence[McapRecord]]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> Sequence[McapRecord] | None:
        """Return a block's records, None when they are not kept."""
        with self._lock:
            if key not in self._blocks:
                return None
            self._blocks.move_to_end(key)
            return self._blocks[key][1]

    def put(self, key: Hashable, records: Sequence[McapRecord]) -> None:
        """Keep a block's records, and drop those that were not used for longest until all fit; too large ones too."""
        size = sum(MESSAGE_BYTES + (len(r.data) if isinstance(r, Message) else 0) for r in records)
        with self._lock:
            self._bytes += size - self._blocks.pop(key, (0, ()))[0]
            self._blocks[key] = size, records
            while self._bytes > self._limit:
                _, (dropped, _) = self._blocks.popitem(last=False)
                self._bytes -= dropped
