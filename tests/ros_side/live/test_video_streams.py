# SPDX-License-Identifier: Apache-2.0
"""Packets of live cameras' video: decoded all and in order, whichever pictures are wanted."""

import threading
from collections.abc import Iterator
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import small_rig
from video_packets import ENCODERS, KEY_EVERY, encoded

from cvcdepth_core.errors import ImageError
from cvcdepth_core.images.video import VideoDecoder
from cvcdepth_ros.live.video_streams import VideoStreams
from cvcdepth_ros.messages.conversion import picture_from_message, stamp_ns

PICTURES = [small_rig.picture("port", number) for number in range(14)]


@pytest.fixture(scope="module", params=ENCODERS)
def codec(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def packets(codec: str) -> list[Any]:
    """As the two kinds of messages bring them."""
    contents = encoded(PICTURES, codec)
    if codec == "hevc":
        stamps = [SimpleNamespace(sec=number, nanosec=0) for number in range(len(contents))]
        return [
            SimpleNamespace(timestamp=stamp, frame_id="optical", data=content, format="h265")
            for stamp, content in zip(stamps, contents, strict=True)
        ]
    headers = [small_rig.header(number * 10**9, "optical") for number in range(len(contents))]
    return [
        SimpleNamespace(header=header, pts=number, encoding="libx264;yuv420p", data=content)
        for number, (header, content) in enumerate(zip(headers, contents, strict=True))
    ]


@pytest.fixture
def streams() -> Iterator[VideoStreams]:
    with closing(VideoStreams()) as streams:
        yield streams


def test_a_picture_is_that_of_a_recording_although_the_ones_before_were_not_looked_at(
    packets: list[Any], codec: str, streams: VideoStreams
):
    decoder = VideoDecoder(codec, "port")
    recorded = [decoder.decode(packet.data) for packet in packets]
    live = [streams.take("port", packet) for packet in packets]
    for number in (10, 3, 13):
        size = (small_rig.WIDTH, small_rig.HEIGHT)
        assert np.array_equal(picture_from_message(live[number], "port", 1, size), recorded[number])
        assert stamp_ns(live[number]) == number * 10**9


def test_who_joins_late_waits_for_the_next_key_frame(packets: list[Any], streams: VideoStreams):
    for packet in packets[1:KEY_EVERY]:
        with pytest.raises(ImageError, match="camera port: waiting for a key frame: its video began before"):
            streams.take("port", packet)
    assert picture_from_message(streams.take("port", packets[KEY_EVERY]), "port").shape[2] == 3


def test_a_lost_packet_costs_all_up_to_the_next_key_frame_of_its_camera_only(packets: list[Any], streams: VideoStreams):
    def shows(camera: str, packet: Any) -> bool:
        try:
            return picture_from_message(streams.take(camera, packet), camera).any()
        except ImageError:
            return False

    sent = {"port": [*packets[:2], *packets[3:]], "starboard": packets}
    shown = {camera: [shows(camera, packet) for packet in contents] for camera, contents in sent.items()}
    assert shown["port"] == [True] * 2 + [False] * (KEY_EVERY - 3) + [True] * 8
    assert all(shown["starboard"])
    with pytest.raises(ImageError, match="waiting for a key frame: its video is damaged, or packets were lost"):
        [streams.take("port", packet) and shows("port", packet) for packet in (*packets[:2], *packets[3:5])]


def test_a_video_that_comes_faster_than_it_is_decoded_is_cut_at_key_frames(
    packets: list[Any], streams: VideoStreams, monkeypatch: pytest.MonkeyPatch
):
    may_go_on = threading.Event()
    decode = VideoDecoder.take

    def slowly(decoder: VideoDecoder, packet: bytes) -> Any:
        assert may_go_on.wait(30)
        return decode(decoder, packet)

    monkeypatch.setattr(VideoDecoder, "take", slowly)
    monkeypatch.setattr("cvcdepth_ros.live.video_streams._MOST_WAITING", 3)
    taken = [streams.take("port", packet) for packet in packets[:3]]
    for packet in packets[3 : KEY_EVERY + 2]:
        with pytest.raises(ImageError, match="its video comes faster than it can be decoded"):
            streams.take("port", packet)
    may_go_on.set()
    assert all(image.width == small_rig.WIDTH for image in taken)
    assert streams.take("port", packets[2 * KEY_EVERY]).width == small_rig.WIDTH


def test_another_codec_is_refused_by_name(packets: list[Any], streams: VideoStreams):
    odd = SimpleNamespace(timestamp=packets[0], frame_id="", data=b"", format="vp9")
    with pytest.raises(ImageError, match=r"camera port: video of 'vp9' is not read; H.264 and H.265 are"):
        streams.take("port", odd)
