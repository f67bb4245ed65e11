# SPDX-License-Identifier: Apache-2.0
"""Fast DDS's shared memory that killed processes have left behind: some 70 MB a node, until the machine has none."""

import fcntl
import os
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
# A segment or a port, with its locks and semaphore.
_FILE = re.compile(r"(?:sem\.)?(fastrtps_(?:port)?[0-9a-f]+)(?:_el|_sl|_mutex)?")


def remove_what_nobody_uses() -> list[Path]:
    """Remove this user's segments that no process maps, has open or has locked; return their files."""
    removed = []
    groups = _own_files()  # listed first: what appears after it is not looked at
    used = {_segment(path) for path in _used_files()}
    for segment, paths in groups.items():
        if segment not in used and not any(map(_is_locked, paths)):
            removed += paths
            for path in paths:
                path.unlink(missing_ok=True)
    return removed


def mapped_by(pid: int) -> set[Path]:
    """Return the files of Fast DDS that a process maps."""
    try:
        lines = Path(f"/proc/{pid}/maps").read_text(errors="replace").splitlines()
    except OSError:  # it has ended, or is somebody else's
        return set()
    return {path for path in map(Path, (line.split(None, 5)[-1] for line in lines)) if _is_of_dds(path)}


def _own_files() -> dict[str, list[Path]]:
    """Return this user's files by segment."""
    groups = defaultdict(list)
    for path in SHARED_MEMORY.iterdir() if SHARED_MEMORY.is_dir() else ():
        if _is_of_dds(path) and path.exists() and path.stat().st_uid == os.getuid():
            groups[_segment(path)].append(path)
    return groups


def _used_files() -> Iterator[Path]:
    for process in Path("/proc").glob("[0-9]*"):
        yield from _opened_by(process)  # before what it maps: a file is opened, mapped, then closed
        yield from mapped_by(int(process.name))


def _opened_by(process: Path) -> Iterator[Path]:
    try:
        descriptors = list(process.joinpath("fd").iterdir())
    except OSError:
        return
    for descriptor in descriptors:
        try:
            path = descriptor.readlink()
        except OSError:  # closed meanwhile
            continue
        if _is_of_dds(path):
            yield path


def _is_of_dds(path: Path) -> bool:
    return path.parent == SHARED_MEMORY and _FILE.fullmatch(path.name) is not None


def _segment(path: Path) -> str:
    match = _FILE.fullmatch(path.name)
    assert match is not None
    return match[1]


def _is_locked(path: Path) -> bool:
    """Whether somebody holds the file's lock, maybe in a container that shares the memory and not the processes."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False
