# SPDX-License-Identifier: Apache-2.0
"""Video packets as camera drivers send them, made with PyAV."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest
from numpy.typing import NDArray

av = pytest.importorskip("av", reason="PyAV is an extra")

KEY_EVERY = 6
ENCODERS = {"h264": "libx264", "hevc": "libx265"}


def encoded(
    pictures: Sequence[NDArray[np.uint8]], codec: str, b_frames: int = 0, key_every: int = KEY_EVERY, crf: int = 5
) -> list[bytes]:
    """One packet for each BGR picture."""
    context = av.CodecContext.create(ENCODERS[codec], "w")
    context.height, context.width = pictures[0].shape[:2]
    context.pix_fmt = "yuv420p"
    context.time_base, context.framerate, context.gop_size = Fraction(1, 10), Fraction(10, 1), key_every
    quality = {"crf": str(crf), "preset": "veryfast", "x265-params": "log-level=none:bframes=0:scenecut=0"}
    context.options = quality if b_frames else {**quality, "tune": "zerolatency"}
    context.max_b_frames = b_frames
    packets = []
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, "bgr24")
        frame.pts = number
        packets += context.encode(frame)
    return [bytes(packet) for packet in [*packets, *context.encode(None)]]
