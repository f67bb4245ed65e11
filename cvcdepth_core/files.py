# SPDX-License-Identifier: Apache-2.0
"""Results appear on the disk whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cvcdepth_core.errors import OutputError


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file that is there whole or as it was before, also when the power fails; OutputError names it.

    Through a link, what it leads to is written; a pipe or a device, which cannot be replaced, is written as it is.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(content)
            return
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
        _flush_directory(target.parent)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a result as `write_atomically` does."""
    write_atomically(path, f"{json.dumps(content, indent=2)}\n".encode())


def _flush_directory(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
