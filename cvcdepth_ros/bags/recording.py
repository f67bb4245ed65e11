# SPDX-License-Identifier: Apache-2.0
"""A recording, whatever it is stored in: `open_recording` guesses the format from the files' first bytes."""

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory, mkdtemp
from typing import IO, Any

import yaml
import zstandard
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.files import load_yaml
from cvcdepth_ros.bags import mcap_file, ros1_file, sqlite_file
from cvcdepth_ros.bags.mcap_file import McapFile, unpack_zstd
from cvcdepth_ros.bags.ordering import Source, in_time_order
from cvcdepth_ros.bags.remote import Location, RemotePath, location
from cvcdepth_ros.bags.ros1_file import Ros1File
from cvcdepth_ros.bags.sqlite_file import SqliteFile
from cvcdepth_ros.bags.topics import (
    MAX_BLOCK_BYTES,
    STORAGE_SUFFIXES,
    RecordedMessage,
    RecordingFile,
    Topic,
    joined_topics,
)
from cvcdepth_ros.bags.typestores import typestore_for

_LOCAL_READERS: dict[bytes, Callable[[Path], RecordingFile]] = {
    mcap_file.MAGIC: McapFile,
    sqlite_file.MAGIC: SqliteFile,
    ros1_file.MAGIC: Ros1File,
}
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ZSTD_SUFFIX = ".zstd"
_FOREVER = 2**63 - 1
# Raw images of a dark garage shrink to a hundredth; what shrinks to less is no recording.
_MAX_EXPANSION = 500
_PIECE_BYTES = 2**20
_SHOWN_DAMAGES = 5

RecordingPath = str | Location


def open_recording(path: RecordingPath | Sequence[RecordingPath]) -> "Recording":
    """Open a rosbag2 folder, a single .mcap, .db3 or ROS 1 .bag file, or several that together are one recording.

    Behind a URL that fsspec opens (s3://bucket/drive.mcap) only MCAP is read, by seeking. Damaged parts are passed over
    and told in `Recording.damage`. Raises RecordingError, naming the path and what was found there, when no message can
    be read, and ConfigError when a URL needs a package that is not installed.
    """
    parts = [path] if isinstance(path, str | Path | RemotePath) else path
    return Recording([location(part) for part in parts])


class Recording:
    """Topics and messages of one recording; use it as a context manager."""

    path: Location
    """What was opened (the first path when several were)."""
    topics: dict[str, Topic]
    """By name, in the order of the recording."""
    start: int
    """Log time of the first message, ns."""
    end: int
    """Log time of the last message, ns."""

    def __init__(self, paths: Sequence[Location]) -> None:
        if not paths:
            raise RecordingError("no recording given: the list of paths is empty")
        self.path = paths[0]
        self._damage: list[str] = []
        self._unpacked: TemporaryDirectory[str] | None = None
        try:
            self._files = self._open_files([file for path in paths for file in self._listed(path)])
            self.topics = joined_topics([t for file in self._files for t in file.topics.values()], self.path)
            self.start, self.end = self._span()
        except OSError as error:
            self.close()
            raise RecordingError(f"{self.path}: {error.strerror or error}") from error
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove what was unpacked."""
        if self._unpacked:
            self._unpacked.cleanup()
            self._unpacked = None

    @property
    def damage(self) -> str | None:
        """What could not be read, and why; None while all is well. It grows while messages are read."""
        found = [*self._damage, *(f"{file.path}: {damage}" for file in self._files for damage in file.damage)]
        if len(found) > _SHOWN_DAMAGES:
            found[_SHOWN_DAMAGES:] = [f"and {len(found) - _SHOWN_DAMAGES} more"]
        return "; ".join(found) or None

    @property
    def files(self) -> Sequence[RecordingFile]:
        """The files it is stored in."""
        return tuple(self._files)

    @cached_property
    def typestore(self) -> Typestore:
        """The message types of this recording."""
        return typestore_for(self.topics.values())

    def messages(
        self, topics: Collection[str] | None = None, start: int | None = None, stop: int | None = None
    ) -> Iterator[RecordedMessage]:
        """Give the messages of `topics` (all by default) with start <= log_time < stop (ns) by log time.

        Memory stays flat: one chunk of each file that is being read. Raises RecordingError for an unknown topic, and
        when the storage itself fails meanwhile.
        """
        wanted = set(self.topics if topics is None else topics)
        if unknown := wanted - self.topics.keys():
            raise RecordingError(f"{self.path}: no topic {sorted(unknown)}; it has {sorted(self.topics)}")
        first, last = 0 if start is None else start, _FOREVER if stop is None else stop
        return self._unpacked_messages(
            in_time_order(
                Source(file.start, partial(file.messages, wanted, first, last))
                for file in self._files
                if file.start is not None and file.end is not None and file.start < last and file.end >= first
            )
        )

    def deserialize(self, message: RecordedMessage) -> Any:
        """Return the message as an object whose attributes are those of rclpy's class; arrays are numpy arrays.

        Raises RecordingError, naming topic, type and time, when the type is unknown or the bytes do not fit it.
        """
        type_ = self.topics[message.topic].type
        where = f"{self.path}: {message.topic} at {message.log_time} ns"
        if type_ not in self.typestore.fielddefs:
            raise RecordingError(f"{where}: type {type_} is not known, and the recording carries no definition of it")
        try:
            return self.typestore.deserialize_cdr(memoryview(message.cdr), type_)
        except (SerdeError, ValueError) as error:
            raise RecordingError(f"{where}: {len(message.cdr)} bytes that are no {type_}: {error}") from error

    def _unpacked_messages(self, messages: Iterator[RecordedMessage]) -> Iterator[RecordedMessage]:
        """Unpack messages that were compressed one by one; CDR begins with a zero byte, so they cannot be confused."""
        try:
            for message in messages:
                if message.cdr[:4] != _ZSTD_MAGIC:
                    yield message
                elif (cdr := self._unpacked_cdr(message)) is not None:
                    yield message._replace(cdr=cdr)
        except OSError as error:
            raise RecordingError(f"{self.path}: reading failed: {error.strerror or error}") from error

    def _unpacked_cdr(self, message: RecordedMessage) -> bytes | None:
        try:
            return unpack_zstd(message.cdr, MAX_BLOCK_BYTES)
        except zstandard.ZstdError as error:
            damage = f"{self.path}: {message.topic} at {message.log_time} ns skipped ({error})"
            if damage not in self._damage:
                self._damage.append(damage)
            return None

    def _span(self) -> tuple[int, int]:
        starts = [file.start for file in self._files if file.start is not None]
        ends = [file.end for file in self._files if file.end is not None]
        if not starts:
            damage = f" ({self.damage})" if self.damage else ""
            raise RecordingError(f"{self.path}: holds no readable message{damage}")
        return min(starts), max(ends)

    def _listed(self, path: Location) -> list[Location]:
        """Return the storage files of a path: itself, or those of a folder."""
        if not path.exists():
            raise RecordingError(f"{path}: does not exist")
        if path.is_file():
            return [path]
        present = sorted(file for file in path.iterdir() if file.name.endswith(STORAGE_SUFFIXES))
        files = self._listed_by_metadata(path) or present
        if unlisted := _unlisted(present, files):
            self._damage.append(f"{path}: metadata.yaml does not list {', '.join(unlisted)}, not read")
        if missing := [file.name for file in files if not file.exists()]:
            self._damage.append(f"{path}: metadata.yaml lists {', '.join(missing)}, not found")
        if not (files := [file for file in files if file.exists()]):
            content = ", ".join(sorted(file.name for file in path.iterdir())[:8]) or "nothing"
            raise RecordingError(f"{path}: no recording in this folder; found {content}")
        return files

    def _listed_by_metadata(self, folder: Location) -> list[Location]:
        """Return what metadata.yaml lists, nothing when the recorder died before it wrote one."""
        metadata = folder / "metadata.yaml"
        if not metadata.exists():
            self._damage.append(f"{folder}: no metadata.yaml, reading all files of the folder")
            return []
        try:
            names = load_yaml(metadata.read_text())["rosbag2_bagfile_information"]["relative_file_paths"]
            return [folder / PurePath(name).name for name in names]
        except (yaml.YAMLError, ValueError, LookupError, TypeError) as error:
            self._damage.append(f"{metadata}: unreadable ({type(error).__name__}), reading all files of the folder")
            return []

    def _open_files(self, paths: Sequence[Location]) -> list[RecordingFile]:
        """Open the files; when one of several cannot be opened, the others are still read."""
        files: list[RecordingFile] = []
        errors: list[RecordingError] = []
        for path in paths:
            try:
                files.append(self._open_file(path))
            except RecordingError as error:
                errors.append(error)
        if not files:
            raise RecordingError("; ".join(map(str, errors)))
        self._damage += map(str, errors)
        return files

    def _open_file(self, path: Location) -> RecordingFile:
        try:
            beginning = _beginning(path)
            if isinstance(path, RemotePath):
                return _remote_reader(path, beginning)
            if not beginning.startswith(_ZSTD_MAGIC):
                return _local_reader(path, beginning, str(path))
            # Once: each layer of a file packed again and again may multiply its size by as much.
            unpacked = self._unpack(path)
            return _local_reader(unpacked, _beginning(unpacked), f"{path} (unpacked)")
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror or error}") from error

    def _unpack(self, path: Path) -> Path:
        """Unpack a file that was compressed as a whole into a folder of its own: others may have the same name."""
        self._unpacked = self._unpacked or TemporaryDirectory(prefix="cvcdepth_")
        target = Path(mkdtemp(dir=self._unpacked.name)) / path.stem
        try:
            with zstandard.open(path, "rb") as packed, target.open("wb") as unpacked:
                _copy(packed, unpacked, _MAX_EXPANSION * path.stat().st_size)
        except zstandard.ZstdError as error:
            raise RecordingError(f"{path}: cannot be decompressed: {error}") from error
        return target


def _unlisted(present: Sequence[Location], listed: Sequence[Location]) -> list[str]:
    """Name the files beside those that are listed; not the unpacked one that `ros2 bag` leaves beside a packed one."""
    known = {file.name.removesuffix(_ZSTD_SUFFIX) for file in listed}
    names = [file.name for file in present if not file.name.startswith(".")]
    return [name for name in names if name.removesuffix(_ZSTD_SUFFIX) not in known]


def _remote_reader(path: RemotePath, beginning: bytes) -> RecordingFile:
    if not beginning.startswith(mcap_file.MAGIC):
        raise RecordingError(f"{path}: {_begins(beginning)}; behind a URL only MCAP can be read, by seeking")
    return McapFile(path)


def _local_reader(path: Path, beginning: bytes, where: str) -> RecordingFile:
    for magic, reader in _LOCAL_READERS.items():
        if beginning.startswith(magic):
            return reader(path)
    raise RecordingError(f"{where}: {_begins(beginning)}; an MCAP, SQLite or ROS 1 recording was expected")


def _copy(packed: IO[bytes], unpacked: IO[bytes], most: int) -> None:
    while piece := packed.read(_PIECE_BYTES):
        if unpacked.tell() + len(piece) > most:
            raise zstandard.ZstdError(f"unpacks to more than {most} bytes, {_MAX_EXPANSION} times its size")
        unpacked.write(piece)


def _beginning(path: Location) -> bytes:
    with path.open("rb") as stream:
        return stream.read(16)


def _begins(beginning: bytes) -> str:
    return f"begins with {beginning!r}" if beginning else "is empty (0 bytes)"
