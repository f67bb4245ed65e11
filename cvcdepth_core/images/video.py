# SPDX-License-Identifier: Apache-2.0
"""One camera's video stream (H.264, H.265), packet by packet, through PyAV, which is imported only for it.

A packet says how the picture differs from the ones before, up to a key frame that stands alone. A decoder therefore
belongs to one camera, and is given all packets from a key frame on, in order: by a node as they arrive, of a recording
by who reads it (`cvcdepth_ros.bags.video`).
"""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from cvcdepth_core.errors import ImageError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.h264_frames import FrameNumbers
from cvcdepth_core.rig.calibration import MAX_PIXELS

CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc"}
"""FFmpeg's name of each codec that is read, by the names that messages give."""

VIDEO_EXTRA = "pip install 'cvcdepth_ros[video]'"
"""What to do where `video_is_read` says no."""

_START_CODE = b"\x00\x00\x01"
# Kinds of H.264's and H.265's units (ITU-T H.264, table 7-1; H.265, table 7-1): key pictures, and what comes before.
_H264_KEYS = frozenset((5, 7))
_HEVC_KEYS = frozenset((*range(16, 22), 32, 33))
_MAX_UNITS = 64  # of a packet that are looked at; a key frame's first ones tell


def video_is_read() -> bool:
    """Whether PyAV is installed."""
    return find_spec("av") is not None


def codec_of(name: str) -> str | None:
    """Return FFmpeg's name of the codec that a message means ("h264", "libx264", "hevc_nvenc"); None for another."""
    first = name.strip().lower().replace("/", ";").partition(";")[0]
    if "264" in first or first == "avc":
        return "h264"
    return "hevc" if "265" in first or "hevc" in first else None


def is_key_frame(codec: str, packet: bytes) -> bool:
    """Whether a packet (start codes before each unit) can be decoded without the ones before."""
    position = packet.find(_START_CODE)
    for _ in range(_MAX_UNITS):
        if not 0 <= position < len(packet) - len(_START_CODE):
            return False
        first = packet[position + len(_START_CODE)]
        if (first & 0x1F in _H264_KEYS) if codec == "h264" else (first >> 1 & 0x3F in _HEVC_KEYS):
            return True
        position = packet.find(_START_CODE, position + len(_START_CODE))
    return False


class VideoDecoder:
    """Decodes one camera's packets; all from a key frame on are to be given, in order."""

    def __init__(self, codec: str, camera: str) -> None:
        """`codec` is one of `CODECS`' values. ImageError names the extra where PyAV is not installed."""
        if not video_is_read():
            raise ImageError(f"camera {camera}: its images are {codec} video; {VIDEO_EXTRA} reads them")
        self.codec = codec
        self._camera = camera
        self._count = 0
        self._context: Any = None
        self._numbers = FrameNumbers()

    @property
    def is_ready(self) -> bool:
        """Whether a key frame was given, so that the next packet can be decoded."""
        return self._context is not None

    def reset(self) -> None:
        """Forget what was given; the next packet must be a key frame."""
        self._context = None

    def decode(self, packet: bytes) -> Picture:
        """Return the packet's picture, RGB [height, width, 3]; ImageError as for `take`."""
        return self.take(packet)()

    def take(self, packet: bytes) -> Callable[[], Picture]:
        """Take in a packet, and return what makes its picture, RGB [height, width, 3], for whoever wants it.

        ImageError names the camera when it cannot be decoded: no key frame came before, packets are missing between,
        the packet is damaged, the stream shows its pictures in another order than it sends them (B-frames), or a
        picture is beyond measure.
        """
        frame = self._frame(packet)
        if frame.width * frame.height > MAX_PIXELS:
            raise ImageError(
                f"camera {self._camera}: image of {frame.width}x{frame.height}; at most {MAX_PIXELS} pixels"
            )
        return partial(_picture, frame)

    def _frame(self, packet: bytes) -> Any:
        if is_key_frame(self.codec, packet):
            self._context = self._context or self._new_context()
        elif self._context is None:
            raise ImageError(f"camera {self._camera}: {self.codec} packet without a key frame before it")
        if self.codec == "h264" and not self._numbers.follows(packet):
            self.reset()
            raise ImageError(f"camera {self._camera}: {self.codec} packets are missing before this one")
        import av

        self._count += 1
        sent = av.Packet(packet)
        sent.pts = self._count
        try:
            frames = self._context.decode(sent)
        except (av.error.FFmpegError, ValueError, MemoryError) as error:
            self.reset()
            raise ImageError(f"camera {self._camera}: {self.codec} packet of {len(packet)} bytes: {error}") from error
        if not frames or frames[-1].pts != self._count or frames[-1].is_corrupt:
            self.reset()
            reason = "gives no picture: it is damaged, or pictures are sent in another order than shown (B-frames)"
            raise ImageError(f"camera {self._camera}: {self.codec} packet of {len(packet)} bytes {reason}")
        return frames[-1]

    def _new_context(self) -> Any:
        import av
        from av.codec.context import Flags

        context = av.CodecContext.create(self.codec, "r")
        context.flags |= Flags.low_delay
        context.thread_count = 1  # more threads give pictures later
        # What is missing is told. It is painted over all the same, since FFmpeg marks only such pictures as corrupt.
        context.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "explode"}
        return context


def _picture(frame: Any) -> Picture:
    picture: Picture = np.ascontiguousarray(frame.to_ndarray(format="rgb24"))
    return picture
