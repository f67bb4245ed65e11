# SPDX-License-Identifier: Apache-2.0
"""Results that are kept: taken up again for the very same work, and for nothing else."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from cvcdepth_core.errors import ConfigError, OutputError
from cvcdepth_ros.kept import Arrays, KeptResults, document_array, read_document

WORK: dict[str, Any] = {"version": "1", "files": [("a.mcap", 12, 34)], "settings": {"tolerance": 0.1, "rig": None}}


class Result(NamedTuple):
    """Something that took long."""

    numbers: list[float]
    reasons: list[str]


def to_arrays(result: Result) -> Arrays:
    return {"numbers": np.array(result.numbers), "reasons": document_array(result.reasons)}


def from_arrays(arrays: Arrays) -> Result:
    if "numbers" not in arrays:
        raise ConfigError("no result")
    return Result(arrays["numbers"].tolist(), read_document(arrays["reasons"]))


DONE = Result([0.1, float("inf")], ["größer"])


@pytest.fixture
def kept(tmp_path: Path) -> KeptResults[Result]:
    return KeptResults(tmp_path / "folder", to_arrays, from_arrays)


def test_a_result_is_found_again_by_the_very_same_work(kept: KeptResults[Result]):
    assert kept.load("drive", WORK) is None
    kept.save("drive", WORK, DONE)
    assert kept.load("drive", WORK) == DONE
    assert kept.load("drive", dict(reversed(WORK.items()))) == DONE


@pytest.mark.parametrize(
    "other",
    [{"version": "2"}, {"files": [("a.mcap", 12, 35)]}, {"settings": {"tolerance": 0.1, "rig": {}}}, {"more": None}],
)
def test_a_result_of_other_work_is_not_taken(kept: KeptResults[Result], other: dict[str, Any]):
    kept.save("drive", WORK, DONE)
    assert kept.load("drive", WORK | other) is None


def test_work_that_is_done_is_not_done_again(kept: KeptResults[Result]):
    done = []

    def make() -> Result:
        done.append(1)
        return DONE

    assert [kept.load_or_make("drive", WORK, make) for _ in range(3)] == [DONE] * 3
    assert len(done) == 1
    kept.load_or_make("drive", WORK | {"version": "2"}, make)
    assert len(done) == 2


def test_names_that_end_alike_are_kept_apart_and_can_be_recognised(kept: KeptResults[Result], tmp_path: Path):
    names = ("/monday/drive.mcap", "/tuesday/drive.mcap", "s3://fleet/drive.mcap/", "ä" * 255)
    for number, name in enumerate(names):
        kept.save(name, WORK, Result([number], []))
    assert [kept.load(name, WORK) for name in names] == [Result([number], []) for number in range(len(names))]
    files = [path.name for path in (tmp_path / "folder").iterdir()]
    assert sum(name.startswith("drive.mcap-") for name in files) == 3


def cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def flipped(content: bytes) -> bytes:
    middle = content.index(b"numbers.npy") + 60
    return content[:middle] + bytes(byte ^ 0xFF for byte in content[middle : middle + 20]) + content[middle + 20 :]


@pytest.mark.parametrize("damage", [cut, flipped, lambda _: b"", lambda _: b"[1, 2]"])
def test_a_damaged_file_is_as_good_as_none(kept: KeptResults[Result], tmp_path: Path, damage: Callable[[bytes], bytes]):
    kept.save("drive", WORK, DONE)
    (file,) = (tmp_path / "folder").iterdir()
    file.write_bytes(damage(file.read_bytes()))
    assert kept.load("drive", WORK) is None
    assert kept.load_or_make("drive", WORK, lambda: DONE) == DONE == kept.load("drive", WORK)


def test_the_file_of_another_program_is_as_good_as_none(kept: KeptResults[Result], tmp_path: Path):
    kept.save("drive", WORK, DONE)
    (file,) = (tmp_path / "folder").iterdir()
    with file.open("wb") as stream:
        np.savez(stream, work=document_array(WORK), other=np.zeros(3))
    assert kept.load("drive", WORK) is None


def test_a_result_that_cannot_be_kept_is_named(kept: KeptResults[Result], tmp_path: Path, monkeypatch):
    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OutputError, match=r"drive-\w+.npz: cannot be written: No space left on device"):
        kept.save("drive", WORK, DONE)
    assert list((tmp_path / "folder").iterdir()) == []
