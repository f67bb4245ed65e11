# SPDX-License-Identifier: Apache-2.0
"""Recordings: every storage gives the same messages, damage costs no more than it hit, what we write others read."""

import re
import shutil
import sqlite3
import sys
import tracemalloc
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import recordings
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from recordings import SAMPLE, SAMPLE_MCAP, Entry
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags import LATCHED, RecordedMessage, RecordingWriter, open_recording, sqlite_file, typestore
from cvcdepth_ros.bags.typestores import parsed_definition

SECOND = 10**9


@pytest.fixture(scope="module")
def sample() -> list[Entry]:
    return recordings.sample_entries()


@pytest.fixture(scope="module")
def checked_mcap(tmp_path_factory: pytest.TempPathFactory, sample: list[Entry]) -> Path:
    """The sample in uncompressed chunks with checksums."""
    path = tmp_path_factory.mktemp("checked") / "checked.mcap"
    return recordings.write_mcap(path, sample, compression=CompressionType.NONE)


def read(path: Path | list[Path], **window: int) -> list[RecordedMessage]:
    with open_recording(path) as recording:
        return list(recording.messages(**window))


def as_messages(entries: list[Entry]) -> list[RecordedMessage]:
    return [RecordedMessage(entry.topic, entry.log_time, entry.cdr) for entry in entries]


def stamps(messages: list[RecordedMessage]) -> list[tuple[str, int]]:
    return sorted((message.topic, message.log_time) for message in messages)


def expected_stamps(chunks: list[recordings.StoredChunk]) -> list[tuple[str, int]]:
    return sorted(stamp for chunk in chunks for stamp in chunk.messages)


# Storages

STORAGES = {
    "folder": lambda path, entries: SAMPLE,
    "lone mcap": lambda path, entries: recordings.lone_mcap(path / "lone.mcap"),
    "wrong suffix": lambda path, entries: recordings.lone_mcap(path / "recording.bin"),
    "sqlite folder": lambda path, entries: recordings.sqlite_copy(path / "bag"),
    "lone db3": lambda path, entries: recordings.sqlite_copy(path / "bag") / "bag.db3",
    "split folder": lambda path, entries: recordings.split_copy(path / "bag"),
    "list of files": lambda path, entries: sorted(recordings.split_copy(path / "bag").glob("*.mcap"), reverse=True),
    "zstd chunks": lambda path, entries: recordings.write_rosbag2(
        path / "bag", entries, compression=CompressionMode.STORAGE
    ),
    "lz4 chunks": lambda path, entries: recordings.write_mcap(
        path / "bag.mcap", entries, compression=CompressionType.LZ4
    ),
    "zstd messages": lambda path, entries: recordings.write_rosbag2(
        path / "bag", entries, compression=CompressionMode.MESSAGE
    ),
    "zstd messages in sqlite": lambda path, entries: recordings.write_rosbag2(
        path / "bag", entries, StoragePlugin.SQLITE3, CompressionMode.MESSAGE
    ),
    "zstd files": lambda path, entries: recordings.write_rosbag2(
        path / "bag", entries, StoragePlugin.SQLITE3, CompressionMode.FILE
    ),
    "no chunks": lambda path, entries: recordings.write_mcap(path / "bag.mcap", entries, use_chunking=False),
    "no index": lambda path, entries: recordings.write_mcap(
        path / "bag.mcap", entries, repeat_channels=False, repeat_schemas=False, use_statistics=False
    ),
    "no chunk index": lambda path, entries: recordings.write_mcap(
        path / "bag.mcap", entries, index_types=IndexType.NONE
    ),
    "files that overlap in time": lambda path, entries: [
        recordings.write_rosbag2(path / f"part_{part}", entries[part::3]) for part in range(3)
    ],
    "backwards": lambda path, entries: recordings.write_mcap(path / "bag.mcap", entries[::-1]),
    "backwards without chunks": lambda path, entries: recordings.write_mcap(
        path / "bag.mcap", entries[::-1], use_chunking=False
    ),
    "ros1": lambda path, entries: recordings.ros1_copy(path / "bag.bag"),
    "ros1 bz2": lambda path, entries: recordings.ros1_copy(
        path / "bag.bag", compression=Ros1Writer.CompressionFormat.BZ2
    ),
    "ros1 lz4": lambda path, entries: recordings.ros1_copy(
        path / "bag.bag", compression=Ros1Writer.CompressionFormat.LZ4
    ),
}


@pytest.mark.parametrize("storage", STORAGES)
def test_every_storage_gives_the_same_messages_in_time_order(storage: str, sample: list[Entry], tmp_path: Path):
    with open_recording(STORAGES[storage](tmp_path, sample)) as recording:
        messages = [message._replace(cdr=bytes(message.cdr)) for message in recording.messages()]
        assert sorted(messages) == sorted(as_messages(sample))
        assert [message.log_time for message in messages] == [entry.log_time for entry in sample]
        assert {name: (topic.type, topic.count) for name, topic in recording.topics.items()} == {
            entry.topic: (entry.type, sum(other.topic == entry.topic for other in sample)) for entry in sample
        }
        assert (recording.start, recording.end) == (sample[0].log_time, sample[-1].log_time)
        assert recording.damage is None


def test_compressed_files_of_the_same_name_from_two_folders_are_both_read(sample: list[Entry], tmp_path: Path):
    packed = []
    for half, entries in {"first": sample[:20], "second": sample[20:]}.items():
        (tmp_path / half).mkdir()
        mcap = recordings.write_mcap(tmp_path / f"{half}.mcap", entries)
        packed.append(recordings.zstd_file(mcap, tmp_path / half / "bag.mcap.zstd"))
    assert stamps(read(packed)) == stamps(as_messages(sample))


@pytest.mark.parametrize("storage", ["folder", "sqlite folder", "split folder", "ros1"])
def test_the_latched_transforms_are_known_as_latched(storage: str, sample: list[Entry], tmp_path: Path):
    with open_recording(STORAGES[storage](tmp_path, sample)) as recording:
        assert [profile.durability for profile in recording.topics["/tf_static"].qos or ()] == [
            QosDurability.TRANSIENT_LOCAL
        ]
        assert recording.topics["/lidar/points"].qos is None


@pytest.mark.parametrize("storage", ["folder", "sqlite folder", "ros1"])
def test_messages_are_read_as_objects_and_carry_their_definition(storage: str, sample: list[Entry], tmp_path: Path):
    with open_recording(STORAGES[storage](tmp_path, sample)) as recording:
        info = recording.deserialize(next(iter(recording.messages(["/camera/front/camera_info"]))))
        definition = recording.topics["/camera/front/camera_info"].definition or ""
    assert (info.width, info.height, info.header.frame_id) == (960, 540, "front_camera_optical_frame")
    assert info.k.shape == (9,)
    assert "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n" in definition


def test_raw_images_are_read_from_a_recording_larger_than_the_memory_they_take(tmp_path: Path):
    path = recordings.raw_copy(tmp_path / "raw", "bgr8")
    with open_recording(path) as recording:
        tracemalloc.start()
        total = sum(len(message.cdr) for message in recording.messages())
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert total > 90e6
    assert peak < 20e6


# Choosing


@pytest.mark.parametrize("storage", ["folder", "sqlite folder", "split folder", "ros1", "no chunks"])
def test_a_time_window_includes_its_start_and_excludes_its_stop(storage: str, sample: list[Entry], tmp_path: Path):
    start, stop = sample[50].log_time, sample[180].log_time
    messages = read(STORAGES[storage](tmp_path, sample), start=start, stop=stop)
    assert stamps(messages) == sorted((e.topic, e.log_time) for e in sample if start <= e.log_time < stop)


@pytest.mark.parametrize("storage", ["folder", "sqlite folder", "split folder", "ros1"])
def test_only_the_chosen_topics_come(storage: str, sample: list[Entry], tmp_path: Path):
    with open_recording(STORAGES[storage](tmp_path, sample)) as recording:
        assert {message.topic for message in recording.messages(["/odom", "/lidar/points"])} == {
            "/odom",
            "/lidar/points",
        }
        assert list(recording.messages([])) == []


def test_an_unknown_topic_is_named_with_those_that_exist():
    with (
        open_recording(SAMPLE) as recording,
        pytest.raises(RecordingError, match=r"no topic \['/lidar'\].*/lidar/points"),
    ):
        recording.messages(["/lidar"])


# Damage


def test_a_cut_recording_gives_every_message_before_the_cut(checked_mcap: Path, tmp_path: Path):
    path = recordings.cut(checked_mcap, tmp_path / "cut.mcap")
    whole = [chunk for chunk in recordings.stored_chunks(checked_mcap) if chunk.end <= path.stat().st_size]
    with open_recording(path) as recording:
        messages = list(recording.messages())
        assert stamps(messages) == expected_stamps(whole)
        assert sum(topic.count for topic in recording.topics.values()) == len(messages) > 100
        assert str(path) in (recording.damage or "")
        assert f"{len(messages)} messages" in (recording.damage or "")


def test_a_folder_whose_recorder_died_is_read_without_its_metadata(tmp_path: Path):
    (tmp_path / "bag").mkdir()
    recordings.cut(SAMPLE_MCAP, tmp_path / "bag" / "bag_0.mcap")
    with open_recording(tmp_path / "bag") as recording:
        assert len(list(recording.messages())) > 100
        assert "no metadata.yaml" in (recording.damage or "")


def test_a_recording_preallocated_with_zeros_is_read_up_to_them(checked_mcap: Path, tmp_path: Path):
    path = recordings.cut(checked_mcap, tmp_path / "zeros.mcap")
    cut, size = stamps(read(path)), path.stat().st_size
    with path.open("ab") as stream:
        stream.truncate(size + 1_000_000)
    with open_recording(path) as recording:
        assert stamps(list(recording.messages())) == cut
        from_byte = re.search(r"cut or unreadable from byte (\d+)", recording.damage or "")
    assert from_byte
    assert int(from_byte[1]) < size + 256 * 1024, "the zeros are not walked through"


@pytest.mark.parametrize("index_lost", [False, True])
def test_a_chunk_with_a_wrong_checksum_is_skipped_and_reported(index_lost: bool, checked_mcap: Path, tmp_path: Path):
    bad, *others = reversed(recordings.stored_chunks(checked_mcap)[:6])
    path = recordings.flipped_byte(checked_mcap, tmp_path / "flipped.mcap", (bad.start + bad.end) // 2)
    if index_lost:
        path.write_bytes(path.read_bytes()[:-100])
    kept = [chunk for chunk in recordings.stored_chunks(checked_mcap) if chunk.start != bad.start]
    assert len(others) == 5
    with open_recording(path) as recording:
        assert stamps(list(recording.messages())) == expected_stamps(kept)
        assert list(recording.messages()), "a second pass is as good as the first"
        assert (recording.damage or "").count(f"chunk at byte {bad.start} skipped") == 1


def test_the_write_ahead_log_of_a_crashed_recorder_is_read(sample: list[Entry], tmp_path: Path):
    path = recordings.crashed_sqlite(tmp_path / "crashed.db3", sample, unsaved=40)
    before = sorted(file.name for file in tmp_path.iterdir()), path.read_bytes()
    assert stamps(read(path)) == stamps(as_messages(sample))
    assert (sorted(file.name for file in tmp_path.iterdir()), path.read_bytes()) == before, "nothing is changed"


def test_a_message_beyond_measure_in_a_database_costs_only_itself(
    sample: list[Entry], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sqlite_file, "MAX_BLOCK_BYTES", 1_000_000)
    path = recordings.sqlite_copy(tmp_path / "bag")
    with closing(sqlite3.connect(path / "bag.db3")) as database:
        database.execute("UPDATE messages SET data = zeroblob(?) WHERE id = 3", (1_000_001,))
        database.commit()
    with open_recording(path) as recording:
        assert stamps(list(recording.messages())) == stamps(as_messages([*sample[:2], *sample[3:]]))
        assert f"{sample[2].topic} at {sample[2].log_time} ns skipped: 1000001 bytes" in (recording.damage or "")


def test_a_definition_in_another_character_set_is_read_from_a_database(tmp_path: Path):
    path = recordings.sqlite_copy(tmp_path / "bag", sets=1)
    with closing(sqlite3.connect(path / "bag.db3")) as database:
        text = b"float32 a # in \xb0C".hex()
        database.execute(
            "INSERT INTO message_definitions(topic_type, encoding, encoded_message_definition, type_description_hash) "
            f"VALUES ('my_msgs/msg/Angle', 'ros2msg', CAST(x'{text}' AS TEXT), '')"
        )
        database.execute("UPDATE topics SET type = 'my_msgs/msg/Angle' WHERE name = '/odom'")
        database.commit()
    with open_recording(path) as recording:
        assert recording.topics["/odom"].definition == "float32 a # in \ufffdC"
        assert recording.damage is None


@pytest.mark.skipif(sys.version_info < (3, 11), reason="sqlite3 has no limits")
def test_a_name_beyond_measure_in_a_database_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sqlite_file, "MAX_BLOCK_BYTES", 100_000)
    path = recordings.sqlite_copy(tmp_path / "bag")
    with closing(sqlite3.connect(path / "bag.db3")) as database:
        database.execute("UPDATE topics SET type = ? WHERE id = 1", ("x" * 200_000,))
        database.commit()
    with pytest.raises(RecordingError, match=r"bag.db3: not readable as a rosbag2 database: string or blob too big"):
        open_recording(path)


def test_one_damaged_file_of_a_split_recording_costs_only_itself(tmp_path: Path):
    path = recordings.split_copy(tmp_path / "bag")
    whole = {message for name in ("bag_0", "bag_2") for message in read(path / f"{name}.mcap")}
    (path / "bag_1.mcap").write_bytes(b"")
    with open_recording(path) as recording:
        assert set(recording.messages()) == whole
        assert "bag_1.mcap: is empty (0 bytes)" in (recording.damage or "")


def test_a_missing_file_of_a_split_recording_is_reported(tmp_path: Path):
    path = recordings.split_copy(tmp_path / "bag")
    (path / "bag_1.mcap").unlink()
    with open_recording(path) as recording:
        assert "lists bag_1.mcap, not found" in (recording.damage or "")
        assert list(recording.messages())


def test_a_file_of_the_folder_that_the_metadata_does_not_list_is_reported(tmp_path: Path):
    path = Path(shutil.copytree(SAMPLE, tmp_path / "bag"))
    shutil.copy(SAMPLE_MCAP, path / "bag_1.mcap")
    recordings.zstd_file(SAMPLE_MCAP, path / f"{SAMPLE_MCAP.name}.zstd")
    with open_recording(path) as recording:
        assert recording.damage == f"{path}: metadata.yaml does not list bag_1.mcap, not read"


def test_an_unreadable_metadata_file_is_reported_and_not_needed(tmp_path: Path):
    path = Path(shutil.copytree(SAMPLE, tmp_path / "bag"))
    (path / "metadata.yaml").write_bytes(b"")
    with open_recording(path) as recording:
        assert len(list(recording.messages())) == 271
        assert "metadata.yaml: unreadable" in (recording.damage or "")


def test_a_compressed_message_that_is_damaged_is_skipped_and_reported(sample: list[Entry], tmp_path: Path):
    broken = [
        entry._replace(cdr=b"\x28\xb5\x2f\xfd junk") if index < 9 else entry for index, entry in enumerate(sample)
    ]
    with open_recording(recordings.write_rosbag2(tmp_path / "bag", broken)) as recording:
        for _ in range(2):
            assert list(recording.messages()) == as_messages(sample[9:])
        assert f"{sample[0].topic} at {sample[0].log_time} ns skipped" in (recording.damage or "")
        assert (recording.damage or "").endswith("and 4 more")


def test_channels_that_are_not_cdr_are_left_out_and_reported(sample: list[Entry], tmp_path: Path):
    with (tmp_path / "mixed.mcap").open("wb") as stream:
        writer = recordings.mcap.writer.Writer(stream)
        writer.start()
        schema = writer.register_schema("nav_msgs/msg/Odometry", "ros2msg", b"")
        odometry = next(entry for entry in sample if entry.topic == "/odom")
        writer.add_message(writer.register_channel("/odom", "cdr", schema), 5, odometry.cdr, 5)
        writer.add_message(writer.register_channel("/log", "json", 0), 6, b"{}", 6)
        writer.finish()
    with open_recording(tmp_path / "mixed.mcap") as recording:
        assert list(recording.topics) == ["/odom"]
        assert [message.log_time for message in recording.messages()] == [5]
        assert "left out /log (encoding 'json')" in (recording.damage or "")


# What is no recording


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def empty_folder(path: Path) -> Path:
    (path / "folder").mkdir()
    return path / "folder"


def folder_of_unknown_storage(path: Path) -> Path:
    shutil.copytree(SAMPLE, path / "bag")
    metadata = yaml.safe_load((path / "bag" / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"].update(storage_identifier="foo", relative_file_paths=["bag.foo"])
    (path / "bag" / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    write(path / "bag" / "bag.foo", b"FOO storage")
    return path / "bag"


NO_RECORDINGS = {
    "missing": (lambda path: path / "nothing.mcap", "nothing.mcap: does not exist"),
    "empty": (lambda path: write(path / "a.mcap", b""), r"a.mcap: is empty \(0 bytes\)"),
    "wrong magic": (lambda path: write(path / "a.mcap", b"\x89PNG\r\n\x1a\n" * 9), r"a.mcap: begins with b'\\x89PNG"),
    "only a beginning": (lambda path: write(path / "a.mcap", SAMPLE_MCAP.read_bytes()[:5000]), "no readable message"),
    "empty folder": (empty_folder, "no recording in this folder; found nothing"),
    "folder of recordings": (lambda path: SAMPLE.parent, "no recording in this folder; found pandaset_002_excerpt"),
    "unknown storage": (folder_of_unknown_storage, r"bag.foo: begins with b'FOO storage'"),
    "sqlite of something else": (
        lambda path: write(path / "a.db3", b"SQLite format 3\0" + bytes(5000)),
        "a.db3: not readable as a rosbag2 database",
    ),
    "cut ROS 1 bag": (
        lambda path: recordings.cut(recordings.ros1_copy(path / "whole.bag", sets=1), path / "a.bag", 0.005),
        "holds no readable message .*a.bag: cut or unreadable from byte",
    ),
}


@pytest.mark.parametrize("case", NO_RECORDINGS)
def test_what_is_no_recording_is_named_with_what_was_found(case: str, tmp_path: Path):
    make, reason = NO_RECORDINGS[case]
    path = make(tmp_path)
    with pytest.raises(RecordingError, match=reason) as raised:
        open_recording(path)
    assert "\n" not in str(raised.value)


def test_a_recording_without_messages_is_refused(tmp_path: Path):
    with pytest.raises(RecordingError, match="holds no readable message"):
        open_recording(recordings.write_rosbag2(tmp_path / "bag", []))


def test_no_path_at_all_is_refused():
    with pytest.raises(RecordingError, match="list of paths is empty"):
        open_recording([])


# Types


def custom_recording(path: Path, type_: str, definition: str, **fields: object) -> Path:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, type_))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/topic", type_, typestore=store)
        writer.write(topic, 1, store.serialize_cdr(store.types[type_](**fields), type_))
    return path


def test_a_type_of_their_own_is_read_by_the_definition_in_the_recording(tmp_path: Path):
    path = custom_recording(tmp_path / "bag", "fleet_msgs/msg/Gear", "int32 gear\nstring name\n", gear=3, name="third")
    with open_recording(path) as recording:
        message = recording.deserialize(next(recording.messages()))
    assert (message.gear, message.name) == (3, "third")
    assert "fleet_msgs/msg/Gear" not in typestore().fielddefs


def test_the_recordings_own_definition_of_a_common_type_wins(tmp_path: Path):
    path = custom_recording(tmp_path / "bag", "sensor_msgs/msg/Temperature", "float64 celsius\n", celsius=21.5)
    with open_recording(path) as recording:
        assert recording.deserialize(next(recording.messages())).celsius == 21.5


@pytest.mark.parametrize(
    ("nothing", "something"),
    [
        ("int32[0] a", "int32[1] a"),
        ("std_msgs/Empty a", "std_msgs/Bool a"),
        ("y/C a", "y/D a"),
        ("y/C[3] a", "y/D[3] a"),
    ],
)
def test_a_sequence_whose_elements_have_no_bytes_is_not_used(nothing: str, something: str):
    line = "=" * 80
    definition = f"y/B[] a\n{line}\nMSG: y/B\n%s\n{line}\nMSG: y/C\n{line}\nMSG: y/D\nbool a\n"
    assert parsed_definition(definition % nothing, "x/msg/A") == {}
    assert parsed_definition(definition % something, "x/msg/A").keys() > {"x/msg/A", "y/msg/B"}


def test_a_message_too_short_for_its_type_is_named(sample: list[Entry], tmp_path: Path):
    odometry = next(entry for entry in sample if entry.topic == "/odom")
    path = recordings.write_rosbag2(tmp_path / "bag", [odometry._replace(cdr=odometry.cdr[:60])])
    with (
        open_recording(path) as recording,
        pytest.raises(RecordingError, match=r"/odom at \d+ ns: 60 bytes .*Odometry"),
    ):
        recording.deserialize(next(recording.messages()))


def test_a_type_that_nobody_defines_is_named(sample: list[Entry], tmp_path: Path):
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = recordings.mcap.writer.Writer(stream)
        writer.start("ros2")
        channel = writer.register_channel("/gear", "cdr", writer.register_schema("a_msgs/msg/Gear", "ros2msg", b""))
        writer.add_message(channel, 5, sample[0].cdr, 5)
        writer.finish()
    with (
        open_recording(tmp_path / "a.mcap") as recording,
        pytest.raises(RecordingError, match="a_msgs/msg/Gear is not"),
    ):
        recording.deserialize(next(recording.messages()))


def two_types(path: Path, sample: list[Entry]) -> tuple[list[Entry], list[Entry]]:
    """Two odometry messages and one of transforms, all under one name."""
    odometry = [entry for entry in sample if entry.topic == "/odom"][:2]
    return odometry, [sample[0]._replace(topic="/odom")]


TWO_TYPES = {
    "files": lambda path, one, other: [
        recordings.write_rosbag2(path / "first", other),
        recordings.write_rosbag2(path / "second", one),
    ],
    "mcap": lambda path, one, other: recordings.write_mcap(path / "a.mcap", [*other, *one], by_type=True),
    "sqlite": lambda path, one, other: recordings.sqlite_with_types(path / "a", [*other, *one]),
    "ros1": lambda path, one, other: recordings.ros1_with_types(path / "a.bag", [*other, *one]),
}


@pytest.mark.parametrize("storage", TWO_TYPES)
def test_two_types_under_one_name_are_two_topics(storage: str, sample: list[Entry], tmp_path: Path):
    one, other = two_types(tmp_path, sample)
    with open_recording(TWO_TYPES[storage](tmp_path, one, other)) as recording:
        assert {name: (topic.type, topic.count) for name, topic in recording.topics.items()} == {
            "/odom": ("nav_msgs/msg/Odometry", 2),
            "/odom (tf2_msgs/msg/TFMessage)": ("tf2_msgs/msg/TFMessage", 1),
        }
        assert [hasattr(recording.deserialize(m), "pose") for m in recording.messages(["/odom"])] == [True, True]
        (message,) = recording.messages(["/odom (tf2_msgs/msg/TFMessage)"])
        assert recording.deserialize(message).transforms


# Writing


def copy_with_our_writer(path: Path, entries: list[Entry], compress: bool = False) -> Path:
    with RecordingWriter(path, compress=compress) as writer:
        for entry in {entry.topic: entry for entry in entries}.values():
            writer.add_topic(entry.topic, entry.type)
        for entry in entries:
            writer.write(entry.topic, entry.log_time, entry.cdr)
    return path


@pytest.mark.parametrize("compress", [False, True])
def test_what_is_written_is_read_by_rosbags_and_mcap(compress: bool, sample: list[Entry], tmp_path: Path):
    path = copy_with_our_writer(tmp_path / "out", sample, compress)
    expected = sorted(as_messages(sample))
    with Reader(path) as reader:
        assert sorted((c.topic, t, bytes(cdr)) for c, t, cdr in reader.messages(reader.connections)) == expected
    with (path / "out.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert len(list(reader.iter_messages())) == len(sample)
    assert summary is not None
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert all(schema.data for schema in summary.schemas.values())
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd" if compress else ""}


def test_metadata_is_what_ros2_bag_expects(sample: list[Entry], tmp_path: Path):
    path = copy_with_our_writer(tmp_path / "out", sample)
    information = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["storage_identifier"] == "mcap"
    assert information["relative_file_paths"] == ["out.mcap"]
    assert information["message_count"] == 271
    assert information["starting_time"]["nanoseconds_since_epoch"] == sample[0].log_time
    assert information["duration"]["nanoseconds"] == sample[-1].log_time - sample[0].log_time
    topics = [entry["topic_metadata"] for entry in information["topics_with_message_count"]]
    assert all(topic["type_description_hash"].startswith("RIHS01_") for topic in topics)
    assert all(topic["serialization_format"] == "cdr" for topic in topics)
    assert all(isinstance(topic["offered_qos_profiles"], str) for topic in topics), "Humble wants YAML in a string"


def test_only_tf_static_is_latched_unless_told_otherwise(sample: list[Entry], tmp_path: Path):
    path = copy_with_our_writer(tmp_path / "out", sample)
    with RecordingWriter(tmp_path / "latched") as writer:
        writer.add_topic("/map", "sensor_msgs/msg/PointCloud2", [LATCHED])
        writer.write("/map", 1, next(entry.cdr for entry in sample if entry.topic == "/lidar/points"))
    with open_recording(path) as written, open_recording(tmp_path / "latched") as latched:
        durability = {name: [qos.durability for qos in topic.qos or ()] for name, topic in written.topics.items()}
        assert durability.pop("/tf_static") == [QosDurability.TRANSIENT_LOCAL]
        assert set(map(tuple, durability.values())) == {(QosDurability.VOLATILE,)}
        assert [qos.reliability for qos in written.topics["/tf"].qos or ()] == [QosReliability.RELIABLE]
        assert latched.topics["/map"].qos == (LATCHED,)


def test_messages_can_be_written_as_objects(tmp_path: Path):
    types = typestore().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 2), "front")
    image = types["sensor_msgs/msg/Image"](header, 1, 2, "mono8", 0, 2, np.array([3, 4], np.uint8))
    with RecordingWriter(tmp_path / "out") as writer:
        writer.add_topic("/image", "sensor_msgs/msg/Image")
        writer.write("/image", 7, image)
    with open_recording(tmp_path / "out") as recording:
        again = recording.deserialize(next(recording.messages()))
    assert (again.header.frame_id, again.encoding, again.data.tolist()) == ("front", "mono8", [3, 4])


def test_a_topic_with_a_type_of_their_own_is_copied_with_its_definition(tmp_path: Path):
    source = custom_recording(tmp_path / "bag", "fleet_msgs/msg/Gear", "int32 gear\n", gear=3)
    with open_recording(source) as recording, RecordingWriter(tmp_path / "out") as writer:
        topic = recording.topics["/topic"]
        writer.add_topic(topic.name, topic.type, definition=topic.definition)
        for message in recording.messages():
            writer.write(*message)
    with open_recording(tmp_path / "out") as recording:
        assert recording.deserialize(next(recording.messages())).gear == 3


def test_an_existing_path_is_never_overwritten(tmp_path: Path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious.txt").write_text("precious")
    with pytest.raises(RecordingError, match="out: exists already"):
        RecordingWriter(tmp_path / "out")
    assert (tmp_path / "out" / "precious.txt").read_text() == "precious"


def test_a_path_that_cannot_be_created_is_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="file/out: cannot be created"):
        RecordingWriter(tmp_path / "file" / "out")


def test_an_interrupted_write_keeps_what_was_written(sample: list[Entry], tmp_path: Path):
    def interrupted() -> None:
        with RecordingWriter(tmp_path / "out") as writer:
            writer.add_topic("/odom", "nav_msgs/msg/Odometry")
            for entry in sample:
                if entry.topic == "/odom":
                    writer.write(entry.topic, entry.log_time, entry.cdr)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with open_recording(tmp_path / "out") as recording:
        assert recording.topics["/odom"].count == 70
        assert recording.damage is None


def test_a_killed_writer_leaves_its_complete_chunks(sample: list[Entry], tmp_path: Path):
    writer = RecordingWriter(tmp_path / "out")
    for entry in {entry.topic: entry for entry in sample}.values():
        writer.add_topic(entry.topic, entry.type)
    for entry in sample:
        writer.write(entry.topic, entry.log_time, entry.cdr)
    shutil.copytree(tmp_path / "out", tmp_path / "killed")  # what the disk holds at that moment
    writer.close()
    with open_recording(tmp_path / "killed") as recording:
        recovered = list(recording.messages())
        assert recovered == as_messages(sample)[: len(recovered)]
        assert len(recovered) > 200
        assert "no metadata.yaml" in (recording.damage or "")


def test_misuse_of_the_writer_is_named(sample: list[Entry], tmp_path: Path):
    with RecordingWriter(tmp_path / "out") as writer:
        writer.add_topic("/odom", "nav_msgs/msg/Odometry")
        with pytest.raises(RecordingError, match="/odom was added twice"):
            writer.add_topic("/odom", "nav_msgs/msg/Odometry")
        with pytest.raises(RecordingError, match="fleet_msgs/msg/Gear is not known"):
            writer.add_topic("/gear", "fleet_msgs/msg/Gear")
        with pytest.raises(RecordingError, match=r"/image was not added; known are \['/odom'\]"):
            writer.write("/image", 1, b"")
        with pytest.raises(RecordingError, match="/odom: no nav_msgs/msg/Odometry"):
            writer.write("/odom", 1, typestore().types["builtin_interfaces/msg/Time"](1, 2))
    writer.close()
