# SPDX-License-Identifier: Apache-2.0
"""How the pixels of a raw image lie in its bytes, by `sensor_msgs/Image.encoding`, and how they become RGB.

Names are those of sensor_msgs/image_encodings.hpp, and those that drivers write for the same.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

_PATTERNS = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
}
_RIGHT_ALIGNED_BITS = (10, 12)


class PixelFormat(NamedTuple):
    """The layout of one encoding."""

    channels: int
    """Numbers for each pixel in a row; of planes behind each other: in the first plane."""
    to_rgb: int | None
    """OpenCV's conversion; None where it is RGB already."""
    is_deep: bool = False
    """Whether numbers have 16 bits."""
    shares_colour: bool = False
    """Whether neighbours share their colour, so that the width must be even."""
    has_colour_plane: bool = False
    """Whether the colours of 2 x 2 pixels are in a second plane of half the height."""


def _packed(names: str, channels: int, to_rgb: int | None, is_deep: bool = False) -> dict[str, PixelFormat]:
    return {name: PixelFormat(channels, to_rgb, is_deep) for name in names.split()}


def _shared(names: str, channels: int, to_rgb: int) -> dict[str, PixelFormat]:
    return {
        name: PixelFormat(channels, to_rgb, shares_colour=True, has_colour_plane=channels == 1)
        for name in names.split()
    }


# 8UC3 says nothing of its colours; drivers that leave the encoding generic nearly all send OpenCV's order.
FORMATS: dict[str, PixelFormat] = {
    **_packed("rgb8", 3, None),
    **_packed("bgr8 8UC3", 3, cv2.COLOR_BGR2RGB),
    **_packed("rgba8", 4, cv2.COLOR_RGBA2RGB),
    **_packed("bgra8 8UC4", 4, cv2.COLOR_BGRA2RGB),
    **_packed("mono8 8UC1", 1, cv2.COLOR_GRAY2RGB),
    **_packed("rgb16", 3, None, is_deep=True),
    **_packed("bgr16 16UC3", 3, cv2.COLOR_BGR2RGB, is_deep=True),
    **_packed("rgba16", 4, cv2.COLOR_RGBA2RGB, is_deep=True),
    **_packed("bgra16 16UC4", 4, cv2.COLOR_BGRA2RGB, is_deep=True),
    **_packed("mono16 16UC1", 1, cv2.COLOR_GRAY2RGB, is_deep=True),
    **{f"bayer_{name}8": PixelFormat(1, code) for name, code in _PATTERNS.items()},
    **{f"bayer_{name}16": PixelFormat(1, code, is_deep=True) for name, code in _PATTERNS.items()},
    **_shared("yuv422 uyvy", 2, cv2.COLOR_YUV2RGB_UYVY),
    **_shared("yuv422_yuy2 yuyv yuy2", 2, cv2.COLOR_YUV2RGB_YUY2),
    **_shared("nv12", 1, cv2.COLOR_YUV2RGB_NV12),
    **_shared("nv21", 1, cv2.COLOR_YUV2RGB_NV21),
}
"""All encodings that are read."""


def pixel_format(encoding: str) -> PixelFormat | None:
    """Return the layout of an encoding; None where it is unknown. Some drivers write names in capitals."""
    return FORMATS.get(encoding) or FORMATS.get(encoding.lower())


def used_bits(deep: NDArray[np.uint16]) -> int:
    """Return how many bits of 16-bit numbers are in use: 10 or 12 where the rest of all of them is zero, else 16.

    Sensors of 10 and 12 bits are sent in the lower bits as often as in the upper ones, and no encoding tells which. A
    picture of 16 bits that stays below 2^12 everywhere would be black to the eye, and to any network.
    """
    largest = int(deep.max(initial=0))
    return next((bits for bits in _RIGHT_ALIGNED_BITS if largest < 1 << bits), 16)


def to_eight_bits(deep: NDArray[np.uint16]) -> Pixels:
    """Return the upper eight of the bits that are in use."""
    eight: Pixels = (deep >> (used_bits(deep) - 8)).astype(np.uint8)
    return eight


def to_rgb(image: Pixels, to_rgb_code: int | None) -> Pixels:
    """Convert an image as OpenCV takes it, in this format's layout, to RGB [H, W, 3]."""
    contiguous = np.ascontiguousarray(image)
    rgb: Pixels = contiguous if to_rgb_code is None else cv2.cvtColor(contiguous, to_rgb_code)
    return rgb
