# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags as they come: odd definitions, bad messages, bad chunks, no index; each costs itself and no more."""

import re
from pathlib import Path

import pytest
import small_rig
from rosbags.rosbag1 import Writer
from small_rig import BEGIN, add_ros1_topic

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags import open_recording

LINE = "=" * 80
EMPTY_MD5 = "d41d8cd98f00b204e9800998ecf8427e"
DRIVE = small_rig.entries(frames=6)
EXPECTED = sorted((found.topic, found.log_time, found.cdr) for found in DRIVE)


def read(path: Path) -> tuple[list[tuple[str, int, bytes]], str]:
    """Messages in the order of `EXPECTED`, without those of `/odd`, and what is told."""
    with open_recording(path) as recording:
        found = [(m.topic, m.log_time, bytes(m.cdr)) for m in recording.messages()]
        assert [time for _, time, _ in found] == sorted(time for _, time, _ in found)
        return sorted(message for message in found if message[0] != "/odd"), recording.damage or ""


UNDERSTOOD = {
    "no fields at all": ("std_msgs/msg/Empty", "", b"", EMPTY_MD5),
    "no fields, of one's own": ("my_msgs/msg/Trigger", "", b"", EMPTY_MD5),
    "only comments": ("my_msgs/msg/Trigger", "# nothing\n", b"", "*"),
    "lower-case constant": ("my_msgs/msg/Odd", "uint8 on=1\nuint8 x\n", b"\1", "*"),
    "empty text as constant": ("my_msgs/msg/Odd", "string NONE=\nuint8 x\n", b"\1", "*"),
    "constant with anything in it": ("my_msgs/msg/Odd", "string SIGNS= # = [ \" '\nuint8 x\n", b"\1", "*"),
    "blank lines before MSG": ("my_msgs/msg/Odd", f"Part p\n{LINE}\n\n\nMSG: my_msgs/Part\nuint8 x\n", b"\1", "*"),
    "lines of DOS": ("my_msgs/msg/Odd", f"Part p\r\n{LINE}\r\nMSG: my_msgs/Part\r\nuint8 x\r\n", b"\1", "*"),
    "a shorter separator": ("my_msgs/msg/Odd", f"Part p\n{'=' * 40}\nMSG: my_msgs/Part\nuint8 x\n", b"\1", "*"),
    "package with capitals": (
        "My__msgs/msg/Odd",
        "My__msgs/Part p\n" + f"{LINE}\nMSG: My__msgs/Part\nint8 x",
        b"\1",
        "*",
    ),
    "standard part left out": ("my_msgs/msg/Odd", "std_msgs/Bool b\ntime t\n", b"\1" + bytes(8), "*"),
    "standard type not defined": ("std_msgs/msg/Bool", "", b"\1", "*"),
    "placeholder of a relay": ("sensor_msgs/msg/Temperature", "*", bytes(4 + 8 + 4 + 16), "*"),
    "a keyword as field": ("my_msgs/msg/Odd", "uint8 class\n", b"\1", "*"),
}


@pytest.mark.parametrize("case", UNDERSTOOD)
def test_a_definition_that_ros1_allows_is_understood(case: str, tmp_path: Path):
    type_, definition, content, md5 = UNDERSTOOD[case]
    path = small_rig.write_ros1(
        tmp_path / "a.bag", DRIVE, lambda writer: add_ros1_topic(writer, "/odd", type_, definition, content, md5)
    )
    assert read(path) == (EXPECTED, "")
    with open_recording(path) as recording:
        assert recording.topics["/odd"].type == type_
        recording.deserialize(next(recording.messages(["/odd"])))


@pytest.mark.parametrize("comment", [b"\xb0C", b"\xff\xfe", "°".encode()])
def test_the_character_set_of_a_comment_does_not_matter(comment: bytes, tmp_path: Path):
    path = small_rig.write_ros1(
        tmp_path / "a.bag",
        DRIVE,
        lambda writer: add_ros1_topic(writer, "/odd", "my_msgs/msg/Angle", "float32 a # in XX", bytes(4)),
    )
    path.write_bytes(path.read_bytes().replace(b"in XX", comment.rjust(5)))
    assert read(path) == (EXPECTED, "")


UNUSABLE = {
    "none": ("my_msgs/msg/Odd", ""),
    "placeholder": ("my_msgs/msg/Odd", "*"),
    "a part is missing": ("my_msgs/msg/Odd", "my_msgs/Part p\n"),
    "no definition": ("my_msgs/msg/Odd", "this is no definition: {}"),
    "two fields of one name": ("my_msgs/msg/Odd", "uint8 x\nuint8 x\n"),
    "endless nothings": ("my_msgs/msg/Odd", f"Part[] p\n{LINE}\nMSG: my_msgs/Part\n"),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_a_definition_that_cannot_be_used_costs_its_topic_and_is_told(case: str, tmp_path: Path):
    type_, definition = UNUSABLE[case]
    path = small_rig.write_ros1(
        tmp_path / "a.bag", DRIVE, lambda writer: add_ros1_topic(writer, "/odd", type_, definition, b"\0\0\0\1")
    )
    messages, damage = read(path)
    assert messages == EXPECTED
    assert f"left out /odd: 1 messages (the definition of {type_} is missing" in damage


def test_a_relay_that_knows_not_even_the_type_costs_its_topic_and_is_told(tmp_path: Path):
    path = small_rig.write_ros1(
        tmp_path / "a.bag", DRIVE, lambda writer: add_ros1_topic(writer, "/odd", "r/msg/X", "*", b"\0")
    )
    path.write_bytes(path.read_bytes().replace(b"type=r/X", b"type=***"))
    messages, damage = read(path)
    assert messages == EXPECTED
    assert "left out /odd: 1 messages (the definition of *** is missing" in damage


@pytest.mark.parametrize("content", [lambda whole: whole[:30], lambda whole: whole + b"x", lambda _: b""])
@pytest.mark.parametrize("kind", ["image_raw/compressed", "camera_info"])
def test_a_message_that_does_not_fit_its_type_costs_only_itself(content, kind: str, tmp_path: Path):
    bad = f"/port/{kind}", BEGIN + 2 * 10**8
    path = small_rig.write_ros1(
        tmp_path / "a.bag",
        DRIVE,
        changed=lambda found, whole: content(whole) if (found.topic, found.log_time) == bad else whole,
    )
    messages, damage = read(path)
    assert messages == [message for message in EXPECTED if message[:2] != bad]
    assert f"{bad[0]} at {bad[1]} ns skipped" in damage


@pytest.mark.parametrize("compression", [Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4])
def test_a_chunk_that_cannot_be_unpacked_costs_only_itself(compression, tmp_path: Path):
    path = small_rig.write_ros1(tmp_path / "a.bag", DRIVE, compression=compression)
    content = bytearray(path.read_bytes())
    third = [found.start() for found in re.finditer(b"op=\x05", content)][2]
    content[third + 100 : third + 140] = bytes(40)
    path.write_bytes(content)
    messages, damage = read(path)
    assert set(messages) < set(EXPECTED)
    assert len(messages) > len(EXPECTED) * 0.7
    assert "skipped" in damage
    assert "not as many messages as the file itself counts" in damage


def without_index(path: Path) -> bytes:
    content = bytearray(path.read_bytes())
    position = content.index(b"index_pos=") + len(b"index_pos=")
    content[position : position + 8] = bytes(8)
    return bytes(content)


@pytest.mark.parametrize("name", ["drive.bag.active", "drive.bag"])
@pytest.mark.parametrize("compression", [None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4])
def test_a_bag_that_was_never_closed_is_read_as_far_as_its_messages_go(name: str, compression, tmp_path: Path):
    whole = small_rig.write_ros1(tmp_path / "a.bag", DRIVE, compression=compression)
    path = tmp_path / name
    path.write_bytes(without_index(whole)[: int(whole.stat().st_size * 0.6)])
    messages, damage = read(path)
    times = {time for _, time, _ in messages}
    assert len(messages) > len(EXPECTED) / 3
    assert messages == [message for message in EXPECTED if message in set(messages)]
    assert min(times) == BEGIN
    told = re.search(
        r"(\d+) messages of the \d+ chunks before it recovered(?:, and (\d+) of the one that is cut)?", damage
    )
    assert told
    assert sum(map(int, filter(None, told.groups()))) == len(messages)


def test_of_the_chunk_that_was_being_written_every_whole_message_is_read(tmp_path: Path):
    path = small_rig.write_ros1(tmp_path / "a.bag", DRIVE, chunk_bytes=10**6)
    content = without_index(path)
    counts = []
    for share in (0.2, 0.4, 0.7):
        path.write_bytes(content[: int(len(content) * share)])
        messages, damage = read(path)
        assert messages == [message for message in EXPECTED if message in set(messages)]
        assert f"0 messages of the 0 chunks before it recovered, and {len(messages)} of the one that is cut" in damage
        counts.append(len(messages))
    assert 0 < counts[0] < counts[1] < counts[2]


@pytest.mark.parametrize("compression", [None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4])
def test_a_chunk_whose_size_was_never_written_is_read(compression, tmp_path: Path):
    path = small_rig.write_ros1(tmp_path / "a.bag", DRIVE, compression=compression, chunk_bytes=10**6)
    content = bytearray(without_index(path))
    size = content.index(b"size=", content.index(b"op=\x05")) + len(b"size=")
    end = re.search(rb"(?s)....op=\x05.*?size=....", content).end()
    data = int.from_bytes(content[end : end + 4], "little")
    content[size : size + 4] = content[end : end + 4] = bytes(4)
    path.write_bytes(content[: end + 4 + data])
    messages, _ = read(path)
    assert messages == EXPECTED


def test_a_bag_without_index_that_is_whole_gives_everything_and_is_not_called_damaged(tmp_path: Path):
    path = small_rig.write_ros1(tmp_path / "a.bag", DRIVE)
    path.write_bytes(without_index(path))
    assert read(path) == (EXPECTED, "")
    with open_recording(path) as recording:
        assert not recording.files[0].indexed


def test_a_copy_that_was_cut_has_an_index_that_leads_nowhere_and_is_read_too(tmp_path: Path):
    path = small_rig.write_ros1(tmp_path / "a.bag", DRIVE)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    messages, damage = read(path)
    assert len(messages) > len(EXPECTED) / 3
    assert "cut or unreadable from byte" in damage


def test_a_bag_cut_within_its_first_message_holds_nothing_and_says_so(tmp_path: Path):
    path = small_rig.write_ros1(tmp_path / "a.bag", DRIVE, chunk_bytes=10**6)
    path.write_bytes(path.read_bytes()[:4200])
    with pytest.raises(RecordingError, match=r"holds no readable message \(.*cut or unreadable from byte"):
        open_recording(path)
