# SPDX-License-Identifier: Apache-2.0
"""Results are on the disk whole or not at all."""

import pytest

from cvcdepth_core.atomic_file import write_atomically
from cvcdepth_core.errors import OutputError


def test_a_file_is_replaced_as_a_whole_and_nothing_else_is_left(tmp_path):
    path = tmp_path / "scores.json"
    for content in (b"first, and longer", b"second"):
        write_atomically(path, content)
    assert path.read_bytes() == b"second"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_told_by_the_files_name_and_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "scores.json"
    write_atomically(path, b"old")

    def full_disk(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OutputError, match=r"scores.json: cannot be written: No space left on device"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(OutputError, match=r"none/scores.json: cannot be written: No such file or directory"):
        write_atomically(tmp_path / "none" / "scores.json", b"")
