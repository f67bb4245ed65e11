# SPDX-License-Identifier: Apache-2.0
"""What a simulation has finished so far, kept beside its output so that a later run goes on from there. No ROS here."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from cvcdepth_core.errors import ConfigError, OutputError
from cvcdepth_core.files import write_atomically
from cvcdepth_ros.simulation.set_messages import Stored

_RECIPE = "recipe.json"
_LENGTH = struct.Struct("<Q")


class Parts:
    """A folder with one file for each finished set."""

    def __init__(self, output: Path, recipe: dict[str, Any]) -> None:
        """Open the folder beside `output`, or create it.

        Raises ConfigError if what is there was begun for another `recipe`.
        """
        self.folder = output.with_name(f"{output.name}.parts")
        path, content = self.folder / _RECIPE, json.dumps(recipe, indent=1, sort_keys=True)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            begun = path.read_text(encoding="utf-8") if path.exists() else None
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be created: {error.strerror or error}") from error
        if begun is None:
            write_atomically(path, content.encode())
        elif begun != content:
            raise ConfigError(f"{self.folder}: begun with other options; remove it, or choose another output")

    def has(self, number: int) -> bool:
        """Whether a set is finished."""
        return self._path(number).exists()

    def save(self, number: int, messages: Iterable[Stored]) -> None:
        """Keep a finished set; its file appears whole or not at all."""
        stored = list(messages)
        index = json.dumps([(m.topic, m.type, m.log_time, len(m.cdr)) for m in stored]).encode()
        write_atomically(self._path(number), b"".join([_LENGTH.pack(len(index)), index, *(m.cdr for m in stored)]))

    def load(self, number: int) -> Iterator[Stored]:
        """Give the messages of a finished set."""
        content = self._path(number).read_bytes()
        (length,) = _LENGTH.unpack_from(content)
        position = _LENGTH.size + length
        for topic, type_name, log_time, size in json.loads(content[_LENGTH.size : position]):
            yield Stored(topic, type_name, log_time, content[position : position + size])
            position += size

    def remove(self) -> None:
        """Delete everything."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, number: int) -> Path:
        return self.folder / f"set_{number:06d}.bin"
