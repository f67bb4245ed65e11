# SPDX-License-Identifier: Apache-2.0
"""rosbag2 folders whose metadata.yaml is not up to date: what is there is read, and the difference is told."""

import shutil
from pathlib import Path

import pytest
import recordings
import small_rig
import yaml
from rosbags.rosbag2 import StoragePlugin

from cvcdepth_ros.bags import find_recordings, open_recording

DRIVE = small_rig.entries()


def folder(path: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    return recordings.write_rosbag2(path / "drive", DRIVE, storage)


def relist(path: Path, *names: str, **changes: object) -> None:
    metadata = path / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text())
    content["rosbag2_bagfile_information"].update(relative_file_paths=[*names], **changes)
    metadata.write_text(yaml.safe_dump(content))


def read(path: Path) -> tuple[int, list[str], str]:
    with open_recording(path) as recording:
        return len(list(recording.messages())), recording.notes, recording.damage or ""


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("to_folder", [True, False])
def test_a_renamed_storage_file_is_read_and_told(storage: StoragePlugin, to_folder: bool, tmp_path: Path):
    path = folder(tmp_path, storage)
    (file,) = (file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
    if to_folder:
        path = Path(shutil.move(path, tmp_path / "monday"))
        file = path / file.name
    file.rename(path / f"monday{file.suffix}")
    count, (note,), damage = read(path)
    assert (count, damage) == (len(DRIVE), "")
    assert f"lists {file.name}, not there; monday{file.suffix} is read instead" in note


def test_all_of_a_split_recordings_files_may_be_renamed(tmp_path: Path):
    path = recordings.split_copy(tmp_path / "bag", sets=1)
    for file in path.glob("*.mcap"):
        file.rename(path / file.name.replace("bag_", "part_"))
    count, (note,), damage = read(path)
    assert (count, damage) == (len(recordings.sample_entries(1)), "")
    assert "part_0.mcap, part_1.mcap, part_2.mcap is read instead" in note


@pytest.mark.parametrize(("listed", "there"), [(".mcap.zstd", ".mcap"), (".mcap", ".mcap.zstd")])
def test_a_file_that_was_packed_or_unpacked_since_is_read(listed: str, there: str, tmp_path: Path):
    path = folder(tmp_path)
    relist(path, f"drive{listed}")
    if there.endswith(".zstd"):
        recordings.zstd_file(path / "drive.mcap", path / "drive.mcap.zstd")
        (path / "drive.mcap").unlink()
    assert read(path) == (len(DRIVE), [], "")


def test_a_file_that_is_listed_twice_is_read_once_and_told(tmp_path: Path):
    path = folder(tmp_path)
    relist(path, "drive.mcap", "drive.mcap")
    count, (note,), damage = read(path)
    assert (count, damage) == (len(DRIVE), "")
    assert "lists drive.mcap more than once; it is read once" in note


def test_paths_of_the_computer_that_recorded_lead_into_the_folder(tmp_path: Path):
    path = folder(tmp_path)
    relist(path, "/data/drives/drive/drive.mcap")
    assert read(path) == (len(DRIVE), [], "")


def test_another_number_of_messages_than_the_metadata_counts_is_told(tmp_path: Path):
    path = folder(tmp_path)
    relist(path, "drive.mcap", message_count=len(DRIVE) + 8)
    count, _, damage = read(path)
    assert count == len(DRIVE)
    assert f"{len(DRIVE)} messages found, metadata.yaml counts {len(DRIVE) + 8}" in damage


def test_a_bag_that_ros1_never_closed_is_found_in_a_folder_of_drives(tmp_path: Path):
    small_rig.write_ros1(tmp_path / "a.bag", DRIVE)
    shutil.copy(tmp_path / "a.bag", tmp_path / "b.bag.active")
    assert [found.name for found in find_recordings([tmp_path])] == ["a.bag", "b.bag.active"]
