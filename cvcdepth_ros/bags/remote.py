# SPDX-License-Identifier: Apache-2.0
"""Files behind a URL (s3://bucket/drive.mcap), read by seeking through fsspec, which is imported only for them."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from functools import total_ordering
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, cast
from urllib.parse import urlsplit

from cvcdepth_core.errors import ConfigError

# Fetched beyond each chunk, so that the next one's header is there already: one request for each chunk, little waste.
_READ_AHEAD = 512 * 1024
_LOCAL = "file://"


@total_ordering
class RemotePath:
    """A file or folder behind a URL; it offers as much of `Path` as the reader of recordings needs.

    All methods raise ConfigError when fsspec, or what it needs for this kind of URL, is not installed, and OSError,
    whatever the storage's own library raises, when the storage cannot be reached.
    """

    def __init__(self, url: str) -> None:
        self._url = url.rstrip("/")

    def __str__(self) -> str:
        return self._url

    def __repr__(self) -> str:
        return f"RemotePath({self._url!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RemotePath) and self._url == other._url

    def __lt__(self, other: RemotePath) -> bool:
        return self._url < other._url

    def __hash__(self) -> int:
        return hash(self._url)

    def __truediv__(self, name: str) -> RemotePath:
        return RemotePath(f"{self._url}/{name}")

    @property
    def name(self) -> str:
        """The last part of the path; a signed URL's query is not part of it."""
        return PurePosixPath(urlsplit(self._url).path).name

    def exists(self) -> bool:
        """Say whether there is a file or folder."""
        with self._storage() as (storage, path):
            return bool(storage.exists(path))

    def is_file(self) -> bool:
        """Say whether there is a file."""
        with self._storage() as (storage, path):
            return bool(storage.isfile(path))

    def iterdir(self) -> list[RemotePath]:
        """Return what is directly in this folder."""
        with self._storage() as (storage, path):
            return [self._sibling(storage, found) for found in storage.ls(path, detail=False) if found != path]

    def files(self) -> list[RemotePath]:
        """Return the files that the URL's pattern matches, those below it when it is a folder, or the file itself."""
        with self._storage() as (storage, path):
            matches = storage.glob(path) if any(sign in path for sign in "*[") else [path]
            return sorted(self._sibling(storage, file) for match in matches for file in storage.find(match))

    def version(self) -> list[str | int]:
        """Return the file's size and what its storage tells of its content or the time of its last change."""
        with self._storage() as (storage, path):
            about = storage.info(path)
            tags = (about[key] for key in ("ETag", "etag", "mtime", "LastModified", "created") if about.get(key))
            return [int(about["size"] or 0), str(next(tags, ""))]

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open the file for reading bytes at any place; only what is read, and a little beyond, is fetched."""
        if mode != "rb":
            raise ValueError(f"{self}: mode is {mode!r}, only 'rb' is offered")
        with self._storage() as (storage, path):
            file = storage.open(path, "rb", block_size=_READ_AHEAD, cache_type="readahead")
            return cast(BinaryIO, _RemoteStream(self, file))

    def read_text(self) -> str:
        """Return the whole of a text file."""
        with self.open() as stream:
            return stream.read().decode()

    def _sibling(self, storage: Any, path: str) -> RemotePath:
        return RemotePath(str(storage.unstrip_protocol(path)))

    @contextmanager
    def _storage(self) -> Iterator[tuple[Any, str]]:
        """Give fsspec's file system and the path in it."""
        with _errors_of(self):
            from fsspec.core import url_to_fs

            storage, path = url_to_fs(self._url)
            yield storage, path


class _RemoteStream(io.BufferedIOBase):
    """A remote file whose failures are OSErrors: the readers take others for damage of the recording."""

    def __init__(self, path: RemotePath, file: Any) -> None:
        self._path, self._file = path, file

    def read(self, size: int | None = -1, /) -> bytes:
        with _errors_of(self._path):
            return bytes(self._file.read(-1 if size is None else size))

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        return int(self._file.seek(offset, whence))

    def tell(self) -> int:
        return int(self._file.tell())

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def close(self) -> None:
        self._file.close()
        super().close()


Location = Path | RemotePath


def location(path: str | Location) -> Location:
    """Return where a path or URL points to; a file:// URL is a path."""
    if not isinstance(path, str):
        return path
    if path.startswith(_LOCAL):
        return Path(path.removeprefix(_LOCAL))
    return RemotePath(path) if "://" in path else Path(path)


def file_identities(path: str | Location) -> list[list[str | int]]:
    """Tell the versions of a file, or of all files of a folder: name, size and time of change (ns).

    Of a URL it is what the storage tells instead (S3: the ETag). Raises OSError when it cannot be reached.
    """
    place = location(path)
    if isinstance(place, RemotePath):
        return [[str(file), *file.version()] for file in place.files()]
    files = sorted(file for file in place.rglob("*") if file.is_file()) if place.is_dir() else [place]
    statuses = [(file, file.stat()) for file in files]
    return [[str(file), status.st_size, status.st_mtime_ns] for file, status in statuses]


@contextmanager
def _errors_of(path: RemotePath) -> Iterator[None]:
    try:
        yield
    except OSError:
        raise
    except ImportError as error:
        raise ConfigError(f"{path}: {error}; `pip install 'cvcdepth_ros[s3]'` brings what s3:// URLs need") from error
    # Each storage's library has exceptions of its own, without a common parent.
    except Exception as error:
        raise OSError(f"{type(error).__name__}: {error}") from error
