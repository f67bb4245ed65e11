# SPDX-License-Identifier: Apache-2.0
"""YAML from strangers: plain values only, of a size that its text accounts for."""

from typing import Any

import yaml

_MERGE_TAG = "tag:yaml.org,2002:merge"
_MAX_MERGED = 10_000


def load_yaml(text: str) -> Any:
    """Return what `yaml.safe_load` returns. Whatever is wrong with the text, YAMLError is raised."""
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError:
        raise
    except Exception as error:  # PyYAML lets through what its conversions raise, RecursionError included
        raise yaml.YAMLError(f"{type(error).__name__}: {error}") from error


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
