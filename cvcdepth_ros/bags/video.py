# SPDX-License-Identifier: Apache-2.0
"""Recorded video streams: each packet becomes the raw image that a camera saw, whichever is asked for first.

Packets that are asked for in the order of recording are decoded one after the other. For any other the recording is
read from the last key frame before it.
"""

from __future__ import annotations

from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rosbags.typesys.store import Typestore

from cvcdepth_core.errors import ImageError, RecordingError
from cvcdepth_core.images.video import VideoDecoder, codec_of, is_key_frame
from cvcdepth_ros.bags.topics import RecordedMessage

FFMPEG_PACKET = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
COMPRESSED_VIDEO = "foxglove_msgs/msg/CompressedVideo"
VIDEO_DEFINITIONS = {
    FFMPEG_PACKET: "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
    "bool is_bigendian\nuint8[] data\n",
    COMPRESSED_VIDEO: "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
}
"""The types of messages that carry one packet, with their layouts, which older recordings do not tell."""

_SECOND = 10**9
# Key frames come every second or two; cameras that send one only when asked to are not sought in for ever.
_REMEMBERED = 1000
_WINDOWS = (2 * _SECOND, 8 * _SECOND, 32 * _SECOND)

ReadMessages = Callable[[Sequence[str], int, int], Iterator[RecordedMessage]]
"""Gives a topic's messages from one log time to another (ns, exclusive)."""


@dataclass
class _Stream:
    """One topic."""

    decoder: VideoDecoder
    position: int | None = None
    """Log time of the packet that was decoded last, ns."""
    image: Any = None
    """What became of it."""


class RecordedVideos:
    """The video streams of one recording."""

    def __init__(self, messages: ReadMessages, store: Typestore) -> None:
        self._messages = messages
        self._store = store
        self._streams: dict[str, _Stream] = {}
        self._before: dict[str, OrderedDict[int, int]] = defaultdict(OrderedDict)

    def follow(self, messages: Iterator[RecordedMessage], topics: frozenset[str]) -> Iterator[RecordedMessage]:
        """Pass messages on, and remember of those of `topics` which comes after which."""
        last: dict[str, int] = {}
        for message in messages:
            if message.topic in topics:
                if message.topic in last:
                    self._remember(self._before[message.topic], message.log_time, last[message.topic])
                last[message.topic] = message.log_time
            yield message

    @staticmethod
    def _remember(before: OrderedDict[int, int], log_time: int, former: int) -> None:
        before[log_time] = former
        if len(before) > _REMEMBERED:
            before.popitem(last=False)

    def image(self, message: RecordedMessage, type_: str) -> Any:
        """Return the `sensor_msgs/Image` of a packet, with its stamp and frame.

        Raises RecordingError, naming topic and time, when it cannot be decoded, also where PyAV is not installed.
        """
        try:
            return self._image(message, type_)
        except ImageError as error:
            reason = str(error).removeprefix(f"camera {message.topic}: ")
            raise RecordingError(f"{message.topic} at {message.log_time} ns: {reason}") from error

    def _image(self, message: RecordedMessage, type_: str) -> Any:
        packet = self._store.deserialize_cdr(memoryview(message.cdr), type_)
        stream = self._stream(message.topic, packet)
        if stream.position == message.log_time and stream.image is not None:
            return stream.image
        if not self._follows(stream, message) and not is_key_frame(stream.decoder.codec, _data(packet)):
            self._catch_up(stream, message, type_)
        stream.position, stream.image = message.log_time, None
        stream.image = self._raw_image(packet, stream.decoder)
        return stream.image

    def _stream(self, topic: str, packet: Any) -> _Stream:
        name = packet.encoding if hasattr(packet, "encoding") else packet.format
        codec = codec_of(name)
        if codec is None:
            raise ImageError(f"camera {topic}: video of '{name:.40}' is not read; H.264 and H.265 are")
        known = self._streams.get(topic)
        if known is None or known.decoder.codec != codec:
            self._streams[topic] = known = _Stream(VideoDecoder(codec, topic))
        return known

    def _follows(self, stream: _Stream, message: RecordedMessage) -> bool:
        before = self._before[message.topic].get(message.log_time)
        return stream.decoder.is_ready and before is not None and before == stream.position

    def _catch_up(self, stream: _Stream, message: RecordedMessage, type_: str) -> None:
        """Decode what comes before a packet: from where the stream is, or from the last key frame."""
        position, time = stream.position, message.log_time
        if stream.decoder.is_ready and position is not None and 0 < time - position <= _WINDOWS[0]:
            packets = self._packets(message.topic, type_, position + 1, time)
        else:
            stream.decoder.reset()
            packets = self._from_key_frame(message, type_, stream.decoder.codec)
        for packet in packets:
            stream.decoder.take(_data(packet))

    def _from_key_frame(self, message: RecordedMessage, type_: str, codec: str) -> list[Any]:
        """Return the packets before this one from the last key frame on."""
        for window in _WINDOWS:
            packets = self._packets(message.topic, type_, max(0, message.log_time - window), message.log_time)
            keys = [number for number, packet in enumerate(packets) if is_key_frame(codec, _data(packet))]
            if keys:
                return packets[keys[-1] :]
        seconds = _WINDOWS[-1] // _SECOND
        raise ImageError(f"camera {message.topic}: no key frame in the {seconds} s before this packet")

    def _packets(self, topic: str, type_: str, start: int, stop: int) -> list[Any]:
        found = self._messages([topic], start, stop)
        return [self._store.deserialize_cdr(memoryview(message.cdr), type_) for message in found]

    def _raw_image(self, packet: Any, decoder: VideoDecoder) -> Any:
        picture = decoder.decode(_data(packet))
        height, width, _ = picture.shape
        types = self._store.types
        header = getattr(packet, "header", None) or types["std_msgs/msg/Header"](packet.timestamp, packet.frame_id)
        return types["sensor_msgs/msg/Image"](header, height, width, "rgb8", 0, 3 * width, picture.reshape(-1))


def _data(packet: Any) -> bytes:
    return bytes(packet.data)
