# SPDX-License-Identifier: Apache-2.0
"""Messages that were recorded before the clock was set: the drive begins after them, and they are told."""

from collections.abc import Callable
from pathlib import Path

import pytest
import recordings
import small_rig
from recordings import Entry
from rosbags.rosbag2 import StoragePlugin
from small_rig import BEGIN

from cvcdepth_ros.bags import open_recording

SECOND = 10**9
STORAGES: dict[str, Callable[[Path, list[Entry]], Path]] = {
    "mcap": lambda path, found: recordings.write_mcap(path / "a.mcap", found),
    "mcap in small chunks": lambda path, found: recordings.write_mcap(path / "a.mcap", found, chunk_size=2000),
    "mcap without index": lambda path, found: recordings.cut(
        recordings.write_mcap(path / "a.mcap", found, chunk_size=1000), path / "b.mcap", 0.95
    ),
    "sqlite": lambda path, found: recordings.write_rosbag2(path / "a", found, StoragePlugin.SQLITE3),
    "ros1": lambda path, found: small_rig.write_ros1(path / "a.bag", found),
}


def early(times: list[int]) -> list[Entry]:
    """The drive, whose first messages were recorded at these times."""
    drive = small_rig.entries(frames=6)
    return [found._replace(log_time=time) for found, time in zip(drive, times, strict=False)] + drive[len(times) :]


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("times", [[0], [0, 0, 0], [5 * SECOND, 20 * SECOND]], ids=["one", "three", "no clock at all"])
def test_a_drive_begins_when_its_clock_was_set(storage: str, times: list[int], tmp_path: Path):
    path = STORAGES[storage](tmp_path, early(times))
    with open_recording(path) as recording:
        assert recording.start == BEGIN
        first = [message.log_time for message in recording.messages()][: len(times)]
        assert first == times, "nothing is lost"
        assert all(message.log_time >= BEGIN for message in recording.messages(start=recording.start))
        (note,) = recording.notes
    assert f"{len(times)} messages were recorded before the clock was set, in 1970: /tf" in note


def test_a_simulation_that_begins_at_zero_begins_at_zero(tmp_path: Path):
    drive = [found._replace(log_time=found.log_time - BEGIN) for found in small_rig.entries()]
    with open_recording(recordings.write_mcap(tmp_path / "a.mcap", drive)) as recording:
        assert (recording.start, recording.notes) == (0, [])


def test_a_drive_all_of_whose_times_are_of_1970_is_left_as_it_is(tmp_path: Path):
    drive = [found._replace(log_time=found.log_time - BEGIN + 60 * SECOND) for found in small_rig.entries()]
    with open_recording(recordings.write_mcap(tmp_path / "a.mcap", drive)) as recording:
        assert (recording.start, recording.notes) == (60 * SECOND, [])
