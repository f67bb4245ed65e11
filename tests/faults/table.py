# SPDX-License-Identifier: Apache-2.0
"""Collects what the tests of the faults measured, for the table in docs/reliability.md."""

from pathlib import Path
from typing import NamedTuple

NODE = "the node, over DDS"


class Row(NamedTuple):
    """One fault."""

    name: str
    given_to: str
    reaction: str
    told: float
    """Seconds until it was reported."""
    recovered: float | None
    """Seconds from its end until all was well again; None where nothing goes on."""


class FaultTable:
    """Rows in the order in which the faults were injected."""

    def __init__(self) -> None:
        self._rows: list[Row] = []

    def add(self, name: str, given_to: str, reaction: str, told: float, recovered: float | None = None) -> None:
        self._rows.append(Row(name, given_to, " ".join(reaction.split()), told, recovered))

    def write(self, path: Path) -> None:
        """Append the rows as a Markdown table."""
        lines = ["| fault | given to | reaction | told after (s) | well again after (s) |", "|---|---|---|---|---|"]
        lines += [
            f"| {row.name} | {row.given_to} | {_shortened(row.reaction)} | {row.told:.1f} | {_seconds(row.recovered)} |"
            for row in self._rows
        ]
        with path.open("a") as file:
            file.write("\n".join(lines) + "\n\n")


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _shortened(text: str) -> str:
    text = text.replace("|", "\\|").replace("<", "&lt;")
    return text if len(text) <= 160 else f"{text[:157]}..."
