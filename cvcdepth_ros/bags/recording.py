# SPDX-License-Identifier: Apache-2.0
"""A recording, whatever it is stored in: `open_recording` guesses the format from the files' first bytes."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import IO, Any

import zstandard
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags import mcap_file, ros1_file, sqlite_file
from cvcdepth_ros.bags.folder import list_folder
from cvcdepth_ros.bags.mcap_file import McapFile
from cvcdepth_ros.bags.mcap_records import unpack_zstd
from cvcdepth_ros.bags.ordering import Source, in_time_order
from cvcdepth_ros.bags.remote import Location, RemotePath, location
from cvcdepth_ros.bags.ros1_file import Ros1File
from cvcdepth_ros.bags.sqlite_file import SqliteFile
from cvcdepth_ros.bags.topics import (
    FOREVER,
    MAX_BLOCK_BYTES,
    RecordedMessage,
    RecordingFile,
    Topic,
    joined_topics,
)
from cvcdepth_ros.bags.typestores import typestore_for
from cvcdepth_ros.bags.video import VIDEO_DEFINITIONS, RecordedVideos

_LOCAL_READERS: dict[bytes, Callable[[Path], RecordingFile]] = {
    mcap_file.MAGIC: McapFile,
    sqlite_file.MAGIC: SqliteFile,
    ros1_file.MAGIC: Ros1File,
}
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# Ten years after 1970: computers without a clock begin there, and simulations stay there.
_CLOCK_IS_SET = 10 * 365 * 24 * 3600 * 10**9
# Raw images of a dark garage shrink to a hundredth; what shrinks to less is no recording.
_MAX_EXPANSION = 500
_PIECE_BYTES = 2**20
_SHOWN_DAMAGES = 5
_SHOWN_TOPICS = 3
# What code made of a definition raises on bytes that do not fit it, or when it cannot be made.
_MISFIT = (SerdeError, ValueError, LookupError, AssertionError, SyntaxError, OverflowError, MemoryError)

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
    """Log time of the first message, ns; where the clock was set only then, of the first one after that."""
    end: int
    """Log time of the last message, ns."""

    def __init__(self, paths: Sequence[Location]) -> None:
        if not paths:
            raise RecordingError("no recording given: the list of paths is empty")
        self.path = paths[0]
        self.notes: list[str] = []
        """What is odd about it, and how it is read nevertheless."""
        self._damage: list[str] = []
        self._counted: list[tuple[Location, set[str], int]] = []  # folder, its files, messages by its metadata
        self._unpacked: TemporaryDirectory[str] | None = None
        try:
            self._files = self._open_files([file for path in paths for file in self._listed(path)])
            self._names = self._set_topics()
            self._compare_with_metadata()
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

    @cached_property
    def _video_topics(self) -> frozenset[str]:
        return frozenset(topic.name for topic in self.topics.values() if topic.type in VIDEO_DEFINITIONS)

    @cached_property
    def _videos(self) -> RecordedVideos:
        return RecordedVideos(self._stored_messages, self.typestore)

    def messages(
        self, topics: Collection[str] | None = None, start: int | None = None, stop: int | None = None
    ) -> Iterator[RecordedMessage]:
        """Give the messages of `topics` (all by default) with start <= log_time < stop (ns) by log time.

        Memory stays flat: one chunk of each file that is being read. Raises RecordingError for an unknown topic, and
        when the storage itself fails meanwhile.
        """
        followed = self._video_topics.intersection(self.topics if topics is None else topics)
        messages = self._stored_messages(topics, start, stop)
        return self._videos.follow(messages, followed) if followed else messages

    def _stored_messages(
        self, topics: Collection[str] | None, start: int | None, stop: int | None
    ) -> Iterator[RecordedMessage]:
        wanted = set(self.topics if topics is None else topics)
        if unknown := wanted - self.topics.keys():
            raise RecordingError(f"{self.path}: no topic {sorted(unknown)}; it has {sorted(self.topics)}")
        first, last = 0 if start is None else start, FOREVER if stop is None else stop
        return self._unpacked_messages(
            in_time_order(
                Source(file.start, partial(self._messages_of, file, names, wanted, first, last))
                for file, names in zip(self._files, self._names, strict=True)
                if file.start is not None and file.end is not None and file.start < last and file.end >= first
            )
        )

    def first_messages(self, topics: Collection[str]) -> dict[str, RecordedMessage]:
        """Return the first message of each topic that has any; parts of the files with none of them are not read."""
        found: dict[str, RecordedMessage] = {}
        position: int | None = 0
        while position is not None and (awaited := set(topics) - found.keys()):
            start, position = position, None
            for message in self.messages(awaited, start):
                if message.topic in found:
                    position = message.log_time
                    break
                found[message.topic] = message
        return found

    def deserialize(self, message: RecordedMessage) -> Any:
        """Return the message as an object whose attributes are those of rclpy's class; arrays are numpy arrays.

        A packet of a video stream is returned as the `sensor_msgs/Image` that it becomes. Raises RecordingError, naming
        topic, type and time, when the type is unknown, the bytes do not fit it, or no image can be made of it.
        """
        type_ = self.topics[message.topic].type
        where = f"{self.path}: {message.topic} at {message.log_time} ns"
        if type_ not in self.typestore.fielddefs:
            raise RecordingError(f"{where}: type {type_} is not known, and the recording carries no definition of it")
        try:
            if type_ in VIDEO_DEFINITIONS:
                return self._videos.image(message, type_)
            return self.typestore.deserialize_cdr(memoryview(message.cdr), type_)
        except _MISFIT as error:
            raise RecordingError(f"{where}: {len(message.cdr)} bytes that are no {type_}: {error}") from error

    def _set_topics(self) -> list[dict[str, str]]:
        """Join the files' topics; return what each file's topics, by their names there, are called in the whole."""
        self.topics, names = joined_topics([t for file in self._files for t in file.topics.values()])
        remaining = iter(names)
        return [{name: next(remaining) for name in file.topics} for file in self._files]

    def _messages_of(
        self, file: RecordingFile, names: Mapping[str, str], wanted: Collection[str], first: int, last: int
    ) -> Iterator[RecordedMessage]:
        messages = file.messages({name for name, joined in names.items() if joined in wanted}, first, last)
        if all(name == joined for name, joined in names.items()):
            return messages
        return (message._replace(topic=names[message.topic]) for message in messages)

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
        """Return the log times between which the drive lies.

        What was recorded before the clock was set (1970, whereas the end is of our time) is not part of it.
        """
        starts = [file.start for file in self._files if file.start is not None]
        ends = [file.end for file in self._files if file.end is not None]
        if not starts:
            damage = f" ({self.damage})" if self.damage else ""
            raise RecordingError(f"{self.path}: holds no readable message{damage}")
        start, end = min(starts), max(ends)
        if start < _CLOCK_IS_SET <= end:
            self.notes.append(self._told_unset_clock())
            start = next((message.log_time for message in self.messages(start=_CLOCK_IS_SET)), start)
        return start, end

    def _told_unset_clock(self) -> str:
        early = Counter(message.topic for message in self.messages(stop=_CLOCK_IS_SET))
        topics = ", ".join(f"{topic} ({count})" for topic, count in early.most_common(_SHOWN_TOPICS))
        more = f" and {len(early) - _SHOWN_TOPICS} more topics" if len(early) > _SHOWN_TOPICS else ""
        return (
            f"{self.path}: {early.total()} messages were recorded before the clock was set, in 1970: {topics}{more}; "
            "the drive begins after them"
        )

    def _compare_with_metadata(self) -> None:
        """Report a folder whose files hold another number of messages than its metadata.yaml counts."""
        for folder, names, counted in self._counted:
            files = [file for file in self._files if str(file.path) in names]
            found = sum(topic.count for file in files for topic in file.topics.values())
            if len(files) == len(names) and found != counted and not any(file.damage for file in files):
                self._damage.append(f"{folder}: {found} messages found, metadata.yaml counts {counted}")

    def _listed(self, path: Location) -> list[Location]:
        """Return the storage files of a path: itself, or those of a folder."""
        if not path.exists():
            raise RecordingError(f"{path}: does not exist")
        if path.is_file():
            return [path]
        listing = list_folder(path)
        self._damage += listing.damage
        self.notes += listing.notes
        if listing.messages is not None:
            self._counted.append((path, {*map(str, listing.files)}, listing.messages))
        return listing.files

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
