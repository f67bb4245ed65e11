# SPDX-License-Identifier: Apache-2.0
"""What programs show on a terminal: bars that say how much is done, tables, and numbers that people type."""

import argparse
import fcntl
import os
import pty
import struct
import termios
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from typing import Any

import pytest

from cvcdepth_ros.console import non_negative, paragraph, positive, progress_bar, shortened, styled, table


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


def on_terminal(columns: int, show: Callable[[], str], monkeypatch: pytest.MonkeyPatch, **environment: str) -> str:
    """What `show` returns where stdout is a terminal of so many columns."""
    for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in ({"TERM": "xterm", "COLUMNS": str(columns)} | environment).items():
        monkeypatch.setenv(name, value)
    ours, theirs = pty.openpty()
    try:
        with os.fdopen(theirs, "w", encoding="utf-8") as stdout, redirect_stdout(stdout):
            return show()
    finally:
        os.close(ours)


ROWS = [("/camera/front_left/image_raw/compressed", "CompressedImage", "1", "9.5"), ("/tf", "TFMessage", "10", "70.0")]


def wide_table(apart: int | None = 0) -> str:
    return table(("topic", "type" * 8, "messages", "Hz"), ROWS, numbers=[2, 3], apart=apart)


def test_a_table_that_is_too_wide_gives_names_lines_of_their_own():
    assert wide_table().splitlines() == [
        "topic",
        "  typetypetypetypetypetypetypetype  messages    Hz",
        "/camera/front_left/image_raw/compressed",
        "  CompressedImage                          1   9.5",
        "/tf",
        "  TFMessage                               10  70.0",
    ]
    last = table(("camera", "view"), [("front", "x" * 60), ("left", "y" * 80)], apart=1).splitlines()
    assert last == ["camera", "    view", "front", f"    {'x' * 60}", "left", f"    {'y' * 80}"]


def test_a_wide_terminal_shows_a_wide_table_on_one_line_each(monkeypatch: pytest.MonkeyPatch):
    shown = on_terminal(200, wide_table, monkeypatch, NO_COLOR="1").splitlines()
    assert (len(shown), shown[2].split()) == (3, ["/tf", "TFMessage", "10", "70.0"])
    assert len(on_terminal(80, wide_table, monkeypatch, NO_COLOR="1").splitlines()) == 6


@pytest.mark.parametrize(
    ("environment", "is_coloured"),
    [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False), ({"FORCE_COLOR": "1", "TERM": "dumb"}, True)],
)
def test_colours_are_for_terminals_that_have_them_and_people_who_want_them(
    environment: dict[str, str], is_coloured: bool, monkeypatch: pytest.MonkeyPatch
):
    shown = on_terminal(80, lambda: styled("FAIL", "red"), monkeypatch, **environment)
    assert shown == ("\033[31mFAIL\033[0m" if is_coloured else "FAIL")


def test_what_is_piped_has_neither_colours_nor_a_terminals_width(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.setenv("COLUMNS", "300")
    assert styled("FAIL", "red") == "FAIL"
    assert len(wide_table().splitlines()) == 6


def test_paragraphs_fit_and_leave_paths_whole():
    path = "/a/very/long/path" * 8
    lines = paragraph(f"{'word ' * 40}{path}").splitlines()
    assert lines[-1] == path
    assert all(len(line) <= 80 for line in lines[:-1])


@pytest.mark.parametrize("text", ["front", "a" * 20, "monday_morning_in_the_rain.mcap"])
def test_a_shortened_name_keeps_its_beginning_and_its_end(text: str):
    short = shortened(text, 20)
    assert len(short) == min(20, len(text))
    assert short == text or (text.startswith(short.split("…")[0]) and text.endswith(short.split("…")[1]))
