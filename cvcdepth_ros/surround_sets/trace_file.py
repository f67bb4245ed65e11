# SPDX-License-Identifier: Apache-2.0
"""A trace of when each stage ran, for https://ui.perfetto.dev or chrome://tracing. No ROS here.

Written as it happens in the array form of Chrome's trace event format, of which the end may be missing: a trace can be
opened whatever ended the program. Its size is bounded; what comes later is left out.
"""

import json
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from cvcdepth_core.errors import OutputError

_LIMIT_BYTES = 64 << 20


class TraceFile:
    """Collects spans of time on the monotonic clock. Thread-safe; a full disk ends the trace, not the program."""

    def __init__(self, path: Path, limit_bytes: int = _LIMIT_BYTES) -> None:
        """Create the file, or truncate it. Raises OutputError when it cannot be written."""
        try:
            self._file = path.open("w", encoding="utf-8")
        except OSError as error:
            raise OutputError(f"trace {path}: cannot be written: {error.strerror}") from error
        self._left = limit_bytes
        self._named: set[int] = set()
        self._lock = threading.Lock()
        self._file.write("[")

    def span(self, name: str, start: float, end: float, **arguments: Any) -> None:
        """Add what the calling thread did between two times of `time.monotonic()`."""
        thread = threading.get_native_id()
        event = {"name": name, "ph": "X", "ts": round(start * 1e6), "dur": round((end - start) * 1e6)}
        with self._lock:
            if thread not in self._named:
                self._named.add(thread)
                self._write({"name": "thread_name", "ph": "M", "args": {"name": threading.current_thread().name}})
            self._write(event | ({"args": arguments} if arguments else {}))

    def flush(self) -> None:
        """Write what is buffered to the disk."""
        with self._lock, suppress(OSError):
            self._file.flush()

    def close(self) -> None:
        """Complete the file."""
        with self._lock:
            self._left = 0
            with suppress(OSError, ValueError):  # what was written can be opened all the same
                self._file.write('{"name": "end", "ph": "M"}]\n')
                self._file.close()

    def _write(self, event: dict[str, Any]) -> None:
        line = json.dumps(event | {"pid": os.getpid(), "tid": threading.get_native_id()}) + ",\n"
        self._left -= len(line)
        if self._left < 0:
            return
        try:
            self._file.write(line)
        except OSError:
            self._left = 0
