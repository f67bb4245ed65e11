# SPDX-License-Identifier: Apache-2.0
"""From the bytes of an image message to an RGB picture: uint8 [height, width, 3]."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError

Picture = NDArray[np.uint8]

_CHANNELS = {
    "rgb8": 3,
    "bgr8": 3,
    "8UC3": 3,
    "rgba8": 4,
    "bgra8": 4,
    "mono8": 1,
    "8UC1": 1,
    "mono16": 1,
    "16UC1": 1,
} | {f"bayer_{pattern}{bits}": 1 for pattern in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)}
# 8UC3 says nothing of its colours; drivers that leave the encoding generic nearly all send OpenCV's order.
_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "8UC3": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "8UC1": cv2.COLOR_GRAY2RGB,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}
_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"


def decode_raw(
    width: int, height: int, encoding: str, step: int, is_bigendian: bool, pixels: Any, camera: str
) -> Picture:
    """Turn the fields of a `sensor_msgs/Image` into an RGB picture.

    `pixels` is anything with the buffer protocol. 16-bit images keep their upper eight bits. ImageError names the
    camera and the field: an unknown encoding, an impossible size or step, fewer bytes than `step` x `height`.
    """
    if encoding not in _CHANNELS:
        raise ImageError(f"camera {camera}: encoding '{encoding}' is not supported; there are {', '.join(_CHANNELS)}")
    row_bytes = width * _CHANNELS[encoding] * (2 if "16" in encoding else 1)
    buffer = np.frombuffer(pixels, dtype=np.uint8)
    if width <= 0 or height <= 0 or step < row_bytes:
        raise ImageError(f"camera {camera}: size {width}x{height} {encoding} with a step of {step} bytes is impossible")
    if buffer.size < step * height:
        raise ImageError(f"camera {camera}: {buffer.size} bytes, but step {step} x height {height} = {step * height}")
    rows = buffer[: step * height].reshape(height, step)[:, :row_bytes]
    return _rows_to_rgb(rows, encoding, is_bigendian)


def decode_compressed(image_format: str, content: Any, camera: str) -> Picture:
    """Decode a `sensor_msgs/CompressedImage` (JPEG or PNG) to an RGB picture.

    What the bytes are decides, not `image_format`, whose text differs from driver to driver; only a Bayer pattern is
    taken from it, since image_transport compresses mosaics as grey pictures ("bayer_rggb8; png compressed").
    ImageError names the camera for another format and for a file that was cut, which decoders may fill with grey.
    """
    encoded = bytes(content)
    if encoded.startswith(_JPEG_START):
        complete = _jpeg_is_complete(encoded)
    elif encoded.startswith(_PNG_START):
        complete = encoded.rfind(_PNG_END) > 0
    else:
        raise ImageError(
            f"camera {camera}: compressed image with format '{image_format}' begins with "
            f"{encoded[:8].hex(' ') or 'nothing'}: neither JPEG nor PNG"
        )
    if not complete:
        raise ImageError(f"camera {camera}: compressed image of {len(encoded)} bytes has no end: it was cut")
    picture = _imdecode(encoded, _compressed_encoding(image_format))
    if picture is None:
        raise ImageError(f"camera {camera}: compressed image of {len(encoded)} bytes is damaged")
    return picture


def _jpeg_is_complete(encoded: bytes) -> bool:
    """Whether the last scan ends. Drivers pad files with zeros, and a thumbnail has an end of its own before it."""
    end = encoded.rfind(_JPEG_END)
    return end >= 0 and encoded.find(_JPEG_SCAN, end) < 0


def _compressed_encoding(image_format: str) -> str:
    """Say what the decoder will give: a mosaic for image_transport's "bayer_X; jpeg compressed", else bgr8."""
    original, _, coding = image_format.partition(";")
    mosaic = original.strip().replace("16", "8")
    is_mosaic = mosaic.startswith("bayer_") and mosaic in _TO_RGB and coding.strip().endswith("compressed")
    return mosaic if is_mosaic else "bgr8"


def _imdecode(encoded: bytes, encoding: str) -> Picture | None:
    """Decode to RGB; what the decoder gives is BGR, or a mosaic where `encoding` is a Bayer pattern."""
    # The sensor's rows stay rows: an orientation tag would contradict the calibration.
    flags = (cv2.IMREAD_COLOR if encoding == "bgr8" else cv2.IMREAD_GRAYSCALE) | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        decoded = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    except cv2.error:
        return None
    return None if decoded is None else _to_rgb(decoded, encoding)


def _rows_to_rgb(rows: NDArray[np.uint8], encoding: str, is_bigendian: bool) -> Picture:
    if "16" in encoding:
        rows, encoding = _upper_bytes(rows, is_bigendian), encoding.replace("16UC1", "mono8").replace("16", "8")
    channels = _CHANNELS[encoding]
    image = rows.reshape(rows.shape[0], -1, channels) if channels > 1 else rows
    return np.ascontiguousarray(image) if encoding == "rgb8" else _to_rgb(np.ascontiguousarray(image), encoding)


def _to_rgb(image: NDArray[np.uint8], encoding: str) -> Picture:
    rgb: Picture = cv2.cvtColor(image, _TO_RGB[encoding])
    return rgb


def _upper_bytes(rows: NDArray[np.uint8], is_bigendian: bool) -> NDArray[np.uint8]:
    return rows[:, 0::2] if is_bigendian else rows[:, 1::2]
