# SPDX-License-Identifier: Apache-2.0
"""Values that are kept while they are used, up to a number of bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class RecentlyUsed(Generic[Key, Value]):
    """Values by key; those that were not used for longest make room for others. Threads that share it need a lock."""

    def __init__(self, limit: int) -> None:
        """Keep at most `limit` bytes; 0 keeps nothing."""
        self._limit = limit
        self._values: OrderedDict[Key, tuple[int, Value]] = OrderedDict()
        self._size = 0

    def get(self, key: Key) -> Value | None:
        """Return the value that was put there, None when it is not kept."""
        if key not in self._values:
            return None
        self._values.move_to_end(key)
        return self._values[key][1]

    def put(self, key: Key, value: Value, size: int) -> None:
        """Keep a value of `size` bytes, in the place of an older one; what does not fit is dropped, even this one."""
        self._size += size
        if key in self._values:
            self._size -= self._values.pop(key)[0]
        self._values[key] = size, value
        while self._size > self._limit:
            _, (dropped, _) = self._values.popitem(last=False)
            self._size -= dropped
