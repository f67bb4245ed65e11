# SPDX-License-Identifier: Apache-2.0
"""Many recordings: paths, folders, patterns; each once, in an order that does not change."""

import shutil
from pathlib import Path

import pytest
import recordings
from recordings import SAMPLE, SAMPLE_MCAP

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags import find_recordings, open_recording


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording of every kind, and what is none."""
    top = tmp_path_factory.mktemp("drives")
    recordings.lone_mcap(top / "lone.mcap")
    (top / "2026").mkdir()
    recordings.ros1_copy(top / "2026" / "old.bag", sets=1)
    recordings.split_copy(top / "2026" / "split", sets=3)
    recordings.sqlite_copy(top / "database", sets=1)
    recordings.zstd_file(SAMPLE_MCAP, top / "packed.mcap.zstd")
    (top / "died").mkdir()
    recordings.cut(SAMPLE_MCAP, top / "died" / "died_0.mcap")
    (top / "notes.txt").write_text("no recording")
    (top / ".lone.mcap.partial.mcap").write_bytes(b"still being copied")
    return top


EVERY = ["lone.mcap", "packed.mcap.zstd", "2026/old.bag", "2026/split", "database", "died"]


def found(*patterns: Path | str) -> list[str]:
    return [str(path) for path in find_recordings(patterns)]


def test_a_folder_gives_every_recording_below_it_and_a_rosbag2_folder_counts_as_one(drives: Path):
    assert found(drives) == [str(drives / name) for name in EVERY]
    for path in find_recordings([drives]):
        with open_recording(path) as recording:
            assert recording.topics


def test_a_recording_itself_is_found(drives: Path):
    for path in (SAMPLE, SAMPLE_MCAP, *(drives / name for name in EVERY)):
        assert found(path) == [str(path)]


def test_a_file_that_is_named_is_taken_whatever_its_suffix(tmp_path: Path):
    path = recordings.lone_mcap(tmp_path / "recording.bin")
    assert found(path) == [str(path)]
    with pytest.raises(RecordingError, match=r"\*.bin: no recording there"):
        find_recordings([tmp_path / "*.bin"])


def test_patterns_match_files_and_folders(drives: Path):
    assert found(f"{drives}/*.mcap") == [str(drives / "lone.mcap")]
    assert found(f"{drives}/20*") == [str(drives / "2026/old.bag"), str(drives / "2026/split")]


def test_all_files_of_a_split_recording_are_that_recording_and_a_single_one_is_itself(drives: Path):
    split = drives / "2026" / "split"
    assert found(f"{split}/*.mcap") == [str(split)]
    assert found(*sorted(split.glob("*.mcap"))) == [str(split)]
    assert found(split / "split_1.mcap") == [str(split / "split_1.mcap")]
    assert found(f"{drives}/**/split_[01].mcap") == [str(split / f"split_{part}.mcap") for part in (0, 1)]


def test_what_is_given_twice_counts_once(drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "link").symlink_to(drives)
    monkeypatch.chdir(drives)
    split = drives / "2026" / "split"
    assert found(drives, drives / "lone.mcap", "lone.mcap", tmp_path / "link", split / "split_0.mcap") == found(drives)
    assert found("lone.mcap", drives) == ["lone.mcap", *(str(drives / name) for name in EVERY[1:])]


def test_links_to_folders_are_followed_and_circles_end(drives: Path, tmp_path: Path):
    shutil.copytree(SAMPLE, tmp_path / "a" / "bag")
    (tmp_path / "a" / "circle").symlink_to(tmp_path)
    (tmp_path / "a" / "linked").symlink_to(drives / "database")
    assert found(tmp_path) == [str(tmp_path / "a" / "bag"), str(tmp_path / "a" / "linked")]


def test_several_recordings_in_one_folder_are_several(tmp_path: Path):
    for name in ("monday.mcap", "tuesday.mcap"):
        recordings.lone_mcap(tmp_path / name)
    assert found(tmp_path) == [str(tmp_path / "monday.mcap"), str(tmp_path / "tuesday.mcap")]


@pytest.mark.parametrize(
    ("pattern", "reason"), [("none/*.mcap", "no recording"), ("none", "exist"), ("empty", "no rec")]
)
def test_a_pattern_that_gives_nothing_is_named(pattern: str, reason: str, tmp_path: Path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=reason) as raised:
        find_recordings([SAMPLE, tmp_path / pattern])
    assert str(raised.value).startswith(f"{tmp_path / pattern}: ")
    with pytest.raises(RecordingError, match="no recording given"):
        find_recordings([])
