# SPDX-License-Identifier: Apache-2.0
"""Images that the middleware loses on their way to the node: whether it goes on, and what helps. No ROS here."""

import time
from collections.abc import Callable, Mapping

_GOES_ON_SECONDS = 5.0


class TransportLoss:
    """Follows the counts of lost images."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lost: dict[str, int] = {}
        self._grew_at: float | None = None

    def update(self, lost: Mapping[str, int]) -> str:
        """Take the counts by camera as they stand; return what is wrong and what helps while images are being lost."""
        if any(count > self._lost.get(name, 0) for name, count in lost.items()):
            self._grew_at = self._clock()
        self._lost = dict(lost)
        if self._grew_at is None or self._clock() - self._grew_at > _GOES_ON_SECONDS:
            return ""
        told = ", ".join(f"{name} {count}" for name, count in lost.items() if count)
        return (
            f"images are lost on the way to the node ({told}): start the drivers with config/fastdds_large_shm.xml, or "
            "the node with reliable:=true; docs/dds.md has the numbers"
        )
