# SPDX-License-Identifier: Apache-2.0
"""A recording's rig is read in one pass, once per command, and is the same wherever its messages lie."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import recordings
from recordings import SAMPLE, Entry

from cvcdepth_core.errors import RigError, TransformError
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.bags.mcap_file import McapFile
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import build_index

LIDAR = "/lidar/points"


@dataclass
class Passes:
    """How often a file was opened, and read from its start, and how many messages that gave."""

    opened: int = 0
    read: int = 0
    messages: list[str] = field(default_factory=list)
    """The topic of each."""


@pytest.fixture
def passes(monkeypatch: pytest.MonkeyPatch) -> Passes:
    counted, build, read = Passes(), McapFile.__init__, McapFile.messages

    def counting_build(self: McapFile, path: Path) -> None:
        counted.opened += 1
        build(self, path)

    def counting_read(self: McapFile, topics, start: int, stop: int):
        counted.read += start <= self.start
        for message in read(self, topics, start, stop):
            counted.messages.append(message.topic)
            yield message

    monkeypatch.setattr(McapFile, "__init__", counting_build)
    monkeypatch.setattr(McapFile, "messages", counting_read)
    return counted


SMALL = ("--height", "64", "--width", "96", "--quiet")
CONSTANT = ("--predictor", "constant", *SMALL)


class Command(NamedTuple):
    """Work on the sample, and how often that opened it and read it from its start at commit d81c28c."""

    work: Callable[[Path], object]
    opened_before: int
    read_before: int


COMMANDS = {
    "run": Command(lambda out: main(["run", str(SAMPLE), "-o", str(out), "--untrained", *SMALL]), 1, 8),
    "evaluate": Command(lambda out: main(["evaluate", str(SAMPLE), "-o", str(out), *CONSTANT, "--no-report"]), 1, 9),
    "evaluate with its page": Command(lambda out: main(["evaluate", str(SAMPLE), "-o", str(out), *CONSTANT]), 4, 36),
    "check": Command(lambda _: main(["check", str(SAMPLE), "--quiet"]), 1, 6),
    "rig": Command(lambda out: main(["rig", str(SAMPLE), "-o", str(out)]), 1, 3),
    "rig with masks": Command(lambda out: main(["rig", str(SAMPLE), "-o", str(out), "--masks"]), 3, 11),
    "the training index": Command(lambda _: build_index(SAMPLE, MatchingSettings()), 1, 8),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_reads_a_recording_at_most_half_as_often_as_when_each_part_assembled_its_rig(
    name: str, passes: Passes, tmp_path: Path
):
    command = COMMANDS[name]
    exit_code = command.work(tmp_path / "out")
    assert not isinstance(exit_code, int) or exit_code == 0
    assert 0 < passes.read <= -(-command.read_before // 2)  # of three passes two: one looks for changes on the way
    assert 0 < passes.opened <= max(1, command.opened_before - 1)


def rig_of(entries: list[Entry], path: Path, layout: RigLayout | None = None) -> RecordedRig:
    with open_recording(recordings.write_rosbag2(path, entries)) as recording:
        return RecordedRig.from_recording(recording, layout)


def test_nothing_is_read_any_further_of_a_topic_of_which_nothing_more_is_needed(passes: Passes):
    with open_recording(SAMPLE) as recording:
        RecordedRig.from_recording(recording)
    counted = {topic: passes.messages.count(topic) for topic in passes.messages}
    assert len(counted) == 14  # six of camera_info and of images, /tf_static and the LiDAR
    assert sum(counted.values()) <= len(counted) + 1


def test_a_layout_is_completed_again_without_reading_again(passes: Passes):
    with open_recording(SAMPLE) as recording:
        recorded = RecordedRig.from_recording(recording)
        read = len(passes.messages)
        changed = recorded.with_layout(recorded.layout.model_copy(update={"anchor": "back"}))
    assert (changed.layout.complete().anchor, len(passes.messages)) == ("back", read)


def test_it_does_not_matter_where_in_the_recording_its_messages_lie(tmp_path: Path):
    entries = recordings.sample_entries(4)
    last = entries[-1].log_time
    expected = rig_of(entries, tmp_path / "sample")
    late = [e._replace(log_time=last) if e.topic == "/tf_static" else e for e in entries]
    late = [e for e in late if e.topic != LIDAR or e.log_time > entries[len(entries) // 2].log_time]
    moved = rig_of(sorted(late, key=lambda e: e.log_time), tmp_path / "late")
    together = rig_of([e._replace(log_time=last) for e in entries], tmp_path / "together")
    for found in (moved, together):
        assert found.layout == expected.layout
        assert found.lidars == (LIDAR,)
        poses = [recorded.transforms.lookup("base_link", "pandar64") for recorded in (found, expected)]
        np.testing.assert_array_equal(*poses)


def test_transforms_of_several_messages_are_joined_and_a_frame_that_moves_has_no_pose(tmp_path: Path):
    entries = recordings.sample_entries(3)
    (static,) = (entry for entry in entries if entry.topic == "/tf_static")

    def lidar_alone(message, shift: float = 0.0) -> None:
        message.transforms = [link for link in message.transforms if link.child_frame_id == "pandar64"]
        message.transforms[0].transform.translation.x += shift

    later = static._replace(log_time=entries[-1].log_time)
    again = next(recordings.changed([later], "/tf_static", lidar_alone))
    moved = next(recordings.changed([later], "/tf_static", lambda message: lidar_alone(message, 1.0)))
    first, joined = rig_of(entries, tmp_path / "first"), rig_of([*entries, again], tmp_path / "again")
    assert joined.static_links.keys() == first.static_links.keys()
    assert joined.layout == first.layout
    poses = [recorded.transforms.lookup("base_link", "pandar64") for recorded in (joined, first)]
    np.testing.assert_array_equal(*poses)
    changed = rig_of([*entries, moved], tmp_path / "moved")
    assert changed.layout == first.layout
    with pytest.raises(TransformError, match=r"base_link <- pandar64 moves 0\.301 s after the beginning by 1\.000 m"):
        changed.transforms.lookup("base_link", "pandar64")


def test_a_cloud_is_known_by_its_first_message_that_can_be_read(tmp_path: Path):
    entries = recordings.sample_entries(3)
    first = next(number for number, entry in enumerate(entries) if entry.topic == LIDAR)
    entries[first] = entries[first]._replace(cdr=entries[first].cdr[:30])

    def colour(message) -> None:
        message.fields[-1].name = "rgb"

    others = [entry._replace(topic="/other/points") for entry in entries if entry.topic == LIDAR]
    coloured = [others[0], *recordings.changed(others[1:], "/other/points", colour)]
    found = rig_of(sorted([*entries, *coloured], key=lambda e: e.log_time), tmp_path / "bag")
    assert (found.lidars, [*found.other_clouds]) == ((LIDAR,), ["/other/points"])


def test_a_rig_that_stays_incomplete_is_refused_with_recording_and_camera(tmp_path: Path):
    def forget(message) -> None:
        message.transforms = [link for link in message.transforms if not link.child_frame_id.startswith("right")]

    entries = list(recordings.changed(recordings.sample_entries(1), "/tf_static", forget))
    with pytest.raises(RigError, match=r"lame: camera right: no transform base_link <- right_camera_optical_frame"):
        rig_of(entries, tmp_path / "lame")


def test_topics_that_carry_no_transforms_in_spite_of_their_names_leave_the_cameras_unconnected(tmp_path: Path):
    entries = recordings.sample_entries(1)
    odometry = next(entry for entry in entries if entry.topic == "/odom")
    odd = [odometry._replace(topic=e.topic) if e.topic in ("/tf", "/tf_static") else e for e in entries]
    with pytest.raises(RigError, match=r"odd: camera back: no transform base_link <- back_camera_optical_frame"):
        rig_of(odd, tmp_path / "odd")
