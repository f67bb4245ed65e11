# SPDX-License-Identifier: Apache-2.0
"""Every encoding becomes the same RGB picture; every broken image is refused with the camera's name."""

import array
import resource
import struct
import zlib
from contextlib import suppress

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError
from cvcdepth_core.images.decoding import Reduction, decode_compressed, decode_raw

WIDTH, HEIGHT = 46, 30
PATTERNS = ("rggb", "bggr", "gbrg", "grbg")
SENSOR_CHANNEL = {"r": 0, "g": 1, "b": 2}


@pytest.fixture(scope="module")
def rgb() -> NDArray[np.uint8]:
    """A smooth picture whose three channels differ clearly everywhere."""
    u, v = np.meshgrid(np.linspace(0, 1, WIDTH), np.linspace(0, 1, HEIGHT))
    channels = [200 + 40 * u, 110 + 30 * v, 20 + 30 * u * v]
    return np.round(np.stack(channels, axis=2)).astype(np.uint8)


@pytest.fixture(scope="module")
def grey(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(rgb[..., 1])


def _mosaic(rgb: NDArray[np.uint8], pattern: str) -> NDArray[np.uint8]:
    """What a sensor with the pattern (first row's two letters, then the second's) sees of the picture."""
    mosaic = np.empty(rgb.shape[:2], np.uint8)
    for place, letter in enumerate(pattern):
        cells = np.s_[place // 2 :: 2, place % 2 :: 2]
        mosaic[cells] = rgb[..., SENSOR_CHANNEL[letter]][cells]
    return mosaic


def _with_padding(pixels: NDArray[np.generic], padding: int) -> tuple[int, bytes]:
    """Return step and bytes of an image whose rows are followed by rubbish."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
    rubbish = np.full((rows.shape[0], padding), 0xA5, np.uint8)
    return rows.shape[1] + padding, np.hstack([rows, rubbish]).tobytes()


def _decode(
    pixels: NDArray[np.generic], encoding: str, padding: int = 0, is_bigendian: bool = False
) -> NDArray[np.uint8]:
    step, content = _with_padding(pixels, padding)
    return decode_raw(pixels.shape[1], pixels.shape[0], encoding, step, is_bigendian, content, "front")


@pytest.mark.parametrize("padding", [0, 5, 64])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "8UC3", "rgba8", "bgra8"])
def test_colour_encodings_give_the_picture_whatever_the_step(rgb: NDArray[np.uint8], encoding: str, padding: int):
    alpha = np.full((HEIGHT, WIDTH, 1), 7, np.uint8)
    # 8UC3 does not say its order; OpenCV's is taken.
    colours = rgb if encoding.startswith("rgb") else rgb[..., ::-1]
    found = _decode(np.dstack([colours, alpha]) if "a" in encoding else colours, encoding, padding)
    assert np.array_equal(found, rgb)
    assert found.flags.c_contiguous


@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_becomes_three_equal_channels(grey: NDArray[np.uint8], encoding: str, padding: int):
    assert np.array_equal(_decode(grey, encoding, padding), np.dstack([grey] * 3))


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_sixteen_bits_keep_their_upper_eight(grey: NDArray[np.uint8], encoding: str, is_bigendian: bool):
    # The lower byte is always another number, so that taking it would show.
    deep = (grey.astype(np.uint16) << 8 | 0x5A).astype(">u2" if is_bigendian else "<u2")
    assert np.array_equal(_decode(deep, encoding, 6, is_bigendian), np.dstack([grey] * 3))


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize(("bits", "is_bigendian"), [(8, False), (16, False), (16, True)])
def test_each_bayer_pattern_gives_each_channel_its_own_colour(
    rgb: NDArray[np.uint8], pattern: str, bits: int, is_bigendian: bool
):
    mosaic: NDArray[np.generic] = _mosaic(rgb, pattern)
    if bits == 16:
        mosaic = (mosaic.astype(np.uint16) << 8 | 0x5A).astype(">u2" if is_bigendian else "<u2")
    found = _decode(mosaic, f"bayer_{pattern}{bits}", 4, is_bigendian)
    assert np.abs(found[2:-2, 2:-2].astype(int) - rgb[2:-2, 2:-2]).max() <= 3


@pytest.mark.parametrize(
    "wrap", [bytes, bytearray, memoryview, lambda b: array.array("B", b), lambda b: np.frombuffer(b, np.uint8)]
)
def test_any_buffer_of_bytes_is_read(rgb: NDArray[np.uint8], wrap: type):
    found = decode_raw(WIDTH, HEIGHT, "rgb8", 3 * WIDTH, False, wrap(rgb.tobytes()), "front")
    assert np.array_equal(found, rgb)


def test_bytes_after_the_last_row_are_ignored(grey: NDArray[np.uint8]):
    found = decode_raw(WIDTH, HEIGHT, "mono8", WIDTH, False, grey.tobytes() + b"more", "front")
    assert np.array_equal(found[..., 0], grey)


@pytest.mark.parametrize(
    ("width", "height", "encoding", "step", "count", "found"),
    [
        (8, 4, "rgb8", 24, 95, "95 bytes, but step 24 x height 4 = 96"),
        (8, 4, "rgb8", 24, 0, "0 bytes, but step 24"),
        (8, 4, "rgb8", 23, 96, "8x4 rgb8 with a step of 23 bytes"),
        (8, 4, "mono16", 15, 96, "8x4 mono16 with a step of 15 bytes"),
        (8, 4, "bgra8", 0, 96, "8x4 bgra8 with a step of 0 bytes"),
        (0, 4, "rgb8", 24, 96, "size 0x4"),
        (8, 0, "rgb8", 24, 96, "size 8x0"),
        (8, 4, "yuv444", 24, 96, "encoding 'yuv444' is not supported; there are rgb8, bgr8"),
        (7, 4, "yuv422", 14, 56, "7x4 yuv422 with a step of 14 bytes is impossible"),
        (8, 4, "nv12", 8, 47, "47 bytes, but step 8 x height 6 = 48"),
        (8, 3, "nv21", 8, 48, "8x3 nv21 with a step of 8 bytes is impossible"),
        (8, 4, "bayer_rgbg8", 8, 32, "encoding 'bayer_rgbg8' is not supported"),
        (8, 4, "", 8, 32, "encoding '' is not supported"),
    ],
)
def test_an_impossible_image_is_refused_with_camera_and_values(
    width: int, height: int, encoding: str, step: int, count: int, found: str
):
    with pytest.raises(ImageError, match=f"^camera rear_left: .*{found}") as error:
        decode_raw(width, height, encoding, step, False, bytes(count), "rear_left")
    assert "\n" not in str(error.value)


def _encoded(extension: str, image: NDArray[np.generic], *options: int) -> bytes:
    encoded: bytes = cv2.imencode(extension, image, options)[1].tobytes()
    return encoded


def test_a_png_gives_the_picture_exactly(rgb: NDArray[np.uint8]):
    assert np.array_equal(
        decode_compressed("rgb8; png compressed bgr8", _encoded(".png", rgb[..., ::-1]), "front"), rgb
    )


@pytest.mark.parametrize("wrap", [bytes, lambda b: array.array("B", b), lambda b: np.frombuffer(b, np.uint8)])
def test_a_jpeg_gives_the_picture_nearly(rgb: NDArray[np.uint8], wrap: type):
    found = decode_compressed("jpeg", wrap(_encoded(".jpg", rgb[..., ::-1], cv2.IMWRITE_JPEG_QUALITY, 98)), "front")
    assert np.abs(found.astype(int) - rgb).max() <= 6


@pytest.mark.parametrize("extension", [".jpg", ".png"])
def test_compressed_grey_becomes_three_equal_channels(grey: NDArray[np.uint8], extension: str):
    found = decode_compressed("mono8; jpeg compressed", _encoded(extension, grey), "front")
    assert found.shape == (HEIGHT, WIDTH, 3)
    assert np.array_equal(found[..., 0], found[..., 2])
    assert np.abs(found[..., 0].astype(int) - grey).max() <= 4


def test_a_png_with_alpha_gives_its_colours(rgb: NDArray[np.uint8]):
    with_alpha = np.dstack([rgb[..., ::-1], np.full((HEIGHT, WIDTH), 9, np.uint8)])
    assert np.array_equal(decode_compressed("png", _encoded(".png", with_alpha), "front"), rgb)


def test_a_png_of_sixteen_bits_keeps_its_upper_eight(grey: NDArray[np.uint8]):
    found = decode_compressed("mono16; png compressed", _encoded(".png", grey.astype(np.uint16) << 8 | 0x1A), "front")
    assert np.array_equal(found[..., 0], grey)


def _png_chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def test_a_png_with_a_palette_gives_its_colours(grey: NDArray[np.uint8]):
    palette = np.random.default_rng(0).integers(0, 256, (256, 3), dtype=np.uint8)
    header = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 8, 3, 0, 0, 0)
    rows = b"".join(b"\0" + row.tobytes() for row in grey)
    chunks = [(b"IHDR", header), (b"PLTE", palette.tobytes()), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    png = b"\x89PNG\r\n\x1a\n" + b"".join(_png_chunk(*chunk) for chunk in chunks)
    assert np.array_equal(decode_compressed("png", png, "front"), palette[grey])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("bits", [8, 16])
def test_a_compressed_mosaic_is_demosaiced(rgb: NDArray[np.uint8], pattern: str, bits: int):
    mosaic: NDArray[np.generic] = _mosaic(rgb, pattern)
    if bits == 16:
        mosaic = mosaic.astype(np.uint16) << 8
    found = decode_compressed(f"bayer_{pattern}{bits}; png compressed ", _encoded(".png", mosaic), "front")
    assert np.abs(found[2:-2, 2:-2].astype(int) - rgb[2:-2, 2:-2]).max() <= 3


def test_a_picture_that_the_driver_demosaiced_before_compressing_stays_as_it_is(rgb: NDArray[np.uint8]):
    found = decode_compressed("bayer_rggb8; png compressed bgr8", _encoded(".png", rgb[..., ::-1]), "front")
    assert np.array_equal(found, rgb)


def _with_exif(jpeg: bytes, orientation: int, thumbnail: bytes = b"") -> bytes:
    """Insert an EXIF segment that says `orientation`, followed by a thumbnail."""
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    tiff = b"II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0) + thumbnail
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def test_an_orientation_tag_does_not_turn_the_picture(rgb: NDArray[np.uint8]):
    jpeg = _encoded(".jpg", rgb[..., ::-1])
    turned = _with_exif(jpeg, orientation=6)
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape[:2] == (WIDTH, HEIGHT)
    assert np.array_equal(decode_compressed("jpeg", turned, "front"), decode_compressed("jpeg", jpeg, "front"))


def test_a_jpeg_that_the_driver_padded_is_complete(rgb: NDArray[np.uint8]):
    jpeg = _encoded(".jpg", rgb[..., ::-1])
    assert np.array_equal(decode_compressed("jpeg", jpeg + bytes(4096), "c"), decode_compressed("jpeg", jpeg, "c"))


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9, 0.999])
@pytest.mark.parametrize("extension", [".jpg", ".png"])
def test_a_cut_file_is_refused(extension: str, kept: float):
    noise = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    encoded = _encoded(extension, noise)
    cut = encoded[: int(kept * len(encoded))]
    with pytest.raises(ImageError, match=f"camera rear: compressed image of {len(cut)} bytes has no end: it was cut"):
        decode_compressed("jpeg", cut, "rear")


def test_a_cut_jpeg_is_refused_though_its_thumbnail_is_complete(rgb: NDArray[np.uint8]):
    jpeg = _with_exif(_encoded(".jpg", rgb[..., ::-1]), 1, thumbnail=_encoded(".jpg", rgb[::2, ::2, ::-1]))
    assert decode_compressed("jpeg", jpeg, "rear").shape == (HEIGHT, WIDTH, 3)
    with pytest.raises(ImageError, match="it was cut"):
        decode_compressed("jpeg", jpeg[:-40], "rear")


def test_a_png_whose_bytes_changed_is_refused(rgb: NDArray[np.uint8]):
    png = bytearray(_encoded(".png", rgb))
    png[len(png) // 2] ^= 0x40
    with pytest.raises(ImageError, match=f"camera rear: compressed image of {len(png)} bytes is damaged"):
        decode_compressed("png", bytes(png), "rear")


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "begins with nothing: neither JPEG nor PNG"),
        (b"RIFF\x10\0\0\0WEBPVP8 ", "format 'webp' begins with 52 49 46 46 10 00 00 00: neither JPEG nor PNG"),
        (b"\xff\xd8 rubbish \xff\xd9", "of 13 bytes is damaged"),
        (b"\x89PNG\r\n\x1a\n rubbish IEND\xaeB`\x82", "of 25 bytes is damaged"),
    ],
)
def test_what_is_no_picture_is_refused_by_name(content: bytes, found: str):
    with pytest.raises(ImageError, match=f"^camera rear: compressed image .*{found}") as error:
        decode_compressed("webp", content, "rear")
    assert "\n" not in str(error.value)


def _jpeg_declaring(jpeg: bytes, width: int, height: int) -> bytes:
    """Write another size into the frame header of a baseline JPEG."""
    frame = jpeg.index(b"\xff\xc0")
    return jpeg[: frame + 5] + struct.pack(">HH", height, width) + jpeg[frame + 9 :]


def _png_declaring(png: bytes, width: int, height: int) -> bytes:
    header = _png_chunk(b"IHDR", struct.pack(">II", width, height) + png[24:29])
    return png[:8] + header + png[8 + len(header) :]


@pytest.mark.parametrize(
    ("extension", "declare"), [(".jpg", _jpeg_declaring), (".png", _png_declaring)], ids=["JPEG", "PNG"]
)
class TestDeclaredSizes:
    """Headers are refused before anything is decoded."""

    def test_a_small_file_that_declares_a_giant_picture_is_refused(self, extension, declare, rgb):
        bomb = declare(_encoded(extension, rgb), 65000, 65000)
        with pytest.raises(ImageError, match="camera rear: image of 65000x65000 = 4225000000 pixels; at most 50000000"):
            decode_compressed("jpeg", bomb, "rear")

    def test_the_bound_is_the_callers(self, extension, declare, rgb):
        encoded = _encoded(extension, rgb)
        assert decode_compressed("jpeg", encoded, "rear", max_pixels=WIDTH * HEIGHT).shape == (HEIGHT, WIDTH, 3)
        with pytest.raises(ImageError, match=f"1380 pixels; at most {WIDTH * HEIGHT - 1} are"):
            decode_compressed("jpeg", encoded, "rear", max_pixels=WIDTH * HEIGHT - 1)

    def test_another_size_than_the_calibrations_is_refused(self, extension, declare, rgb):
        encoded = _encoded(extension, rgb)
        assert decode_compressed("jpeg", encoded, "rear", size=(WIDTH, HEIGHT)).shape == (HEIGHT, WIDTH, 3)
        with pytest.raises(ImageError, match="camera rear: image of 46x30, but its camera_info says 30x46"):
            decode_compressed("jpeg", encoded, "rear", size=(30, 46))

    @pytest.mark.parametrize(("width", "height"), [(0, 30), (46, 0), (0, 0)])
    def test_a_picture_without_pixels_is_refused(self, extension, declare, rgb, width: int, height: int):
        with pytest.raises(ImageError, match=f"camera rear: (JPEG|PNG) header declares {width}x{height} pixels"):
            decode_compressed("jpeg", declare(_encoded(extension, rgb), width, height), "rear")

    def test_a_header_that_contradicts_the_pixels_is_refused_or_gives_what_it_declares(self, extension, declare, rgb):
        lying = declare(_encoded(extension, rgb), 300, 200)
        with suppress(ImageError):
            assert decode_compressed("jpeg", lying, "rear").shape == (200, 300, 3)


@pytest.mark.parametrize(
    "hiding",
    [
        b"\xff" * 100_000,
        b"\xff" * 50_000 + b"\0" + b"rubbish" * 1000,
        b"\xff\xd0\xff\x01" * 20,
        b"\xff\xe1\0\x20" + b"\xff\xc0\0\x11\x08\0\1\0\1" + bytes(21),
        b"\xff\xfe\0\2" * 500,
    ],
    ids=["fill bytes", "rubbish", "standalone markers", "frame within a comment", "many segments"],
)
def test_a_giant_frame_is_found_whatever_stands_before_it(rgb: NDArray[np.uint8], hiding: bytes):
    bomb = _jpeg_declaring(_encoded(".jpg", rgb), 65000, 65000)
    with pytest.raises(ImageError, match="65000x65000"):
        decode_compressed("jpeg", bomb[:2] + hiding + bomb[2:], "rear")


@pytest.mark.parametrize(
    "rubbish", [b"\xff\xe1\0\0", b"\xff\xe1\xff", b"\xff\xfe\0\2" * 2000, b"\xff\xd9", b"\xff\xda"]
)
def test_a_jpeg_whose_header_leads_nowhere_is_refused(rgb: NDArray[np.uint8], rubbish: bytes):
    jpeg = _encoded(".jpg", rgb)
    with pytest.raises(ImageError, match=r"camera rear: compressed image of \d+ bytes is damaged: its header"):
        decode_compressed("jpeg", jpeg[:2] + rubbish + jpeg[2:], "rear")


@pytest.mark.parametrize("kept", range(2, 26))
def test_a_file_cut_within_its_header_is_refused(rgb: NDArray[np.uint8], kept: int):
    for extension in (".jpg", ".png"):
        with pytest.raises(ImageError, match=r"^camera rear: compressed image"):
            decode_compressed("jpeg", _encoded(extension, rgb)[:kept], "rear")


def test_a_jpeg_with_endless_scans_is_refused_and_a_progressive_one_is_not(rgb: NDArray[np.uint8]):
    progressive = _encoded(".jpg", rgb[..., ::-1], cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    assert np.abs(decode_compressed("jpeg", progressive, "rear").astype(int) - rgb).max() <= 12
    scan = progressive.rindex(b"\xff\xda")
    with pytest.raises(ImageError, match=r"camera rear: JPEG has \d+ scans; at most 64"):
        decode_compressed("jpeg", progressive[:-2] + progressive[scan:-2] * 100 + progressive[-2:], "rear")


@pytest.fixture(scope="module")
def scene() -> NDArray[np.uint8]:
    """A picture with detail at every scale, of a size that no reduction divides."""
    noise = np.random.default_rng(3).normal(size=(253, 317, 1))
    layers = sum(2**i * cv2.GaussianBlur(noise, (0, 0), 2.0**i)[..., None] for i in range(5))
    picture: NDArray[np.uint8] = np.clip((150, 120, 100) + 20 * layers, 0, 255).astype(np.uint8)
    return picture


def _means(picture: NDArray[np.uint8], reduce: int) -> NDArray[np.float64]:
    height, width = picture.shape[0] // reduce, picture.shape[1] // reduce
    cells = picture[: height * reduce, : width * reduce].reshape(height, reduce, width, reduce, 3)
    means: NDArray[np.float64] = cells.mean(axis=(1, 3))
    return means


@pytest.mark.parametrize("reduce", [2, 4, 8])
@pytest.mark.parametrize(("extension", "share"), [(".jpg", 0.2), (".png", 0.1)])
def test_a_reduced_picture_holds_the_means_of_its_pixels(scene, extension: str, share: float, reduce: Reduction):
    encoded = _encoded(extension, scene)
    full, reduced = decode_compressed("", encoded, "c"), decode_compressed("", encoded, "c", reduce=reduce)
    assert reduced.shape == (-(-253 // reduce), -(-317 // reduce), 3)
    means = _means(full, reduce)
    inside = np.s_[: means.shape[0], : means.shape[1]]
    decimated = full[reduce // 2 :: reduce, reduce // 2 :: reduce][inside]
    assert np.abs(reduced[inside] - means).mean() < share * np.abs(decimated - means).mean()


def test_reduced_decoding_does_not_alias(scene):
    stripes = np.zeros((240, 320, 3), np.uint8)
    stripes[:, ::2] = 255
    for extension in (".jpg", ".png"):
        reduced = decode_compressed("", _encoded(extension, stripes), "c", reduce=2)
        assert np.abs(reduced.astype(int) - 127).max() <= 2


def test_reduced_decoding_is_deterministic(scene):
    jpeg = _encoded(".jpg", scene)
    pictures = [decode_compressed("", jpeg, "c", reduce=4) for _ in range(5)]
    assert all(np.array_equal(picture, pictures[0]) for picture in pictures)


def test_the_size_that_is_expected_is_the_full_one_whatever_the_reduction(scene):
    jpeg = _encoded(".jpg", scene)
    assert decode_compressed("", jpeg, "c", reduce=8, size=(317, 253)).shape == (32, 40, 3)
    with pytest.raises(ImageError, match="camera c: image of 317x253, but its camera_info says 318x253"):
        decode_compressed("", jpeg, "c", reduce=8, size=(318, 253))


@pytest.mark.parametrize("extension", [".jpg", ".png"])
def test_a_compressed_mosaic_gets_its_colours_before_it_is_reduced(rgb: NDArray[np.uint8], extension: str):
    mosaic = _encoded(
        extension, _mosaic(rgb, "rggb"), *((cv2.IMWRITE_JPEG_QUALITY, 100) if extension == ".jpg" else ())
    )
    found = decode_compressed("bayer_rggb8; jpeg compressed ", mosaic, "front", reduce=2)
    assert np.abs(found[1:-1, 1:-1] - _means(rgb, 2)[1:-1, 1:-1]).max() <= 6


@pytest.mark.parametrize("bits", [12, 16])
@pytest.mark.parametrize("is_bigendian", [False, True])
def test_sixteen_bits_in_the_other_byte_order_are_refused(is_bigendian: bool, bits: int):
    noise = np.random.default_rng(5).normal(0, 3 << (bits - 8), (HEIGHT, WIDTH))
    smooth = np.linspace(0.1, 0.9, WIDTH)[None] * 2**bits + noise
    deep = np.clip(smooth, 0, 2**bits - 1).astype(">u2" if is_bigendian else "<u2")
    assert _decode(deep, "mono16", is_bigendian=is_bigendian).shape == (HEIGHT, WIDTH, 3)
    with pytest.raises(ImageError, match=f"camera front: is_bigendian = {int(not is_bigendian)}, but the bytes are"):
        _decode(deep, "mono16", is_bigendian=not is_bigendian)


def test_a_raw_image_beyond_the_bound_is_refused():
    with pytest.raises(ImageError, match="camera c: image of 8x4 = 32 pixels; at most 31 are decoded"):
        decode_raw(8, 4, "mono8", 8, False, bytes(32), "c", max_pixels=31)


@pytest.mark.parametrize(
    ("width", "height", "step"), [(2**32 - 1, 1, 2**32 - 1), (1, 2**32 - 1, 1), (2**31, 2**31, 2**31)]
)
def test_an_enormous_raw_image_is_refused_before_memory_is_taken(width: int, height: int, step: int):
    with pytest.raises(ImageError, match=r"^camera c: "):
        decode_raw(width, height, "mono8", step, False, bytes(64), "c")


def test_a_long_encoding_does_not_fill_the_log():
    with pytest.raises(ImageError) as error:
        decode_raw(8, 4, "x" * 10**6, 8, False, bytes(32), "c")
    assert len(str(error.value)) < 400


def test_a_png_chunk_that_declares_more_than_there_is_is_refused_before_memory_is_taken(rgb: NDArray[np.uint8]):
    png = _encoded(".png", rgb)
    pixels = png.index(b"IDAT") - 4
    bomb = png[:pixels] + b"\x7f\xff\xff\xff" + png[pixels + 4 :]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ImageError, match=r"camera rear: compressed image of .* it was cut"):
        decode_compressed("png", bomb, "rear")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_a_png_that_is_padded_is_complete(rgb: NDArray[np.uint8]):
    assert np.array_equal(decode_compressed("png", _encoded(".png", rgb[..., ::-1]) + bytes(99), "c"), rgb)
