# SPDX-License-Identifier: Apache-2.0
"""MCAP as the specification allows it and other writers write it; what is read is compared with the file's counts."""

from collections.abc import Callable
from pathlib import Path

import mcap.writer
import pytest
import small_rig
from recordings import JAZZY, Entry
from small_rig import McapRecords

from cvcdepth_ros.bags import open_recording

DRIVE = small_rig.entries()
COUNT = len(DRIVE)

LAYOUTS: dict[str, Callable[[Path], Path]] = {
    "messages before, between and behind chunks": lambda path: (
        McapRecords()
        .outside(DRIVE[:1])
        .chunk(DRIVE[1:9])
        .outside(DRIVE[9:12])
        .chunk(DRIVE[12:20])
        .outside(DRIVE[20:])
        .finish(path)
    ),
    "no message in any chunk": lambda path: McapRecords().outside(DRIVE).finish(path),
    "records longer than known": lambda path: (
        McapRecords(padding=b"later").chunk(DRIVE[:9]).outside(DRIVE[9:]).finish(path)
    ),
    "counts not by topic": lambda path: McapRecords().chunk(DRIVE[:9]).chunk(DRIVE[9:]).finish(path, by_topic=False),
    "counts not by topic, messages outside": lambda path: (
        McapRecords().chunk(DRIVE[:9]).outside(DRIVE[9:]).finish(path, by_topic=False)
    ),
    "neither counts by topic nor message indexes": lambda path: (
        McapRecords().chunk(DRIVE[:9], indexed=False).chunk(DRIVE[9:]).finish(path, by_topic=False)
    ),
    "no message indexes": lambda path: McapRecords().chunk(DRIVE, indexed=False).finish(path),
    "empty last chunk": lambda path: McapRecords().chunk(DRIVE).chunk([]).finish(path),
    "empty first chunk": lambda path: McapRecords().chunk([]).chunk(DRIVE).finish(path),
    "empty chunks without message indexes": lambda path: (
        McapRecords().chunk([]).chunk(DRIVE, indexed=False).chunk([]).finish(path)
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_all_messages_and_no_damage(layout: str, tmp_path: Path):
    with open_recording(LAYOUTS[layout](tmp_path / "a.mcap")) as recording:
        assert sorted((m.topic, m.log_time, m.cdr) for m in recording.messages()) == sorted(
            (found.topic, found.log_time, found.cdr) for found in DRIVE
        )
        assert sum(topic.count for topic in recording.topics.values()) == COUNT
        assert (recording.start, recording.end) == (DRIVE[0].log_time, DRIVE[-1].log_time)
        assert (recording.damage, recording.notes) == (None, [])


def test_a_chunk_that_the_index_leaves_out_is_found(tmp_path: Path):
    records = McapRecords().chunk(DRIVE[:9])
    listed, records._chunks = records._chunks, b""
    records.chunk(DRIVE[9:18])
    records._chunks, records._number_of_chunks = listed, 1
    with open_recording(records.chunk(DRIVE[18:]).finish(tmp_path / "a.mcap")) as recording:
        assert len(list(recording.messages())) == COUNT
        assert recording.damage is None


@pytest.mark.parametrize("by_topic", [True, False])
@pytest.mark.parametrize("miscounted", [3, -1])
def test_a_difference_to_the_files_own_counts_is_told(by_topic: bool, miscounted: int, tmp_path: Path):
    path = McapRecords().chunk(DRIVE).finish(tmp_path / "a.mcap", by_topic, miscounted)
    with open_recording(path) as recording:
        assert len(list(recording.messages())) == COUNT
        told = recording.damage or ""
    wanted = "/tf_static 1 of" if by_topic else f"{COUNT} messages found, the file itself counts {COUNT + miscounted}"
    assert wanted in told


def test_reading_a_part_tells_no_difference(tmp_path: Path):
    path = McapRecords().chunk(DRIVE).finish(tmp_path / "a.mcap")
    with open_recording(path) as recording:
        assert list(recording.messages(["/tf"], stop=DRIVE[8].log_time))
        next(iter(recording.messages()))
        assert recording.damage is None


def converted(
    path: Path, recorded: list[Entry], name: Callable[[str], str], ros1: bool, bad: Entry | None = None
) -> Path:
    """An .mcap with types of other names, of ROS 2 or as `mcap convert` makes it of a ROS 1 bag."""
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start(profile="ros1" if ros1 else "ros2")
        channels: dict[str, int] = {}
        for found in recorded:
            if found.topic not in channels:
                text = (
                    small_rig.ros1_definition(found.type)
                    if ros1
                    else JAZZY.generate_msgdef(found.type, ros_version=2)[0]
                )
                schema = writer.register_schema(name(found.type), "ros1msg" if ros1 else "ros2msg", text.encode())
                channels[found.topic] = writer.register_channel(found.topic, "ros1" if ros1 else "cdr", schema)
            content = small_rig.ros1_bytes(found) if ros1 else found.cdr
            content = content[:-3] if found is bad else content
            writer.add_message(channels[found.topic], found.log_time, content, found.log_time)
        writer.finish()
    return path


def as_in_ros1(name: str) -> str:
    return name.replace("/msg/", "/")


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize("name", [as_in_ros1, str])
def test_types_are_known_by_the_names_of_ros1_too_and_messages_of_ros1_are_converted(ros1: bool, name, tmp_path: Path):
    with open_recording(converted(tmp_path / "a.mcap", DRIVE, name, ros1)) as recording:
        assert {topic.name: topic.type for topic in recording.topics.values()} == {f.topic: f.type for f in DRIVE}
        assert sorted((m.topic, m.log_time, bytes(m.cdr)) for m in recording.messages()) == sorted(
            (found.topic, found.log_time, found.cdr) for found in DRIVE
        )
        assert recording.damage is None


def test_a_ros1_message_that_does_not_fit_costs_itself_and_is_told(tmp_path: Path):
    bad = DRIVE[3]
    with open_recording(converted(tmp_path / "a.mcap", DRIVE, as_in_ros1, ros1=True, bad=bad)) as recording:
        assert len(list(recording.messages())) == COUNT - 1
        assert f"{bad.topic} at {bad.log_time} ns skipped" in (recording.damage or "")


def test_a_schema_in_another_character_set_costs_at_most_itself(tmp_path: Path):
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema("my_msgs/msg/Angle", "ros2msg", b"float32 a # in \xb0C")
        writer.add_message(writer.register_channel("/angle", "cdr", schema), 5, b"\0\1\0\0" + bytes(4), 5)
        writer.finish()
    with open_recording(tmp_path / "a.mcap") as recording:
        assert recording.deserialize(next(recording.messages())).a == 0.0
