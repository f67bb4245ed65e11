# SPDX-License-Identifier: Apache-2.0
"""What programs print for people (tables, warnings, progress bars), and the numbers that people give them."""

import argparse
import json
import math
import os
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, Protocol, TextIO

COLUMNS = 80
"""Width that everything for people fits, where it can."""

Style = Literal["bold", "red", "yellow", "green"]
_CODES: Mapping[Style, int] = {"bold": 1, "red": 31, "yellow": 33, "green": 32}
_GAP = 2


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


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[int] = (), apart: int | None = None
) -> str:
    """Return columns as wide as their widest cell; those of `numbers` (from 0) are aligned at the right.

    Where that is wider than the terminal, the first or last column of texts, `apart`, has lines of its own.
    """
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    if apart is not None and sum(widths) + _GAP * (len(widths) - 1) > terminal_width():
        return _table_with_column_apart(header, rows, numbers, apart)
    lines = [_line(row, widths, numbers) for row in (header, *rows)]
    return "\n".join([styled(lines[0], "bold"), *lines[1:]])


def terminal_width() -> int:
    """Return the columns of the terminal that stdout is; 80 where it is none, for whoever reads it later."""
    return shutil.get_terminal_size((COLUMNS, 24)).columns if sys.stdout.isatty() else COLUMNS


def styled(text: str, style: Style, stream: TextIO | None = None) -> str:
    """Return the text as a terminal shows it in bold or in a colour; as it is where `stream` (stdout) has no colours.

    Colours are off where NO_COLOR is set (https://no-color.org) or the terminal is dumb, on where FORCE_COLOR is.
    """
    is_terminal = (stream or sys.stdout).isatty() and os.environ.get("TERM") != "dumb"
    has_colours = not os.environ.get("NO_COLOR") and (is_terminal or bool(os.environ.get("FORCE_COLOR")))
    return f"\033[{_CODES[style]}m{text}\033[0m" if has_colours and text else text


def paragraph(text: str) -> str:
    """Return the text in lines that fit the terminal; what has no spaces, like a path, is not broken."""
    return textwrap.fill(text, terminal_width(), break_long_words=False, break_on_hyphens=False)


def shortened(text: str, width: int) -> str:
    """Return at most `width` characters of a name: its beginning and its end, which tell it from others."""
    if len(text) <= width:
        return text
    end = (width - 1) // 2
    return f"{text[: width - 1 - end]}…{text[len(text) - end :]}"


def print_result(result: Mapping[str, Any], text: str, as_json: bool) -> None:
    """Print a result on stdout: as JSON for programs, or the text for people."""
    print(json.dumps(result, indent=2) if as_json else text)


def warn(text: str) -> None:
    """Print on stderr what is wrong but does not end the program."""
    print(f"{styled('warning:', 'yellow', sys.stderr)} {text}", file=sys.stderr)


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


def share(text: str) -> float:
    """Return the number from zero to below one that an option's text says; for argparse."""
    number = non_negative(text)
    if number >= 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a share, at least 0 and below 1")
    return number


def count(text: str) -> int:
    """Return the whole number of at least one that an option's text says; for argparse."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of at least 1")
    return int(text)


def _line(row: Sequence[str], widths: Sequence[int], numbers: Collection[int]) -> str:
    """Return one row of a table."""
    cells = zip(range(len(row)), row, widths, strict=True)
    return (" " * _GAP).join(c.rjust(w) if i in numbers else c.ljust(w) for i, c, w in cells).rstrip()


def _table_with_column_apart(
    header: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[int], apart: int
) -> str:
    """Return a table in which the first column stands above the others of its row, or the last below."""

    def others(row: Sequence[str]) -> list[str]:
        return ["", *row[1:]] if apart == 0 else [cell for i, cell in enumerate(row) if i != apart]

    lines = table(others(header), [others(row) for row in rows], numbers).splitlines()
    cells = [row[apart] if apart == 0 else f"{' ' * 2 * _GAP}{row[apart]}" for row in rows]
    title = styled(header[apart] if apart == 0 else f"{' ' * 2 * _GAP}{header[apart]}", "bold")
    pairs = zip(lines, [title, *cells], strict=True)
    return "\n".join(text for line, cell in pairs for text in ((cell, line) if apart == 0 else (line, cell)))


def _bar_format(total: float | None, unit: str, label: str, decimals: int) -> str:
    """Return the bar's form in tqdm's language."""
    prefix = "{desc}: " if label else ""
    count = f"{{n:.{decimals}f}}"
    if total is None:
        return f"{prefix}{count} {unit}, {{elapsed}}"
    return f"{prefix}{{percentage:3.0f}}%|{{bar}}| {count} of {{total}} {unit}{{postfix}} [{{elapsed}}<{{remaining}}]"
