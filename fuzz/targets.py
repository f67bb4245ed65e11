# SPDX-License-Identifier: Apache-2.0
"""What is fuzzed: each target takes any bytes and may raise nothing.

A target does what the product does with bytes that strangers made, and lets through only the family of errors that
programs print as one line. `fuzz/run.py` drives the targets with atheris, `tests/whole/test_fuzz_corpus.py` replays the
corpus without it.
"""

import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.images.decoding import Reduction, decode_compressed, decode_raw
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_ros.bags import Recording, open_recording, typestore
from cvcdepth_ros.messages.conversion import calibration_from_message, picture_from_message, stamp_ns
from cvcdepth_ros.messages.point_clouds import points_from_message
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.recordings.rig import discover_rig
from cvcdepth_ros.recordings.summary import summarize

_PIXELS = 1 << 16  # keeps one execution short, and is a bound like any other
_REDUCTIONS: tuple[Reduction, ...] = (1, 2, 4, 8)
_FORMATS = ("jpeg", "bgr8; jpeg compressed bgr8", "bayer_rggb8; png compressed ", "mono16; png compressed")
_ENCODINGS = ("rgb8", "bgr8", "8UC3", "rgba8", "bgra8", "mono8", "mono16", "16UC1", "bayer_rggb8", "bayer_gbrg16", "?")
_ENCODINGS += ("yuv422", "yuyv", "nv12", "nv21", "rgb16", "bgra16")
_RAW_HEADER = struct.Struct("<BBIIII")
_MESSAGE_TYPES = (
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/PointCloud2",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
)


def compressed_images(content: bytes) -> None:
    """Decode JPEG and PNG; the first byte chooses format text and reduction."""
    choice = content[0] if content else 0
    encoded = _with_png_checksums(content[1:])
    with suppress(CvcDepthError):
        decode_compressed(_FORMATS[choice // 4 % 4], encoded, "c", reduce=_REDUCTIONS[choice % 4], max_pixels=_PIXELS)


def raw_images(content: bytes) -> None:
    """Decode a `sensor_msgs/Image`, field by field."""
    if len(content) < _RAW_HEADER.size:
        return
    encoding, flags, width, height, step, _ = _RAW_HEADER.unpack_from(content)
    pixels = content[_RAW_HEADER.size :]
    with suppress(CvcDepthError):
        decode_raw(width, height, _ENCODINGS[encoding % len(_ENCODINGS)], step, bool(flags & 1), pixels, "c", _PIXELS)


def messages(content: bytes) -> None:
    """Deserialise and use a message of any type that node and bag tool accept; the first byte chooses it."""
    type_name = _MESSAGE_TYPES[content[0] % len(_MESSAGE_TYPES)] if content else _MESSAGE_TYPES[0]
    message = SimpleNamespace(topic="/t", log_time=0, cdr=content[1:])
    with suppress(CvcDepthError):
        _use(type_name, Recording.deserialize(_store(type_name), message))  # type: ignore[arg-type]


def recordings(content: bytes) -> None:
    """Open a file of any format, read it through, describe it, find its cameras."""
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        path = Path(folder) / "recording"
        path.write_bytes(content)
        with suppress(CvcDepthError), open_recording(path) as recording:
            _read_through(recording)


def metadata(content: bytes) -> None:
    """Open a folder by its metadata.yaml."""
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        (Path(folder) / "metadata.yaml").write_bytes(content)
        with suppress(CvcDepthError), open_recording(folder):
            pass


def rig_files(content: bytes) -> None:
    """Load a rig file and complete the rig."""
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        path = Path(folder) / "rig.yaml"
        path.write_bytes(content)
        with suppress(CvcDepthError):
            load_rig_layout(path).complete()


TARGETS: dict[str, Callable[[bytes], None]] = {
    target.__name__: target for target in (compressed_images, raw_images, messages, recordings, metadata, rig_files)
}


def _memory() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def _read_through(recording: Recording) -> None:
    for message in recording.messages():
        with suppress(CvcDepthError):
            recording.deserialize(message)
    with suppress(CvcDepthError):
        summarize(recording)
    with suppress(CvcDepthError):
        discover_rig(recording)


def _store(type_name: str) -> Any:
    """Return what `Recording.deserialize` needs of a recording."""
    return SimpleNamespace(path="p", topics={"/t": SimpleNamespace(type=type_name)}, typestore=typestore())


def _use(type_name: str, message: Any) -> None:
    """Do with a message what node and bag tool do with it."""
    if type_name.endswith("CameraInfo"):
        Rectifier(calibration_from_message(message, "c"), 32, 32)
    elif type_name.endswith("PointCloud2"):
        points_from_message(message, "/t")
    elif type_name.endswith("TFMessage"):
        TransformTree().add_message(message)
    else:
        stamp_ns(message)
        picture_from_message(message, "c")


def _with_png_checksums(encoded: bytes) -> bytes:
    """Write right checksums into a PNG, which else would hide from the mutations what lies behind them."""
    if not encoded.startswith(b"\x89PNG\r\n\x1a\n"):
        return encoded
    return encoded[:8] + b"".join(_png_chunks(encoded))


def _png_chunks(encoded: bytes) -> Iterator[bytes]:
    position = 8
    while position + 12 <= len(encoded):
        length = int.from_bytes(encoded[position : position + 4], "big")
        kind_and_content = encoded[position + 4 : position + 8 + length]
        yield encoded[position : position + 4] + kind_and_content + struct.pack(">I", zlib.crc32(kind_and_content))
        position += 12 + length
