# SPDX-License-Identifier: Apache-2.0
"""What programs print for people (tables, warnings, progress bars), and the numbers that people give them."""

import argparse
import json
import math
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol


class ProgressBar(Protocol):
    """Takes in how far the work is."""

    def __call__(self, done: float, note: str = "") -> None:
        """Show that `done` of the total is done; `note` is written beside it until there is another."""


@contextmanager
def progress_bar(
    total: float | None,
    unit: str,
    *,
    label: str = "",
    decimals: int = 1,
    quiet: bool = False,
    is_kept: bool = True,
) -> Iterator[ProgressBar]:
    """Give a progress bar, which is drawn where stderr is a terminal and nobody wants it quiet.

    It reads `LABEL:  40%|####   | 4.0 of 10 UNIT [elapsed<remaining]`; without a total it counts. With `is_kept` its
    last state stays on the terminal.
    """
    from tqdm import tqdm  # here, so that `--help` answers at once

    form, total = _bar_format(total, unit, label, decimals), None if total is None else round(total, decimals)
    with tqdm(desc=label, total=total, disable=True if quiet else None, bar_format=form, leave=is_kept) as bar:

        def show(done: float, note: str = "") -> None:
            if note:
                bar.set_postfix_str(note, refresh=False)
            bar.update(done - bar.n)

        yield show


def table(header: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[int] = ()) -> str:
    """Return columns as wide as their widest cell; those of `numbers` (from 0) are aligned at the right."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = (
        "  ".join(
            cell.rjust(width) if column in numbers else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in (header, *rows)
    )
    return "\n".join(line.rstrip() for line in lines)


def print_result(result: Mapping[str, Any], text: str, as_json: bool) -> None:
    """Print a result on stdout: as JSON for programs, or the text for people."""
    print(json.dumps(result, indent=2) if as_json else text)


def warn(text: str) -> None:
    """Print on stderr what is wrong but does not end the program."""
    print(f"warning: {text}", file=sys.stderr)


def positive(text: str) -> float:
    """Return the number above zero that an option's text says; for argparse."""
    number = non_negative(text)
    if number == 0:
        raise argparse.ArgumentTypeError("must be above 0")
    return number


def non_negative(text: str) -> float:
    """Return the number of at least zero that an option's text says; for argparse."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of at least 0")
    return number


def count(text: str) -> int:
    """Return the whole number of at least one that an option's text says; for argparse."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of at least 1")
    return int(text)


def _bar_format(total: float | None, unit: str, label: str, decimals: int) -> str:
    """Return the bar's form in tqdm's language."""
    prefix = "{desc}: " if label else ""
    count = f"{{n:.{decimals}f}}"
    if total is None:
        return f"{prefix}{count} {unit}, {{elapsed}}"
    return f"{prefix}{{percentage:3.0f}}%|{{bar}}| {count} of {{total}} {unit}{{postfix}} [{{elapsed}}<{{remaining}}]"
