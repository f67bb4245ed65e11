# SPDX-License-Identifier: Apache-2.0
"""Worlds as YAML text, that can be edited and committed."""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import ValidationError

from cvcdepth_core.errors import ConfigError, first_validation_message
from cvcdepth_core.files import load_yaml, write_atomically
from cvcdepth_core.worlds.description import WorldSpec


def load_world(path: Path) -> WorldSpec:
    """Read a world file. ConfigError names the file, the part and the value that is wrong."""
    try:
        content = load_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"world file {path}: cannot be read: {' '.join(str(error).split())}") from error
    try:
        return WorldSpec.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"world file {path}: {first_validation_message(error)}") from error


def save_world(path: Path, world: WorldSpec, comment: str = "") -> None:
    """Write a world file, `comment` first; `load_world` gives the same world back. OutputError names the file."""
    header = "".join(f"# {line}\n" for line in comment.splitlines())
    write_atomically(path, (header + world_text(world)).encode())


def world_text(world: WorldSpec) -> str:
    """Return the world as YAML, one line for each part where it fits."""
    content = world.model_dump(mode="json", exclude_defaults=True)
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
