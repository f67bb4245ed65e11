# SPDX-License-Identifier: Apache-2.0
"""Results are on the disk whole or not at all; YAML gives plain values, and one kind of error whatever is wrong."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from recordings import SAMPLE

from cvcdepth_core.errors import OutputError
from cvcdepth_core.files import load_yaml, write_atomically
from cvcdepth_core.rig.rig_file import RigLayout, save_rig_layout
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.evaluation.image_scores import write_csv
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import load_index


def full_disk(_descriptor: int) -> None:
    """Stand in for os.fsync."""
    raise OSError(28, "No space left on device")


def test_a_file_is_replaced_as_a_whole_and_nothing_else_is_left(tmp_path):
    path = tmp_path / "scores.json"
    for content in (b"first, and longer", b"second"):
        write_atomically(path, content)
    assert path.read_bytes() == b"second"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link_and_a_pipe_a_pipe(tmp_path):
    target, link, pipe = tmp_path / "target.yaml", tmp_path / "link.yaml", tmp_path / "pipe"
    link.symlink_to(target)
    write_atomically(link, b"written")
    assert link.is_symlink()
    assert target.read_bytes() == b"written"

    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_atomically(pipe, b"written")
    assert os.read(reader, 100) == b"written"
    os.close(reader)
    assert pipe.is_fifo()


def test_piped_output_is_written():
    code = "import pathlib, cvcdepth_core.files as f; f.write_atomically(pathlib.Path('/dev/stdout'), b'written')"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    assert done.stdout == b"written"


def test_a_full_disk_is_told_by_the_files_name_and_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "scores.json"
    write_atomically(path, b"old")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OutputError, match=r"scores.json: cannot be written: No space left on device"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def write_rig(path: Path) -> None:
    fields = ("image_topic", "camera_info_topic")
    cameras = [{"name": name, **{field: f"/{name}/{field}" for field in fields}} for name in ("front", "left")]
    save_rig_layout(path, RigLayout.model_validate({"base_frame": "base_link", "cameras": cameras}))


def write_index(path: Path) -> None:
    load_index(SAMPLE, path.parent, MatchingSettings())


WRITERS: dict[str, Callable[[Path], None]] = {
    "per_frame.csv": lambda path: write_csv(path, []),
    "rig.yaml": write_rig,
    f"{SAMPLE.name}-*.npz": write_index,
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_a_full_disk_does_not_take_leaves_the_former_file(name, tmp_path, monkeypatch):
    WRITERS[name](tmp_path / name)
    (path,) = tmp_path.glob(name)
    path.write_bytes(b"former")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OutputError, match=f"{path.name}: cannot be written: No space left on device"):
        WRITERS[name](tmp_path / name)
    assert path.read_bytes() == b"former"


def test_what_a_full_disk_does_not_take_of_run_json_is_not_left_half(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("os.fsync", full_disk)
    small = ("--untrained", "--height", "64", "--width", "96", "--duration", "0.2")
    assert main(["run", str(SAMPLE), "-o", str(tmp_path / "depth"), *small]) == 1
    assert "run.json: cannot be written: No space left on device" in capsys.readouterr().err
    assert not (tmp_path / "depth" / "run.json").exists()


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(OutputError, match=r"none/scores.json: cannot be written: No such file or directory"):
        write_atomically(tmp_path / "none" / "scores.json", b"")


def test_entries_are_merged_as_yaml_says():
    text = "common: &common {fps: 10, mask: a.png}\n"
    text += "front: {<<: *common, mask: b.png}\nback: {<<: [*common, {fps: 5, k: 1}]}\n"
    content = load_yaml(text)
    assert content == yaml.safe_load(text)
    assert content["front"] == {"fps": 10, "mask": "b.png"}
    assert content["back"] == {"fps": 10, "mask": "a.png", "k": 1}


WRONG = {
    "no end": "a: [",
    "a function": "!!python/object/apply:os.system [true]",
    "a date that is none": "2001-99-99",
    "a time that is none": "!!timestamp soon",
    "a number without digits": "!!int ''",
    "nested without end": "[" * 100_000,
    "merged with itself": "&a {<<: *a}",
    "merged with a word": "{<<: word}",
    "half a million merged entries": "a0: &a0 {k: 1}\n"
    + "".join(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 9)}]}}\n" for n in range(1, 7)),
}


@pytest.mark.parametrize("case", WRONG)
def test_whatever_is_wrong_with_yaml_is_one_kind_of_error(case: str):
    with pytest.raises(yaml.YAMLError, match=r"."):
        load_yaml(WRONG[case])
