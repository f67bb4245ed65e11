# SPDX-License-Identifier: Apache-2.0
"""Collects what the tests of the faults measured, for the table in docs/reliability.md."""

from pathlib import Path
from typing import NamedTuple


class Row(NamedTuple):
    """One fault."""

    kind: str
    name: str
    where: str
    reaction: str
    seconds: float


class FaultTable:
    """Rows in the order in which the faults were injected."""

    def __init__(self) -> None:
        self._rows: list[Row] = []

    def add(self, kind: str, name: str, where: str, reaction: str, seconds: float) -> None:
        self._rows.append(Row(kind, name, where, " ".join(reaction.split()), seconds))

    def write(self, path: Path) -> None:
        """Append the rows as a Markdown table."""
        lines = ["| fault | given to | reaction | seconds |", "|---|---|---|---|"]
        lines += [f"| {r.name} | {r.where} | {_shortened(r.reaction)} | {r.seconds:.1f} |" for r in self._rows]
        with path.open("a") as file:
            file.write("\n".join(lines) + "\n\n")


def _shortened(text: str) -> str:
    text = text.replace("|", "\\|").replace("<", "&lt;")
    return text if len(text) <= 160 else f"{text[:157]}..."
