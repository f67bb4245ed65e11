# SPDX-License-Identifier: Apache-2.0
"""The video streams of live cameras. No ROS here.

A packet says how its picture differs from the one before, so that all must be decoded, in order, also those whose sets
are skipped. Each camera's are decoded on a thread of its own, from the first key frame on. Where one is lost, damaged
or too late, everything up to the next key frame is left out.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from typing import Any

from cvcdepth_core.errors import ImageError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.video import VIDEO_EXTRA, VideoDecoder, codec_of, is_key_frame, video_is_read
from cvcdepth_ros.messages.conversion import header_of, video_codec

_MOST_WAITING = 30
_FEW_WAITING = 3  # what came too fast begins again without a queue, or every later picture would be as late


def video_problem() -> str:
    """Say what is to be installed before video can be decoded; empty where it can."""
    return "" if video_is_read() else f"its images are video; {VIDEO_EXTRA} reads them"


class VideoImage:
    """One packet's picture: a raw image as `picture_from_message` takes it, there once its packet is decoded.

    Whatever is asked of it beside the header waits for that, and is an ImageError where it failed.
    """

    encoding = "rgb8"
    is_bigendian = 0

    def __init__(self, header: Any, decoded: "Future[Callable[[], Picture]]") -> None:
        """Take what `decoded` gives: what makes the picture, or why there is none."""
        self.header = header
        self._decoded = decoded

    @cached_property
    def _picture(self) -> Picture:
        return self._decoded.result()()

    @property
    def height(self) -> int:
        """In pixels."""
        return int(self._picture.shape[0])

    @property
    def width(self) -> int:
        """In pixels."""
        return int(self._picture.shape[1])

    @property
    def step(self) -> int:
        """Bytes of a row."""
        return 3 * self.width

    @property
    def data(self) -> Picture:
        """All bytes."""
        return self._picture.reshape(-1)


class VideoStreams:
    """All cameras' streams; a camera without one costs nothing."""

    def __init__(self) -> None:
        self._streams: dict[str, _Stream] = {}

    def take(self, camera: str, message: Any) -> VideoImage:
        """Take a packet in and have it decoded; quick. ImageError says why there will be no picture.

        To be called on one thread, with all of a camera's packets in the order in which they were sent.
        """
        if camera not in self._streams:
            self._streams[camera] = _Stream(camera)
        return self._streams[camera].take(message)

    def close(self) -> None:
        """Drop what waits."""
        for stream in self._streams.values():
            stream.close()


class _Stream:
    """One camera's. Packets are counted, so that the two threads agree on which came after a failure."""

    def __init__(self, camera: str) -> None:
        self._camera = camera
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"video {camera}")
        self._decoder: VideoDecoder | None = None
        self._waiting: list[Future[Callable[[], Picture]]] = []
        self._count = 0
        self._last_key = 0
        self._failed = 0
        """The last packet that could not be decoded; until a key frame comes after it, none can."""
        self._reason = "its video began before"

    def take(self, message: Any) -> VideoImage:
        codec = self._codec(message)
        packet = bytes(message.data)
        self._count += 1
        self._waiting = [decoded for decoded in self._waiting if not decoded.done()]
        if len(self._waiting) >= _MOST_WAITING:
            self._failed, self._reason = self._count, "its video comes faster than it can be decoded"
        elif is_key_frame(codec, packet) and (self._last_key > self._failed or len(self._waiting) <= _FEW_WAITING):
            self._last_key = self._count
        if self._last_key <= self._failed:
            raise ImageError(f"camera {self._camera}: waiting for a key frame: {self._reason}")
        decoded = self._thread.submit(self._decode, codec, packet, self._count)
        self._waiting.append(decoded)
        return VideoImage(header_of(message), decoded)

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _codec(self, message: Any) -> str:
        name = video_codec(message)
        codec = codec_of(name)
        if codec is None:
            raise ImageError(f"camera {self._camera}: video of '{name:.40}' is not read; H.264 and H.265 are")
        return codec

    def _decode(self, codec: str, packet: bytes, count: int) -> Callable[[], Picture]:
        if self._decoder is None or self._decoder.codec != codec:
            self._decoder = VideoDecoder(codec, self._camera)
        try:
            return self._decoder.take(packet)
        except ImageError:
            self._failed, self._reason = max(self._failed, count), "its video is damaged, or packets were lost"
            raise
