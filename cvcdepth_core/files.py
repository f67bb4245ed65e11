# SPDX-License-Identifier: Apache-2.0
"""Files: what is written appears on the disk whole or not at all; YAML from strangers is read within bounds.

Of YAML only plain values are taken, of a size that their text accounts for.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from cvcdepth_core.errors import OutputError

_MERGE_TAG = "tag:yaml.org,2002:merge"
_MAX_MERGED = 10_000


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


def nan_to_null(numbers: Mapping[str, float]) -> dict[str, float | None]:
    """Return the numbers for JSON, which has no NaN: None, its null, in the place of each."""
    return {name: None if math.isnan(number) else number for name, number in numbers.items()}


def load_yaml(text: str) -> Any:
    """Return what `yaml.safe_load` returns. Whatever is wrong with the text, YAMLError is raised."""
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError:
        raise
    except Exception as error:  # PyYAML lets through what its conversions raise, RecursionError included
        raise yaml.YAMLError(f"{type(error).__name__}: {error}") from error


def _flush_directory(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class _Loader(yaml.SafeLoader):
    """SafeLoader that counts merged entries (`<<`) before it makes them: a few lines of text can make billions."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._merged = 0

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        for key, value in node.value:
            if key.tag == _MERGE_TAG:
                for part in value.value if isinstance(value, yaml.SequenceNode) else [value]:
                    self._count(part)
        super().flatten_mapping(node)

    def _count(self, merged: yaml.Node) -> None:
        if not isinstance(merged, yaml.MappingNode):
            return  # PyYAML refuses it
        self.flatten_mapping(merged)
        self._merged += len(merged.value)
        if self._merged > _MAX_MERGED:
            raise yaml.YAMLError(f"more than {_MAX_MERGED} entries are merged (<<)")
