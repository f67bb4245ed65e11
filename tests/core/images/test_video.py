# SPDX-License-Identifier: Apache-2.0
"""One camera's video stream, packet by packet, as a node receives it."""

from contextlib import suppress

import numpy as np
import pytest
from numpy.typing import NDArray
from video_packets import ENCODERS, KEY_EVERY, encoded

from cvcdepth_core.errors import ImageError
from cvcdepth_core.images.video import VideoDecoder, codec_of, is_key_frame

NOISE = np.random.default_rng(0).integers(0, 255, (240, 64), np.uint8).repeat(5, axis=1)
TALL = [np.roll(NOISE, 3 * number, 1)[..., None].repeat(3, 2) for number in range(4)]
"""High enough to be sent in slices."""


@pytest.fixture(scope="module")
def pictures() -> list[NDArray[np.uint8]]:
    """BGR, smooth, each a little further than the one before."""
    rows, columns = np.mgrid[0:48, 0:64]
    return [
        np.stack([np.uint8(128 + 60 * np.sin(columns / 9 + k + n / 5) * np.cos(rows / 7)) for k in range(3)], axis=-1)
        for n in range(14)
    ]


@pytest.fixture(scope="module", params=ENCODERS)
def codec(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def packets(pictures: list[NDArray[np.uint8]], codec: str) -> list[bytes]:
    return encoded(pictures, codec)


def test_pictures_in_another_order_than_shown_are_refused(pictures: list[NDArray[np.uint8]]):
    sent = encoded(pictures, "h264", b_frames=2)
    decoder = VideoDecoder("h264", "port")
    with pytest.raises(ImageError, match=r"camera port: h264 packet of \d+ bytes gives no picture"):
        [decoder.decode(packet) for packet in sent]


def test_a_live_stream_is_decoded_packet_by_packet(packets: list[bytes], pictures: list[NDArray[np.uint8]], codec: str):
    decoder = VideoDecoder(codec, "port")
    with pytest.raises(ImageError, match="without a key frame before it"):
        decoder.decode(packets[3])
    assert not decoder.is_ready
    for number, packet in enumerate(packets[KEY_EVERY:], KEY_EVERY):
        found = decoder.decode(packet)
        assert np.abs(found.astype(int) - pictures[number][..., ::-1]).mean() < 6


def test_pictures_of_several_slices_are_decoded():
    sent, shown = encoded(TALL, "h264"), VideoDecoder("h264", "port")
    assert sent[1].count(b"\0\0\1") > 1  # or this shows nothing
    for packet, picture in zip(sent, TALL, strict=True):
        assert np.abs(shown.decode(packet).astype(int) - picture[..., ::-1]).mean() < 6


@pytest.mark.parametrize("lost", [1, 2, 40])
def test_after_a_lost_packet_nothing_is_shown_before_the_next_key_frame(
    lost: int, packets: list[bytes], codec: str, pictures: list[NDArray[np.uint8]]
):
    pictures = [pictures[number % len(pictures)] for number in range(60)]
    packets = encoded(pictures, codec, key_every=50)
    decoder = VideoDecoder(codec, "port")
    shown = []
    for number, packet in enumerate(packets):
        if not 5 <= number < 5 + lost:
            with suppress(ImageError):
                decoder.decode(packet)
                shown.append(number)
    assert shown == [*range(5), *range(50, 60)]


def test_a_damaged_part_of_a_picture_is_not_painted_over():
    packet = encoded(TALL, "h264")[1]
    decoder = VideoDecoder("h264", "port")
    decoder.decode(encoded(TALL, "h264")[0])
    with pytest.raises(ImageError, match="damaged"):
        decoder.decode(packet[: packet.rindex(b"\0\0\1")])  # without its last slice


def test_key_frames_are_known_by_their_units(packets: list[bytes], codec: str):
    keys = [number for number, packet in enumerate(packets) if is_key_frame(codec, packet)]
    assert keys == [0, KEY_EVERY, 2 * KEY_EVERY]


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("h264", "h264"), ("libx264", "h264"), ("h264_nvenc;nv12", "h264"), ("H264/yuv420p", "h264"), ("h265", "hevc"),
        ("hevc_vaapi", "hevc"), ("libx265;yuv420p;bgr8", "hevc"), ("vp9", None), ("mjpeg", None), ("", None),
    ],
)  # fmt: skip
def test_codecs_are_known_by_all_names_that_messages_give(name: str, codec: str | None):
    assert codec_of(name) == codec
