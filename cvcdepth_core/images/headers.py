# SPDX-License-Identifier: Apache-2.0
"""What the header of a JPEG or PNG declares, read before any memory is given to the picture.

A few hundred bytes can declare 65 000 x 65 000 pixels, or thousands of scans over the same ones; a decoder believes
them. The walk through a JPEG's segments is libjpeg's own, so that no header can hide before the one that is read here.
"""

import re
from typing import Literal, NamedTuple

JPEG_START, PNG_START = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"

_MARKER = re.compile(rb"\xff([\x01-\xfe])")
_STANDALONE = frozenset((0x01, *range(0xD0, 0xD8)))
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_SCAN, _END = 0xDA, 0xD9
# Cameras write about ten; the longest profiles of photographs take 255.
_MAX_SEGMENTS = 1000


class ImageHeader(NamedTuple):
    """What an encoded picture says of itself."""

    format: Literal["JPEG", "PNG"]
    width: int
    """Columns."""
    height: int
    """Rows."""
    scans: int
    """Passes over the whole picture that decoding takes; 1 for PNG and most JPEG, about 10 for progressive ones."""


def read_header(encoded: bytes) -> ImageHeader | None:
    """Return what the header declares; None where `encoded` is neither JPEG nor PNG, or its header is damaged."""
    if encoded.startswith(JPEG_START):
        return _jpeg_header(encoded)
    if encoded.startswith(PNG_START) and encoded[12:16] == b"IHDR" and len(encoded) >= 24:
        return ImageHeader("PNG", int.from_bytes(encoded[16:20], "big"), int.from_bytes(encoded[20:24], "big"), 1)
    return None


def _jpeg_header(encoded: bytes) -> ImageHeader | None:
    """Walk from segment to segment up to the frame's (ITU T.81, B.1.1 and B.2.2)."""
    position = len(JPEG_START)
    for _ in range(_MAX_SEGMENTS):
        found = _MARKER.search(encoded, position)
        marker = found[1][0] if found else _END
        if found is None or marker in (_SCAN, _END):
            return None
        position = found.end()
        if marker in _FRAMES:
            return _frame(encoded, position)
        if marker not in _STANDALONE:
            length = int.from_bytes(encoded[position : position + 2], "big")
            if length < 2:
                return None
            position += length
    return None


def _frame(encoded: bytes, position: int) -> ImageHeader | None:
    """Read a frame segment from its length on: length, precision, height, width."""
    if len(encoded) < position + 7:
        return None
    height = int.from_bytes(encoded[position + 3 : position + 5], "big")
    width = int.from_bytes(encoded[position + 5 : position + 7], "big")
    # Within a scan 0xff is always followed by 0 or a restart: only markers are counted, and what comments imitate.
    return ImageHeader("JPEG", width, height, encoded.count(bytes((0xFF, _SCAN)), position))
