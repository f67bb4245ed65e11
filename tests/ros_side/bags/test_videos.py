# SPDX-License-Identifier: Apache-2.0
"""Camera streams of H.264 and H.265 in recordings: every image is what the camera saw, whichever is asked for first."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
import small_rig
from numpy.typing import NDArray
from recordings import Entry
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from small_rig import BEGIN, YAWS
from video_packets import ENCODERS, KEY_EVERY, encoded

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags import Recording, open_recording
from cvcdepth_ros.bags.video import COMPRESSED_VIDEO, FFMPEG_PACKET, VIDEO_DEFINITIONS
from cvcdepth_ros.messages.conversion import picture_from_message
from cvcdepth_ros.recordings.replay import SurroundReplay
from cvcdepth_ros.recordings.rig import RecordedRig, discover_rig
from cvcdepth_ros.settings import MatchingSettings

FRAMES = 14
HEIGHT, WIDTH = small_rig.HEIGHT, small_rig.WIDTH

STORE = get_typestore(Stores.ROS2_JAZZY)
for name, definition in VIDEO_DEFINITIONS.items():
    STORE.register(get_types_from_msg(definition, name))


def pictures_of(camera: str) -> list[NDArray[np.uint8]]:
    return [small_rig.picture(camera, number) for number in range(FRAMES)]


@pytest.fixture(scope="module", params=ENCODERS)
def codec(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def packets(codec: str) -> dict[str, list[bytes]]:
    return {camera: encoded(pictures_of(camera), codec) for camera in YAWS}


def message(type_: str, time: int, frame: str, packet: bytes, codec: str) -> Any:
    data = np.frombuffer(packet, np.uint8)
    header = small_rig.header(time, frame)
    if type_ == COMPRESSED_VIDEO:
        format_ = {"h264": "h264", "hevc": "h265"}[codec]
        return STORE.types[type_](timestamp=header.stamp, frame_id=frame, data=data, format=format_)
    return STORE.types[type_](
        header=header, width=WIDTH, height=HEIGHT, encoding=f"{ENCODERS[codec]};yuv420p;bgr8;bgr8", pts=7, flags=0,
        is_bigendian=False, data=data,
    )  # fmt: skip


TOPICS = {COMPRESSED_VIDEO: "/{}/video", FFMPEG_PACKET: "/{}/image_raw/ffmpeg"}


def drive(type_: str, packets: dict[str, list[bytes]], codec: str) -> list[Entry]:
    others = [e for e in small_rig.entries(frames=FRAMES) if e.type != small_rig.COMPRESSED]
    images = []
    for camera, sent in packets.items():
        for number, packet in enumerate(sent):
            time = BEGIN + number * 10**8
            cdr = STORE.serialize_cdr(message(type_, time, f"{camera}_optical", packet, codec), type_)
            images.append(Entry(TOPICS[type_].format(camera), type_, time, bytes(cdr)))
    return small_rig.in_time(others, images)


def write(path: Path, entries: list[Entry], storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    known, recordings.JAZZY = recordings.JAZZY, STORE
    try:
        return recordings.write_rosbag2(path / "drive", entries, storage)
    finally:
        recordings.JAZZY = known


@pytest.fixture(scope="module", params=TOPICS)
def recorded(
    request: pytest.FixtureRequest,
    packets: dict[str, list[bytes]],
    codec: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, str]:
    path = write(tmp_path_factory.mktemp("video"), drive(request.param, packets, codec))
    return path, TOPICS[request.param].format("port")


def rgb(image: Any) -> NDArray[np.uint8]:
    return picture_from_message(image, "port")


def assert_shows(image: Any, number: int) -> None:
    difference = np.abs(rgb(image).astype(int) - pictures_of("port")[number][..., ::-1])
    assert difference.mean() < 6, number


def messages_of(recording: Recording, topic: str, **window: int) -> list[Any]:
    return list(recording.messages([topic], **window))


def test_every_packet_becomes_its_image_with_its_stamp_and_frame(recorded: tuple[Path, str]):
    path, topic = recorded
    with open_recording(path) as recording:
        for number, found in enumerate(recording.messages([topic])):
            image = recording.deserialize(found)
            assert_shows(image, number)
            assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == BEGIN + number * 10**8
            assert (image.header.frame_id, image.width, image.height) == ("port_optical", WIDTH, HEIGHT)
        assert number == FRAMES - 1


@pytest.mark.parametrize("order", [[13, 2, 8, 8, 7, 0, 9], [5, 4, 3], [1, 3, 5, 11, 12]])
def test_any_image_is_decoded_from_its_key_frame_on(recorded: tuple[Path, str], order: list[int]):
    path, topic = recorded
    with open_recording(path) as recording:
        found = messages_of(recording, topic)
        for number in order:
            assert_shows(recording.deserialize(found[number]), number)


def test_a_part_that_begins_between_key_frames_is_decoded(recorded: tuple[Path, str]):
    path, topic = recorded
    with open_recording(path) as recording:
        first = BEGIN + 9 * 10**8
        for number, found in enumerate(messages_of(recording, topic, start=first), 9):
            assert_shows(recording.deserialize(found), number)


def test_the_cameras_are_found_and_their_images_matched(recorded: tuple[Path, str]):
    path, _ = recorded
    with open_recording(path) as recording:
        replay = SurroundReplay(RecordedRig.from_recording(recording), MatchingSettings())
        sets = list(replay.sets())
        assert len(sets) == FRAMES
        for number, found in enumerate(sets):
            assert_shows(found.images["port"].message, number)


def test_a_database_that_tells_no_definition_is_read(packets: dict[str, list[bytes]], codec: str, tmp_path: Path):
    path = write(tmp_path, drive(FFMPEG_PACKET, packets, codec), StoragePlugin.SQLITE3)
    with open_recording(path) as recording:
        for number, found in enumerate(recording.messages(["/port/image_raw/ffmpeg"])):
            assert_shows(recording.deserialize(found), number)


@pytest.mark.parametrize("change", ["cut", "empty", "rubbish"])
def test_a_damaged_packet_costs_what_depends_on_it_and_no_more(
    change: str, packets: dict[str, list[bytes]], codec: str, tmp_path: Path
):
    if (change, codec) == ("cut", "hevc"):
        pytest.skip("FFmpeg does not notice that a unit of H.265 was cut")
    content = {"cut": packets["port"][8][:20], "empty": b"", "rubbish": b"\0\0\0\1\x01" + bytes(40)}[change]
    bad = {**packets, "port": [content if n == 8 else p for n, p in enumerate(packets["port"])]}
    with open_recording(write(tmp_path, drive(COMPRESSED_VIDEO, bad, codec))) as recording:
        shown = []
        for number, found in enumerate(recording.messages(["/port/video"])):
            try:
                assert_shows(recording.deserialize(found), number)
                shown.append(number)
            except RecordingError as error:
                assert "/port/video at" in str(error)  # noqa: PT017
    assert {*range(8), 12, 13} <= set(shown)
    assert 8 not in shown


def test_a_stream_that_never_sends_a_key_frame_is_named(packets: dict[str, list[bytes]], codec: str, tmp_path: Path):
    late = {camera: sent[1:KEY_EVERY] for camera, sent in packets.items()}
    with open_recording(write(tmp_path, drive(COMPRESSED_VIDEO, late, codec))) as recording:
        first = messages_of(recording, "/port/video")[0]
        with pytest.raises(RecordingError, match=r"/port/video at \d+ ns: .*no key frame in the 32 s before"):
            recording.deserialize(first)


def test_another_codec_is_refused_by_name(packets: dict[str, list[bytes]], tmp_path: Path):
    entries = drive(COMPRESSED_VIDEO, packets, "h264")
    odd = [recordings.Entry(e.topic, e.type, e.log_time, e.cdr.replace(b"h264\0", b"vp9x\0")) for e in entries]
    with open_recording(write(tmp_path, odd)) as recording:
        first = messages_of(recording, "/port/video")[0]
        with pytest.raises(RecordingError, match=r"video of 'vp9x' is not read; H.264 and H.265 are"):
            recording.deserialize(first)


def test_without_pyav_one_line_names_the_extra(recorded: tuple[Path, str], monkeypatch: pytest.MonkeyPatch):
    path, topic = recorded
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.setattr("cvcdepth_core.images.video.find_spec", lambda _: None)
    with open_recording(path) as recording:
        assert len(discover_rig(recording).cameras) == 3
        with pytest.raises(RecordingError, match=r"pip install 'cvcdepth_ros\[video\]' reads them") as raised:
            recording.deserialize(messages_of(recording, topic)[0])
    assert "\n" not in str(raised.value)
