# SPDX-License-Identifier: Apache-2.0
"""Options, exit codes, fields and keys are those of the committed list, and a change of one is told by name."""

from pathlib import Path
from typing import Any

import pytest
from repository import load_tool


@pytest.fixture(scope="module")
def surface() -> Any:
    return load_tool("public_surface")


def test_no_public_name_is_missing_added_or_changed_unless_the_list_says_so(surface: Any):
    committed = surface.PACKAGE_LIST.read_text(encoding="utf-8")
    difference = surface.difference(committed, surface.text(surface.package()))
    assert not difference, difference


@pytest.mark.parametrize(
    ("line", "changed"),
    [
        ("cvcdepth run --cloud-stride N [2]", "cvcdepth run --cloud-stride N [4]"),
        ("3 NotPromotedError", "1 NotPromotedError"),
        ("surround_depth.launch.py namespace:=''", ""),
        ("optimizer.epochs: int, ge 1 = 20", "optimizer.passes: int, ge 1 = 20"),
    ],
)
def test_a_changed_name_is_shown_with_what_it_was_and_what_it_is(surface: Any, line: str, changed: str):
    committed = surface.PACKAGE_LIST.read_text(encoding="utf-8")
    assert f"\n{line}\n" in committed
    told = surface.difference(committed, committed.replace(f"{line}\n", f"{changed}\n" if changed else "")).splitlines()
    assert f"- {line}" in told
    assert not changed or f"+ {changed}" in told
    assert "--write" in told[-1]


def test_lists_that_are_equal_differ_in_nothing(surface: Any):
    assert surface.difference("a\nb\n", "a\nb\n") == ""


def test_writing_gives_the_committed_list_back(surface: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    committed = surface.PACKAGE_LIST.read_text(encoding="utf-8")
    sections = {"a": ["one", "two"]}
    monkeypatch.setattr(surface, "PACKAGE_LIST", tmp_path / "list.txt")
    monkeypatch.setattr(surface, "package", lambda: sections)
    assert surface.main(["--write", "--only", "package"]) == 0
    assert (tmp_path / "list.txt").read_text() == f"{committed.splitlines()[0]}\n\n[a]\none\ntwo\n"
