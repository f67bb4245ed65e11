# SPDX-License-Identifier: Apache-2.0
"""Encodings of raw images: what USB cameras and machine vision cameras send becomes the same RGB picture."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError
from cvcdepth_core.images.decoding import decode_compressed, decode_raw
from cvcdepth_core.images.pixel_formats import FORMATS, used_bits

HEIGHT, WIDTH = 24, 40


@pytest.fixture(scope="module")
def rgb() -> NDArray[np.uint8]:
    """Colours that change slowly, so that pixels may share them."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    channels = [128 + 90 * np.sin(columns / 11 + k) * np.cos(rows / 13 - k) for k in range(3)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def yuv_planes(rgb: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
    """Y, U and V [H, W] by ITU-R BT.601 in the range of video (16 to 235)."""
    r, g, b = (rgb[..., channel] / 255 for channel in range(3))
    y = 16 + 65.481 * r + 128.553 * g + 24.966 * b
    u = 128 - 37.797 * r - 74.203 * g + 112.0 * b
    v = 128 + 112.0 * r - 93.786 * g - 18.214 * b
    return tuple(np.rint(plane).astype(np.uint8) for plane in (y, u, v))  # type: ignore[return-value]


def packed(rgb: NDArray[np.uint8], order: str) -> NDArray[np.uint8]:
    """4 bytes for two pixels in this order: "yuyv" or "uyvy"."""
    y, u, v = yuv_planes(rgb)
    parts = {"u": u[:, ::2], "v": v[:, ::2]}
    lumas = iter((y[:, ::2], y[:, 1::2]))
    quads = np.stack([next(lumas) if name == "y" else parts[name] for name in order], axis=-1)
    return quads.reshape(HEIGHT, 2 * WIDTH)


def semi_planar(rgb: NDArray[np.uint8], order: str) -> NDArray[np.uint8]:
    """A plane of Y, and below it one of half the height with both colours: "uv" or "vu"."""
    y, u, v = yuv_planes(rgb)
    quarters = {"u": u[::2, ::2], "v": v[::2, ::2]}
    colours = np.stack([quarters[name] for name in order], axis=-1).reshape(HEIGHT // 2, WIDTH)
    return np.vstack([y, colours])


def padded(rows: NDArray[np.uint8], padding: int) -> tuple[int, bytes]:
    """Rows with so many bytes behind each; the step and the bytes."""
    wide = np.hstack([rows, np.full((len(rows), padding), 0xA5, np.uint8)])
    return wide.shape[1], wide.tobytes()


YUV = {
    "yuv422": lambda rgb: packed(rgb, "uyvy"),
    "uyvy": lambda rgb: packed(rgb, "uyvy"),
    "yuv422_yuy2": lambda rgb: packed(rgb, "yuyv"),
    "yuyv": lambda rgb: packed(rgb, "yuyv"),
    "YUYV": lambda rgb: packed(rgb, "yuyv"),
    "nv12": lambda rgb: semi_planar(rgb, "uv"),
    "NV12": lambda rgb: semi_planar(rgb, "uv"),
    "nv21": lambda rgb: semi_planar(rgb, "vu"),
}


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", YUV)
def test_video_encodings_give_the_picture_whatever_the_step(rgb: NDArray[np.uint8], encoding: str, padding: int):
    step, content = padded(YUV[encoding](rgb), padding)
    found = decode_raw(WIDTH, HEIGHT, encoding, step, False, content, "front")
    assert found.shape == rgb.shape
    assert np.abs(found.astype(int) - rgb).mean() < 3
    assert np.abs(found.astype(int) - rgb).max() < 16


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_a_step_that_counts_both_planes_as_one_is_understood(rgb: NDArray[np.uint8], encoding: str):
    content = YUV[encoding](rgb).tobytes()
    usual = decode_raw(WIDTH, HEIGHT, encoding, WIDTH, False, content, "front")
    assert np.array_equal(decode_raw(WIDTH, HEIGHT, encoding, WIDTH * 3 // 2, False, content, "front"), usual)


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("encoding", ["rgb16", "bgr16", "16UC3", "rgba16", "bgra16"])
def test_sixteen_bits_of_colour_keep_their_upper_eight(rgb: NDArray[np.uint8], encoding: str, is_bigendian: bool):
    colours = rgb if encoding.startswith("rgb") else rgb[..., ::-1]
    channels = np.dstack([colours, np.full((HEIGHT, WIDTH), 9, np.uint8)]) if "a" in encoding else colours
    deep = (channels.astype(np.uint16) << 8 | 0x5A).astype(">u2" if is_bigendian else "<u2")
    step, content = padded(deep.view(np.uint8).reshape(HEIGHT, -1), 4)
    assert np.array_equal(decode_raw(WIDTH, HEIGHT, encoding, step, is_bigendian, content, "front"), rgb)


def test_four_channels_without_a_name_are_those_of_opencv(rgb: NDArray[np.uint8]):
    four = np.dstack([rgb[..., ::-1], np.full((HEIGHT, WIDTH), 9, np.uint8)])
    assert np.array_equal(decode_raw(WIDTH, HEIGHT, "8UC4", 4 * WIDTH, False, four.tobytes(), "front"), rgb)


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1", "rgb16", "bayer_rggb16"])
def test_ten_and_twelve_bits_in_the_lower_ones_are_scaled(
    rgb: NDArray[np.uint8], encoding: str, bits: int, is_bigendian: bool
):
    eight = rgb if encoding == "rgb16" else rgb[..., 1].copy()
    deep = (eight.astype(np.uint16) << (bits - 8) | 1).astype(">u2" if is_bigendian else "<u2")
    step = deep.strides[0]
    found = decode_raw(WIDTH, HEIGHT, encoding, step, is_bigendian, deep.tobytes(), "front")
    same = decode_raw(
        WIDTH, HEIGHT, encoding.replace("16UC", "8UC").replace("16", "8"), step // 2, False, eight, "front"
    )
    assert np.array_equal(found, same)


@pytest.mark.parametrize(("largest", "bits"), [(0, 10), (1023, 10), (1024, 12), (4095, 12), (4096, 16), (65535, 16)])
def test_bits_are_in_use_as_far_as_the_brightest_pixel_needs_them(largest: int, bits: int):
    deep = np.zeros((3, 4), np.uint16)
    deep[1, 2] = largest
    assert used_bits(deep) == bits


@pytest.mark.parametrize("bits", [10, 12, 16])
@pytest.mark.parametrize("image_format", ["mono16; png compressed", "bayer_grbg16; png compressed bayer_grbg8", "png"])
def test_a_png_of_sixteen_bits_is_read_as_the_raw_image_would_be(rgb: NDArray[np.uint8], image_format: str, bits: int):
    eight = rgb[..., 0]
    png = cv2.imencode(".png", eight.astype(np.uint16) << (bits - 8))[1].tobytes()
    same = cv2.imencode(".png", eight)[1].tobytes()
    found = decode_compressed(image_format, png, "front")
    assert np.array_equal(found, decode_compressed(image_format, same, "front"))


@pytest.mark.parametrize("encoding", FORMATS)
def test_every_encoding_refuses_too_few_bytes_by_name(encoding: str):
    step = WIDTH * 8
    with pytest.raises(ImageError, match=rf"^camera front: {step * HEIGHT - 1} bytes, but step {step} x height"):
        decode_raw(WIDTH, HEIGHT, encoding, step, False, bytes(step * HEIGHT - 1), "front")
