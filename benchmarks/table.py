# SPDX-License-Identifier: Apache-2.0
"""Write the JSON lines of the benchmarks into docs/performance.md, as tables.

    python benchmarks/table.py output/bench/*.jsonl [--page docs/performance.md]

The page's own text stays; between `<!-- bench: NAME -->` and `<!-- end -->` comes the table of benchmark NAME. What is
the same in all lines of a benchmark is said once, below its table. A benchmark without such a place is an error.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_HEADINGS = {
    "case": "",
    "median_ms": "median ms",
    "p95_ms": "p95 ms",
    "cpu_ms": "CPU ms",
    "per_second": "per second",
    "times_baseline": "x baseline",
    "times_baseline_cpu": "x baseline (CPU time)",
    "peak_memory_mb": "peak MB",
}
# Always a column, also where all lines agree.
_COLUMNS = ("case", "median_ms", "p95_ms", "per_second", "times_baseline", "peak_memory_mb")
# In the caption or nowhere, even where lines differ: those of one run differ by nothing that matters.
_SAID_ONCE = ("benchmark", "baseline", "rounds", "machine", "threads", "load_average", "date", "python", "versions")

Line = Mapping[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="+", type=Path, help="files of JSON lines")
    parser.add_argument("--page", type=Path, default=Path(__file__).parents[1] / "docs" / "performance.md")
    arguments = parser.parse_args()
    page = arguments.page.read_text(encoding="utf-8")
    for name, lines in by_benchmark(arguments.results).items():
        page = with_table(page, name, markdown(lines))
    arguments.page.write_text(page, encoding="utf-8")


def by_benchmark(results: Sequence[Path]) -> dict[str, list[Line]]:
    """Read all lines and sort them by what was measured."""
    found: dict[str, list[Line]] = {}
    for path in results:
        for text in path.read_text(encoding="utf-8").splitlines():
            line = json.loads(text)
            found.setdefault(line["benchmark"], []).append(line)
    return found


def with_table(page: str, name: str, table: str) -> str:
    """Put the table in its place on the page; ValueError when there is none."""
    place = re.compile(rf"(<!-- bench: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    written, places = place.subn(lambda found: f"{found[1]}{table}{found[2]}", page)
    if places != 1:
        raise ValueError(f"benchmark {name!r} has {places} places '<!-- bench: {name} -->' on the page, expected 1")
    return written


def markdown(lines: Sequence[Line]) -> str:
    """Lay out a benchmark's lines as a table, and what they have in common as a caption."""
    columns = columns_of(lines)
    rows = [[cell(line.get(column)) for column in columns] for line in lines]
    header = [_HEADINGS.get(column, column.replace("_", " ")) for column in columns]
    text = [f"| {' | '.join(row)} |" for row in (header, ["---"] * len(columns), *rows)]
    return "\n".join([*text, "", caption(lines, columns), ""])


def columns_of(lines: Sequence[Line]) -> list[str]:
    """Name the columns: the usual ones and those in which lines differ."""
    keys = dict.fromkeys(key for line in lines for key in line if key not in _SAID_ONCE)
    return [key for key in keys if key in _COLUMNS or len({json.dumps(line.get(key)) for line in lines}) > 1]


def caption(lines: Sequence[Line], columns: Sequence[str]) -> str:
    """Say what holds for all lines."""
    first = lines[0]
    sizes = [f"{key.replace('_', ' ')} {cell(first[key])}" for key in first if key not in (*columns, *_SAID_ONCE)]
    versions = ", ".join(f"{name} {version}" for name, version in first["versions"].items())
    return (
        f"{first['date']} UTC, {first['machine']}, {first['threads']} threads, load {first['load_average']}; "
        f"medians of {first['rounds']} rounds, baseline: {first['baseline']}{'; ' if sizes else ''}{', '.join(sizes)}; "
        f"Python {first['python']}, {versions}."
    )


def cell(value: object) -> str:
    """Show numbers with three digits that count."""
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
    return "" if value is None else str(value)


if __name__ == "__main__":
    main()
