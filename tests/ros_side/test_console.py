# SPDX-License-Identifier: Apache-2.0
"""What programs show on a terminal: bars that say how much is done, tables, and numbers that people type."""

import argparse
import fcntl
import os
import pty
import struct
import termios
from contextlib import redirect_stderr
from typing import Any

import pytest

from cvcdepth_ros.console import non_negative, positive, progress_bar, table


def drawn(total: float | None, unit: str, *states: tuple[float, str], **options: Any) -> str:
    """What a terminal of 100 columns gets of a bar that is shown these states."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 100, 0, 0))
    os.set_blocking(ours, False)
    with (
        os.fdopen(ours, "rb") as terminal,
        os.fdopen(theirs, "w", encoding="utf-8") as stderr,
        redirect_stderr(stderr),
    ):
        with progress_bar(total, unit, **options) as show:
            for state in states:
                show(*state)
        return (terminal.read() or b"").decode()


def test_a_bar_tells_label_share_count_total_and_note():
    last = drawn(7.96, "s recorded", (2.0, "12 sets"), label="held-out part").rpartition("held-out part: ")[2]
    assert last.startswith(" 25%|")
    assert "2.0 of 8.0 s recorded, 12 sets [" in last


def test_a_bar_whose_total_nobody_knows_counts():
    assert "playing: 3 sets published, 00:0" in drawn(None, "sets published", (3, ""), label="playing", decimals=0)


def test_a_label_with_braces_is_shown_as_it_is():
    assert "a {bar} and {: " in drawn(2, "recordings", label="a {bar} and {")


def test_a_quiet_bar_draws_nothing():
    assert drawn(2, "recordings", (1, ""), quiet=True) == ""


def test_nothing_is_drawn_where_stderr_is_no_terminal(capsys: pytest.CaptureFixture[str]):
    with progress_bar(2, "recordings") as show:
        show(1)
    assert capsys.readouterr() == ("", "")


def test_a_table_has_columns_as_wide_as_their_cells_and_numbers_at_the_right():
    assert table(("topic", "Hz"), [("/a", "9.5"), ("/camera", "10.0")], numbers=[1]).splitlines() == [
        "topic      Hz",
        "/a        9.5",
        "/camera  10.0",
    ]
    assert table(("topic", "Hz"), []) == "topic  Hz"


@pytest.mark.parametrize("text", ["nan", "inf", "-1", "soon", ""])
def test_what_is_no_number_of_at_least_zero_is_refused(text: str):
    for parse in (positive, non_negative):
        with pytest.raises(argparse.ArgumentTypeError, match="is not a number of at least 0"):
            parse(text)


def test_zero_is_not_above_zero():
    assert non_negative("0") == 0
    with pytest.raises(argparse.ArgumentTypeError, match="must be above 0"):
        positive("0")
