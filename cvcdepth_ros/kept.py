# SPDX-License-Identifier: Apache-2.0
"""Results of long work that are kept on the disk, so that the same command again does not do the work again."""

from __future__ import annotations

import hashlib
import io
import json
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.files import write_atomically

T = TypeVar("T")

Arrays = Mapping[str, NDArray[Any]]
"""A result as arrays that numpy stores without pickling; none is called `work`."""

Work = Mapping[str, Any]
"""Everything that a result depends on, with JSON's types: versions, settings, `file_identities` of what is read."""

_WORK = "work"
_LONGEST_NAME = 60  # characters: with four bytes each, a file may still be called so
_DAMAGE = (OSError, EOFError, ValueError, KeyError, TypeError, BadZipFile, zlib.error, CvcDepthError)


class KeptResults(Generic[T]):
    """A folder with one file for each result; a result is found again by the very same work only."""

    def __init__(self, folder: Path, to_arrays: Callable[[T], Arrays], from_arrays: Callable[[Arrays], T]) -> None:
        """Keep results in `folder`, which is made when there is one.

        `from_arrays` undoes `to_arrays`. Of arrays that are no result it raises KeyError, TypeError, ValueError or an
        error of the family.
        """
        self._folder = folder
        self._to_arrays = to_arrays
        self._from_arrays = from_arrays

    def load(self, name: str, work: Work) -> T | None:
        """Return the result that is kept by this name; None where there is none, of other work, or a damaged one."""
        try:
            with np.load(self._path(name), allow_pickle=False) as arrays:
                return self._from_arrays(arrays) if read_document(arrays[_WORK]) == _as_read(work) else None
        except _DAMAGE:
            return None  # not there, or cut by whatever ended the former call: then the work is done again

    def save(self, name: str, work: Work, result: T) -> None:
        """Keep a result in the place of a former one; the file appears whole or not at all.

        Raises OutputError when it cannot be written.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()
        arrays: dict[str, Any] = {_WORK: document_array(work), **self._to_arrays(result)}
        np.savez_compressed(content, **arrays)
        write_atomically(self._path(name), content.getvalue())

    def load_or_make(self, name: str, work: Work, make: Callable[[], T]) -> T:
        """Return the result that is kept, else the one that `make` returns, which is kept from then on."""
        found = self.load(name, work)
        if found is None:
            found = make()
            self.save(name, work, found)
        return found

    def _path(self, name: str) -> Path:
        """Return the file for a name, which may be a path or a URL: its last part, to be recognised, and a hash."""
        last = name.rstrip("/").rpartition("/")[2][:_LONGEST_NAME]
        return self._folder / f"{last}-{hashlib.sha256(name.encode()).hexdigest()[:8]}.npz"


def document_array(content: Any) -> NDArray[np.uint8]:
    """Return a document of JSON's types as an array of bytes."""
    return np.frombuffer(json.dumps(content).encode(), dtype=np.uint8)


def read_document(array: NDArray[Any]) -> Any:
    """Undo `document_array`; ValueError where the bytes are no JSON."""
    return json.loads(array.tobytes())


def _as_read(work: Work) -> Any:
    """Return it as it is when it has been written and read: tuples are lists then."""
    return json.loads(json.dumps(work))
