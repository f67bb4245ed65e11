# SPDX-License-Identifier: Apache-2.0
"""Which files of a rosbag2 folder are the recording: those that its metadata.yaml lists, as far as they are there."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any

import yaml

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.files import load_yaml
from cvcdepth_ros.bags.remote import Location
from cvcdepth_ros.bags.topics import STORAGE_SUFFIXES

_METADATA = "metadata.yaml"
_ZSTD_SUFFIX = ".zstd"
_SHOWN_FILES = 8


@dataclass
class FolderListing:
    """The storage files of a folder."""

    files: list[Location]
    """Those to read, each once."""
    messages: int | None = None
    """How many the metadata counts; None where it does not say, or not all that it lists is there."""
    damage: list[str] = field(default_factory=list)
    """What is missing or left out."""
    notes: list[str] = field(default_factory=list)
    """What is read though the metadata says otherwise."""


def list_folder(folder: Location) -> FolderListing:
    """List the storage files of a folder; RecordingError, naming what is there, when there are none."""
    present = sorted(file for file in folder.iterdir() if file.name.endswith(STORAGE_SUFFIXES))
    present = [file for file in present if not file.name.startswith(".")]
    listing = FolderListing(present)
    information = _metadata(folder, listing.damage)
    if information is not None:
        _match(folder, _listed_names(folder, information, listing), present, listing)
    if not listing.files:
        content = ", ".join(sorted(file.name for file in folder.iterdir())[:_SHOWN_FILES]) or "nothing"
        raise RecordingError(f"{folder}: no recording in this folder; found {content}")
    return listing


def _metadata(folder: Location, damage: list[str]) -> dict[str, Any] | None:
    """Return what metadata.yaml says, None when the recorder died before it wrote one or it cannot be read."""
    metadata = folder / _METADATA
    if not metadata.exists():
        damage.append(f"{folder}: no metadata.yaml, reading all files of the folder")
        return None
    try:
        information: dict[str, Any] = load_yaml(metadata.read_text())["rosbag2_bagfile_information"]
        return information if information["relative_file_paths"] else None
    except (yaml.YAMLError, ValueError, LookupError, TypeError) as error:
        damage.append(f"{metadata}: unreadable ({type(error).__name__}), reading all files of the folder")
        return None


def _listed_names(folder: Location, information: dict[str, Any], listing: FolderListing) -> list[str]:
    names = [PurePath(str(name)).name for name in information["relative_file_paths"]]
    distinct = list(dict.fromkeys(names))
    if len(distinct) < len(names):
        twice = ", ".join(sorted({name for name in names if names.count(name) > 1}))
        listing.notes.append(f"{folder}: metadata.yaml lists {twice} more than once; it is read once")
    count = information.get("message_count")
    listing.messages = count if isinstance(count, int) and len(distinct) == len(names) else None
    return distinct


def _match(folder: Location, names: Sequence[str], present: Sequence[Location], listing: FolderListing) -> None:
    """Put what is there in the place of what is listed: packed, unpacked or renamed since."""
    by_name = {file.name: file for file in present}
    # What was named is read whatever its suffix.
    others = {name: folder / name for name in names if name not in by_name}
    by_name.update({name: file for name, file in others.items() if file.exists()})
    found = {name: by_name.get(name) or _repacked(name, by_name) for name in names}
    missing = [name for name, file in found.items() if file is None]
    read = [file for file in found.values() if file is not None]
    unlisted = [file for file in present if not _is_known(file.name, names)]
    if missing and len(missing) == len(unlisted):
        told = (
            f"metadata.yaml lists {', '.join(missing)}, not there; {', '.join(file.name for file in unlisted)} is read"
        )
        listing.notes.append(f"{folder}: {told} instead")
        listing.files = [*read, *unlisted]
        return
    listing.files = read
    listing.messages = None if missing else listing.messages
    if unlisted:
        left_out = ", ".join(file.name for file in unlisted)
        listing.damage.append(f"{folder}: metadata.yaml does not list {left_out}, not read")
    if missing:
        listing.damage.append(f"{folder}: metadata.yaml lists {', '.join(missing)}, not found")


def _repacked(name: str, by_name: dict[str, Location]) -> Location | None:
    """Return the file that was packed or unpacked since."""
    return by_name.get(name.removesuffix(_ZSTD_SUFFIX)) or by_name.get(name + _ZSTD_SUFFIX)


def _is_known(name: str, listed: Sequence[str]) -> bool:
    """Say whether a file is listed; the unpacked one that `ros2 bag` leaves beside a packed one is."""
    return name.removesuffix(_ZSTD_SUFFIX) in {other.removesuffix(_ZSTD_SUFFIX) for other in listed}
