# SPDX-License-Identifier: Apache-2.0
"""A short recording made longer: repeated with later and later stamps."""

import struct
from pathlib import Path

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_ros.bags import Recording, RecordingWriter

_STAMP = 4  # where a CDR message's first field begins, which is the header's stamp


def write_repeated(recording: Recording, layout: RigLayout, path: Path, seconds: float) -> None:
    """Write the cameras' images and calibrations for at least so many seconds.

    RecordingError when there are too few images to tell the pace.
    """
    images = [camera.image_topic for camera in layout.cameras]
    topics = {*images, *(camera.camera_info_topic for camera in layout.cameras)} & recording.topics.keys()
    times = [message.log_time for message in recording.messages(images[:1])]
    if len(times) < 2 or times[-1] == times[0]:
        raise RecordingError(f"{recording.path}: {images[0]} has {len(times)} images, too few to be repeated")
    length = (times[-1] - times[0]) * len(times) // (len(times) - 1)  # with the pause after its last image
    with RecordingWriter(path) as writer:
        for name in topics:
            writer.add_topic(name, recording.topics[name].type, recording.topics[name].qos or ())
        for later in range(0, int(seconds * 1e9), length):
            for message in recording.messages(topics):
                writer.write(message.topic, message.log_time + later, _restamped(bytes(message.cdr), later))


def _restamped(cdr: bytes, later: int) -> bytes:
    """Return a message that begins with a header, its stamp `later` nanoseconds later."""
    form = "<iI" if cdr[1] else ">iI"  # CDR's encapsulation kind: 0 big-endian, 1 little-endian
    seconds, nanoseconds = struct.unpack_from(form, cdr, _STAMP)
    stamp = struct.pack(form, *divmod(seconds * 10**9 + nanoseconds + later, 10**9))
    return cdr[:_STAMP] + stamp + cdr[_STAMP + len(stamp) :]
