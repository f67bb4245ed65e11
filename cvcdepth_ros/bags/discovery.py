# SPDX-License-Identifier: Apache-2.0
"""Which recordings are meant by paths, patterns, folders of recordings, and URLs."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.bags.remote import Location, RemotePath, location
from cvcdepth_ros.bags.topics import STORAGE_SUFFIXES

_METADATA = "metadata.yaml"
_SIGNS = "*?["
_NAMED = 5


def find_recordings(patterns: Sequence[str | Location]) -> list[Location]:
    """Return the recordings that are meant, each once, for `open_recording`.

    A pattern is a recording of any kind, a glob (`**` too), a folder that holds recordings at any depth, or a URL of
    these. A rosbag2 folder is one recording, and so are its files when all of them are given. They come in the order of
    the patterns, those of one pattern sorted. Raises RecordingError, naming the pattern, when it gives nothing.
    """
    if not patterns:
        raise RecordingError("no recording given")
    found = [recording for pattern in patterns for recording in _found(location(pattern))]
    return _once(_joined_by_folder(found))


def _found(pattern: Location) -> list[Location]:
    recordings: list[Location]
    if isinstance(pattern, RemotePath):
        recordings = _remote(pattern)
    elif pattern.exists() or not any(sign in str(pattern) for sign in _SIGNS):
        recordings = [*_given(pattern)]
    else:
        recordings = [*_matched(str(pattern))]
    if not recordings:
        raise RecordingError(f"{pattern}: no recording there; {', '.join(STORAGE_SUFFIXES)} files are looked for")
    return recordings


def _given(path: Path) -> Iterator[Path]:
    """Give a path that was named, whatever its suffix, or the recordings of a folder."""
    if not path.exists():
        raise RecordingError(f"{path}: does not exist")
    if path.is_dir():
        yield from _below(path)
    else:
        yield path


def _matched(pattern: str) -> Iterator[Path]:
    for match in sorted(glob.glob(pattern, recursive=True)):  # noqa: PTH207 (Path.glob takes no absolute pattern)
        if Path(match).is_dir():
            yield from _below(Path(match))
        elif _is_storage(match):
            yield Path(match)


def _below(top: Path) -> Iterator[Path]:
    """Give the recordings in a folder, in its subfolders, and behind links, which may lead in circles."""
    seen: set[Path] = set()
    for name, subfolders, files in os.walk(top, followlinks=True):
        folder = Path(name)
        if folder.resolve() in seen:
            subfolders.clear()
            continue
        seen.add(folder.resolve())
        storage = sorted(file for file in files if _is_storage(file))
        if storage and _is_rosbag2_folder(folder, files):
            subfolders.clear()
            yield folder
        else:
            subfolders.sort()
            yield from (folder / file for file in storage)


def _remote(url: RemotePath) -> list[Location]:
    """Return the recordings of a URL: what is behind it, in the folder behind it, or what it matches."""
    try:
        files = url.files()
    except OSError as error:
        raise RecordingError(f"{url}: cannot be listed: {error.strerror or error}") from error
    unreadable = [file for file in files if _is_storage(file.name) and not file.name.endswith(".mcap")]
    if unreadable:
        names = ", ".join(map(str, unreadable[:_NAMED]))
        more = f" and {len(unreadable) - _NAMED} more" if len(unreadable) > _NAMED else ""
        raise RecordingError(f"{names}{more}: only .mcap can be read through a URL, other formats cannot be sought in")
    # What was named is read whatever its suffix.
    return [file for file in files if file.name.endswith(".mcap") or file == url]


def _joined_by_folder(recordings: Sequence[Location]) -> list[Location]:
    """Put a rosbag2 folder in the place of its files where all of several are there, or where it is there itself."""
    given = set(recordings)
    folders = {recording: _folder_of(recording) for recording in recordings}
    whole = {folder for folder in set(folders.values()) if folder in given or _is_given_whole(folder, given)}
    return [folders[recording] if folders[recording] in whole else recording for recording in recordings]


def _folder_of(recording: Location) -> Location:
    if isinstance(recording, RemotePath):
        return RemotePath(str(recording).rpartition("/")[0])
    return recording.parent


def _is_given_whole(folder: Location, given: set[Location]) -> bool:
    """Say whether the folder is one recording of several files, which are all among those given."""
    content: list[Location] = [*folder.iterdir()]
    storage = [file for file in content if _is_storage(file.name)]
    names = [file.name for file in content]
    return len(storage) > 1 and given.issuperset(storage) and _is_rosbag2_folder(folder, names)


def _is_rosbag2_folder(folder: Location, files: Sequence[str]) -> bool:
    """Say whether the folder is one recording; one whose recorder died has no metadata, but files with its name."""
    return _METADATA in files or any(_is_storage(file) and file.startswith(f"{folder.name}_") for file in files)


def _is_storage(name: str) -> bool:
    return name.endswith(STORAGE_SUFFIXES) and not Path(name).name.startswith(".")


def _once(recordings: Sequence[Location]) -> list[Location]:
    """Drop what was there before, by another name too."""
    by_place: dict[Location, Location] = {}
    for recording in recordings:
        by_place.setdefault(recording.resolve() if isinstance(recording, Path) else recording, recording)
    return list(by_place.values())
