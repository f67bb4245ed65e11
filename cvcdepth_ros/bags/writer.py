# SPDX-License-Identifier: Apache-2.0
"""Writing of rosbag2 recordings (MCAP storage) that `ros2 bag`, Foxglove and RViz open."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags.topics import LATCHED, Topic, qos_profile
from cvcdepth_ros.bags.typestores import typestore_for

# The newest metadata layout that Humble reads too (9 writes the QoS as a YAML tree, which needs Jazzy).
_METADATA_VERSION: Final = 8


class RecordingWriter:
    """Writes a new rosbag2 folder; use it as a context manager.

    When the `with` block ends by an exception the recording is still closed properly and holds what was written until
    then. After a kill the complete chunks (1 MiB) are on disk, and `open_recording` reads them.
    """

    def __init__(self, path: str | Path, *, compress: bool = False) -> None:
        """Create the folder `path`.

        `compress` packs chunks with zstd; leave it off for JPEG and when speed matters. Raises RecordingError when the
        path exists or cannot be created.
        """
        self.path = Path(path)
        self._topics: dict[str, tuple[Connection, Typestore]] = {}
        try:
            self._writer = Writer(self.path, version=_METADATA_VERSION, storage_plugin=StoragePlugin.MCAP)
            if compress:
                self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except WriterError as error:
            raise RecordingError(f"{self.path}: exists already, will not be overwritten") from error
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be created: {error.strerror or error}") from error

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write the index and metadata.yaml; closing again does nothing."""
        if self._writer.storage is None:
            return
        try:
            self._writer.close()
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def add_topic(self, name: str, type_: str, qos: Sequence[Qos] = (), definition: str | None = None) -> None:
        """Announce a topic; a `definition` is needed for types that are not of ROS 2 Jazzy's common packages.

        Without `qos` it is reliable, keep last 10; `/tf_static` is latched (transient local). Raises RecordingError for
        a name that was added before and for an unknown type.
        """
        if name in self._topics:
            raise RecordingError(f"{self.path}: topic {name} was added twice")
        store = typestore_for([Topic(name, type_, 0, definition=definition)])
        if type_ not in store.fielddefs:
            raise RecordingError(f"{self.path}: topic {name}: type {type_} is not known and came without a definition")
        qos = qos or [LATCHED if name == "/tf_static" else qos_profile()]
        connection = self._writer.add_connection(name, type_, typestore=store, offered_qos_profiles=qos)
        self._topics[name] = connection, store

    def write(self, topic: str, log_time: int, message: Any) -> None:
        """Append one message: CDR bytes, or an object with the attributes of the message type.

        Raises RecordingError for a topic that was not added, an object that does not fit its type, and a full disk.
        """
        if topic not in self._topics:
            raise RecordingError(f"{self.path}: topic {topic} was not added; known are {sorted(self._topics)}")
        connection, store = self._topics[topic]
        try:
            is_cdr = isinstance(message, bytes | bytearray | memoryview)
            cdr = message if is_cdr else store.serialize_cdr(message, connection.msgtype)
            self._writer.write(connection, log_time, cdr)
        except (SerdeError, WriterError, struct.error, AttributeError, TypeError, ValueError) as error:
            raise RecordingError(f"{self.path}: {topic}: no {connection.msgtype}: {error}") from error
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror or error}") from error
