# SPDX-License-Identifier: Apache-2.0
"""Reading of one ROS 1 .bag file; its messages are converted to CDR, its types to their ROS 2 form."""

import struct
from collections.abc import Collection, Iterator
from pathlib import Path

from rosbags.interfaces import Connection, ConnectionExtRosbag1
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags.topics import LATCHED, RecordedMessage, RecordingFile, Topic, error_text, joined_topics
from cvcdepth_ros.bags.typestores import parsed_definition, typestore, typestore_for

MAGIC = b"#ROSBAG V2.0\n"
# What rosbags and the decompressors raise on damaged bytes. Its reader also asserts, and looks up connections that the
# file does not have; bz2: EOFError, lz4: RuntimeError.
_DAMAGE = (
    ReaderError,
    SerdeError,
    AssertionError,
    LookupError,
    struct.error,
    ValueError,
    EOFError,
    RuntimeError,
    OSError,
)
# The types that ROS 1 lays out differently (the header has a sequence number there) or has built in.
_ROS2_TYPES = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


class Ros1File(RecordingFile):
    """One .bag file, see `RecordingFile`."""

    path: Path

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.size = path.stat().st_size
        try:
            with Reader(path) as reader:
                self.topics = joined_topics([_topic(connection) for connection in reader.connections], path)
                empty = reader.message_count == 0
                self.start = None if empty else reader.start_time
                self.end = None if empty else reader.end_time - 1
        except _DAMAGE as error:
            raise RecordingError(
                f"{path}: {error_text(error)} (`rosbag reindex` repairs a bag that was cut)"
            ) from error
        except TypesysError as error:
            raise RecordingError(f"{path}: message definition not understood: {error}") from error
        self._typestore = typestore_for(self.topics.values())

    def messages(self, topics: Collection[str], start: int, stop: int) -> Iterator[RecordedMessage]:
        """Give the messages of `topics` with start <= log_time < stop, in time order."""
        count = 0
        with Reader(self.path) as reader:
            wanted = [connection for connection in reader.connections if connection.topic in topics]
            try:
                for connection, log_time, raw in reader.messages(wanted, start, stop) if wanted else ():
                    cdr = self._typestore.ros1_to_cdr(raw, connection.msgtype)
                    yield RecordedMessage(connection.topic, log_time, cdr)
                    count += 1
            except _DAMAGE as error:
                self._report(f"reading stopped after {count} messages", error)


def _topic(connection: Connection) -> Topic:
    types = parsed_definition(connection.msgdef.data, connection.msgtype)
    if connection.msgtype not in types:
        raise TypesysError(f"that of {connection.msgtype}, which is not complete or no definition")
    types.update({name: typestore().fielddefs[name] for name in _ROS2_TYPES})
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    definition, _ = store.generate_msgdef(connection.msgtype, ros_version=2)
    latched = isinstance(connection.ext, ConnectionExtRosbag1) and bool(connection.ext.latching)
    return Topic(connection.topic, connection.msgtype, connection.msgcount, (LATCHED,) if latched else None, definition)
