# SPDX-License-Identifier: Apache-2.0
"""Reading of one .db3 file (rosbag2's sqlite3 storage), also with the write-ahead log that a crash leaves beside it."""

import sqlite3
import sys
from collections.abc import Collection, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from urllib.parse import quote

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags.definitions import normal_type_name
from cvcdepth_ros.bags.topics import (
    MAX_BLOCK_BYTES,
    RecordedMessage,
    RecordingFile,
    Topic,
    error_text,
    joined_topics,
    recorded_qos,
)

MAGIC = b"SQLite format 3\0"
# What sqlite3 raises on damaged bytes, also for an error whose text is not UTF-8 and for a length beyond all memory.
_DAMAGE = (sqlite3.Error, UnicodeDecodeError, OverflowError, MemoryError)
# The message, or its length where that is beyond measure, which SQLite knows without reading it.
_DATA = "CASE WHEN typeof(data) != 'blob' THEN NULL WHEN length(data) > ? THEN length(data) ELSE data END"
_TABLES = ("topics", "messages", "message_definitions")


class SqliteFile(RecordingFile):
    """One .db3 file, see `RecordingFile`."""

    path: Path

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.size = path.stat().st_size
        try:
            with closing(self._connect()) as database:
                _check_tables(database)
                self._names = self._readable_names(database)
                self._set_topics(database)
                self.start, self.end = database.execute(
                    "SELECT MIN(timestamp), MAX(timestamp) FROM messages"
                ).fetchone()
        except _DAMAGE as error:
            raise RecordingError(f"{path}: not readable as a rosbag2 database: {error_text(error)}") from error
        if not isinstance(self.start, int | None) or not isinstance(self.end, int | None):
            raise RecordingError(f"{path}: timestamps from {self.start!r:.40} to {self.end!r:.40} are not integers")

    def messages(self, topics: Collection[str], start: int, stop: int) -> Iterator[RecordedMessage]:
        """Give the messages of `topics` with start <= log_time < stop, in time order."""
        wanted = {id_: name for id_, name in self._names.items() if name in topics}
        query = (
            f"SELECT topic_id, timestamp, {_DATA} FROM messages WHERE timestamp >= ? AND timestamp < ? "
            f"AND topic_id IN ({', '.join('?' * len(wanted))}) ORDER BY timestamp, id"
        )
        count = 0
        with closing(self._connect()) as database:
            try:
                for id_, log_time, cdr in database.execute(query, (MAX_BLOCK_BYTES, start, stop, *wanted)):
                    if isinstance(log_time, int) and isinstance(cdr, bytes):
                        yield RecordedMessage(wanted[id_], log_time, cdr)
                        count += 1
                    elif isinstance(cdr, int):
                        size = f"{cdr} bytes; at most {MAX_BLOCK_BYTES} are read at once"
                        self._report(f"{wanted[id_]} at {log_time} ns skipped: {size}")
                    else:
                        self._report(f"{wanted[id_]}: a row with no integer as time or no bytes as message was skipped")
            except _DAMAGE as error:
                self._report(f"reading stopped after {count} messages", error)

    def _connect(self) -> sqlite3.Connection:
        """Open without changing or creating any file, so that recordings on read-only storage are read too.

        `immutable` would not look at a write-ahead log. To read one, SQLite wants locks and an index file beside it,
        unless the database is taken for exclusive use with locking switched off.
        """
        log = self.path.with_name(self.path.name + "-wal")
        leftover = log.exists() and log.stat().st_size > 0
        option = "vfs=unix-none" if leftover else "immutable=1"
        database = sqlite3.connect(f"file:{quote(str(self.path.resolve()))}?mode=ro&{option}", uri=True)
        if leftover:
            database.execute("PRAGMA locking_mode=EXCLUSIVE")
        database.execute("PRAGMA trusted_schema=OFF")
        # Comments of definitions are of any character set.
        database.text_factory = partial(str, encoding="utf-8", errors="replace")
        if sys.version_info >= (3, 11):  # for names and definitions; Python 3.10 leaves SQLite's own limit, 1 GB
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_BLOCK_BYTES)
        return database

    def _readable_names(self, database: sqlite3.Connection) -> dict[int, str]:
        names = {}
        for id_, name, encoding in database.execute("SELECT id, name, serialization_format FROM topics ORDER BY id"):
            if not isinstance(name, str):
                self._report(f"left out topic {id_}: its name is {name!r:.40}")
            elif encoding == "cdr":
                names[id_] = name
            else:
                self._report(f"left out {name}: serialization format {encoding!r} is not cdr")
        return names

    def _set_topics(self, database: sqlite3.Connection) -> None:
        found = dict(self._read_topics(database))
        self.topics, names = joined_topics([*found.values()])
        self._names = dict(zip(found, names, strict=True))

    def _read_topics(self, database: sqlite3.Connection) -> Iterator[tuple[int, Topic]]:
        counts = dict(database.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"))
        definitions = _definitions(database)
        qos = "offered_qos_profiles" if "offered_qos_profiles" in _columns(database, "topics") else "NULL"
        for id_, type_, profiles in database.execute(f"SELECT id, type, {qos} FROM topics ORDER BY id"):
            if id_ in self._names and isinstance(type_, str):
                qos_text = profiles if isinstance(profiles, str) else None
                type_name, definition = normal_type_name(type_), definitions.get(type_)
                yield id_, Topic(self._names[id_], type_name, counts.get(id_, 0), recorded_qos(qos_text), definition)


def _check_tables(database: sqlite3.Connection) -> None:
    """Refuse what only looks like a table: a view, a virtual table or computed columns may go on for ever when read."""
    rows = database.execute("SELECT name, type FROM sqlite_master WHERE type IN ('table', 'view')").fetchall()
    kinds = {name: kind for name, kind in rows if name in _TABLES}
    for name, kind in kinds.items():
        computed = [row[1] for row in database.execute(f"PRAGMA table_xinfo({name})") if row[6]]
        if kind != "table" or computed:
            raise sqlite3.DatabaseError(f"{name} is no plain table")


def _definitions(database: sqlite3.Connection) -> dict[str, str]:
    """Return the definitions by type; recordings older than Iron have none."""
    if not _columns(database, "message_definitions"):
        return {}
    rows = database.execute("SELECT topic_type, encoded_message_definition FROM message_definitions")
    return {type_: definition for type_, definition in rows if definition and isinstance(definition, str)}


def _columns(database: sqlite3.Connection, table: str) -> set[str]:
    return {row[1] for row in database.execute(f"PRAGMA table_info({table})")}
