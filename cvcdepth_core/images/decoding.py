# SPDX-License-Identifier: Apache-2.0
"""From the bytes of an image message to an RGB picture: uint8 [height, width, 3]."""

from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError
from cvcdepth_core.images.headers import JPEG_START, PNG_START, ImageHeader, read_header
from cvcdepth_core.images.pixel_formats import FORMATS, PixelFormat, pixel_format, to_eight_bits, to_rgb, used_bits
from cvcdepth_core.rig.calibration import MAX_PIXELS

Picture = NDArray[np.uint8]

_JPEG_SCAN, _JPEG_END = b"\xff\xda", b"\xff\xd9"
# Writers cut a picture into pieces of 8 KiB or more.
_MAX_PNG_CHUNKS = 20_000

# Progressive JPEG has about ten, and each costs as much time as a whole picture.
_MAX_SCANS = 64

_ALL_BITS = 16
Reduction = Literal[1, 2, 4, 8]
_REDUCED_COLOUR = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}

# Mean difference of neighbours in a byte plane (0 to 85, the latter for noise) above which it is no picture's, and how
# much smoother the other plane must be for the two to have been mixed up.
_NOISE, _SMOOTHER = 40.0, 4.0
_ROWS_TO_COMPARE = 16


def decode_raw(
    width: int,
    height: int,
    encoding: str,
    step: int,
    is_bigendian: bool,
    pixels: Any,
    camera: str,
    max_pixels: int = MAX_PIXELS,
) -> Picture:
    """Turn the fields of a `sensor_msgs/Image` into an RGB picture.

    `pixels` is anything with the buffer protocol. 16-bit images keep the upper eight bits of those in use, see
    `used_bits`. ImageError names the camera and the field: an unknown encoding, an impossible size or step, more than
    `max_pixels`, fewer bytes than `step` x `height`, 16-bit values whose bytes are in the other order than
    `is_bigendian` says.
    """
    layout = pixel_format(encoding)
    if layout is None:
        raise ImageError(f"camera {camera}: encoding '{encoding:.40}' is not supported; there are {', '.join(FORMATS)}")
    buffer = np.frombuffer(pixels, dtype=np.uint8)
    row_bytes = width * layout.channels * (2 if layout.is_deep else 1)
    is_odd = layout.shares_colour and (width % 2 or (layout.has_colour_plane and height % 2))
    if width <= 0 or height <= 0 or step < row_bytes or is_odd:
        raise ImageError(f"camera {camera}: size {width}x{height} {encoding} with a step of {step} bytes is impossible")
    rows = height
    if layout.has_colour_plane:
        rows = height * 3 // 2
        # Some drivers take the bytes of both planes for those of the rows of one.
        step = width if step * 2 == width * 3 and buffer.size < step * rows else step
    if buffer.size < step * rows:
        raise ImageError(f"camera {camera}: {buffer.size} bytes, but step {step} x height {rows} = {step * rows}")
    _check_pixels(width, height, max_pixels, camera)
    content = buffer[: step * rows].reshape(rows, step)[:, :row_bytes]
    if layout.is_deep:
        _check_byte_order(content, layout.channels, is_bigendian, camera)
    return _rows_to_rgb(content, layout, is_bigendian)


def decode_compressed(
    image_format: str,
    content: Any,
    camera: str,
    *,
    reduce: Reduction = 1,
    size: tuple[int, int] | None = None,
    max_pixels: int = MAX_PIXELS,
) -> Picture:
    """Decode a `sensor_msgs/CompressedImage` (JPEG or PNG) to an RGB picture.

    What the bytes are decides, not `image_format`, whose text differs from driver to driver; only a Bayer pattern is
    taken from it, since image_transport compresses mosaics as grey pictures ("bayer_rggb8; png compressed").

    With `reduce` r the picture has ceil(height / r) rows and ceil(width / r) columns, each the mean of r x r pixels: a
    JPEG is low-passed in its own frequencies, before they become pixels, which halves the time.
    Pixel (u, v) becomes ((u + 0.5) / r - 0.5, (v + 0.5) / r - 0.5).

    ImageError names the camera, before anything is decoded, for another format, for a header that declares another
    `size` (width, height) or more than `max_pixels` or endless scans, and for a file that was cut, which decoders may
    fill with grey.
    """
    encoded = bytes(content)
    header = read_header(encoded)
    if header is None:
        raise ImageError(f"camera {camera}: {_no_header(encoded, image_format)}")
    _check_header(header, size, max_pixels, camera)
    if not (_jpeg_is_complete(encoded) if header.format == "JPEG" else _png_is_complete(encoded)):
        raise ImageError(f"camera {camera}: compressed image of {len(encoded)} bytes has no end: it was cut")
    picture = _imdecode(encoded, _compressed_encoding(image_format), reduce, header)
    if picture is None:
        raise ImageError(f"camera {camera}: compressed image of {len(encoded)} bytes is damaged")
    return picture


def _no_header(encoded: bytes, image_format: str) -> str:
    if encoded.startswith((JPEG_START, PNG_START)):
        return f"compressed image of {len(encoded)} bytes is damaged: its header says no size"
    return (
        f"compressed image with format '{image_format:.40}' begins with {encoded[:8].hex(' ') or 'nothing'}: "
        "neither JPEG nor PNG"
    )


def _check_header(header: ImageHeader, size: tuple[int, int] | None, max_pixels: int, camera: str) -> None:
    found = (header.width, header.height)
    if 0 in found:
        raise ImageError(f"camera {camera}: {header.format} header declares {found[0]}x{found[1]} pixels")
    if size is not None and found != size:
        raise ImageError(
            f"camera {camera}: image of {found[0]}x{found[1]}, but its camera_info says {size[0]}x{size[1]}"
        )
    _check_pixels(*found, max_pixels, camera)
    if header.scans > _MAX_SCANS:
        raise ImageError(f"camera {camera}: JPEG has {header.scans} scans; at most {_MAX_SCANS} are decoded")


def _check_pixels(width: int, height: int, max_pixels: int, camera: str) -> None:
    if width * height > max_pixels:
        raise ImageError(
            f"camera {camera}: image of {width}x{height} = {width * height} pixels; at most {max_pixels} are decoded"
        )


def _check_byte_order(rows: NDArray[np.uint8], channels: int, is_bigendian: bool, camera: str) -> None:
    """Refuse 16-bit rows whose upper bytes would be noise while the lower ones are a picture."""
    sampled = rows[:: max(1, len(rows) // _ROWS_TO_COMPARE)]
    # In a mosaic every second pixel has the same colour.
    apart = 2 if channels == 1 else channels
    upper, lower = (_roughness(_upper_bytes(sampled, order)[:, ::apart]) for order in (is_bigendian, not is_bigendian))
    if upper > _NOISE and upper > _SMOOTHER * lower > 0.0:
        raise ImageError(f"camera {camera}: is_bigendian = {int(is_bigendian)}, but the bytes are in the other order")


def _roughness(plane: NDArray[np.uint8]) -> float:
    """Mean difference of neighbours; 0 where there are none."""
    difference = np.abs(np.diff(plane.astype(np.int16), axis=1))
    return float(difference.mean()) if difference.size else 0.0


def _jpeg_is_complete(encoded: bytes) -> bool:
    """Whether the last scan ends. Drivers pad files with zeros, and a thumbnail has an end of its own before it."""
    end = encoded.rfind(_JPEG_END)
    return end >= 0 and encoded.find(_JPEG_SCAN, end) < 0


def _png_is_complete(encoded: bytes) -> bool:
    """Whether all chunks up to the end lie within the bytes; a decoder takes the memory that each declares."""
    position = len(PNG_START)
    for _ in range(_MAX_PNG_CHUNKS):
        kind = encoded[position + 4 : position + 8]
        position += 12 + int.from_bytes(encoded[position : position + 4], "big")
        if position > len(encoded) or kind == b"IEND":
            return position <= len(encoded)
    return False


def _compressed_encoding(image_format: str) -> str:
    """Say what the decoder will give: a mosaic for image_transport's "bayer_X; jpeg compressed", else bgr8."""
    original, _, coding = image_format.partition(";")
    mosaic = original.strip().replace("16", "8")
    is_mosaic = mosaic.startswith("bayer_") and mosaic in FORMATS and coding.strip().endswith("compressed")
    return mosaic if is_mosaic else "bgr8"


def _imdecode(encoded: bytes, encoding: str, reduce: Reduction, header: ImageHeader) -> Picture | None:
    """Decode to RGB; what the decoder gives is BGR, or a mosaic where `encoding` is a Bayer pattern."""
    # Other formats than JPEG know no reduced decoding, and a mosaic must get its colours before it is averaged.
    decoder_reduces = header.format == "JPEG" and encoding == "bgr8"
    colour = _REDUCED_COLOUR[reduce] if decoder_reduces else cv2.IMREAD_COLOR
    # The sensor's rows stay rows: an orientation tag would contradict the calibration.
    flags = (colour if encoding == "bgr8" else cv2.IMREAD_GRAYSCALE) | cv2.IMREAD_IGNORE_ORIENTATION
    flags |= cv2.IMREAD_ANYDEPTH if header.format == "PNG" else 0
    try:
        decoded = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    except cv2.error:
        return None
    factor = reduce if decoder_reduces else 1
    if decoded is None or decoded.shape[:2] != (-(-header.height // factor), -(-header.width // factor)):
        return None
    eight = to_eight_bits(decoded) if decoded.dtype == np.uint16 else decoded
    picture = to_rgb(eight, FORMATS[encoding].to_rgb)
    return picture if decoder_reduces else reduce_picture(picture, reduce)


def reduce_picture(picture: Picture, reduce: int) -> Picture:
    """Replace each `reduce` x `reduce` pixels by their mean; the last row and column are continued where they end."""
    if reduce == 1:
        return picture
    height, width = picture.shape[:2]
    missing = -height % reduce, -width % reduce
    whole = cv2.copyMakeBorder(picture, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE) if any(missing) else picture
    rows, columns = (height + missing[0]) // reduce, (width + missing[1]) // reduce
    reduced: Picture = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    return reduced


def _rows_to_rgb(rows: NDArray[np.uint8], layout: PixelFormat, is_bigendian: bool) -> Picture:
    if layout.is_deep:
        deep = np.ascontiguousarray(rows).view(">u2" if is_bigendian else "<u2")
        rows = _upper_bytes(rows, is_bigendian) if used_bits(deep) == _ALL_BITS else to_eight_bits(deep)
    image = rows.reshape(rows.shape[0], -1, layout.channels) if layout.channels > 1 else rows
    return to_rgb(image, layout.to_rgb)


def _upper_bytes(rows: NDArray[np.uint8], is_bigendian: bool) -> NDArray[np.uint8]:
    return rows[:, 0::2] if is_bigendian else rows[:, 1::2]
