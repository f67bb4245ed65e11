# SPDX-License-Identifier: Apache-2.0
"""Every input that fuzzing began with or stumbled over is met without error, within a second of CPU time."""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from repository import ROOT

FUZZ = ROOT / "fuzz"
sys.path.insert(0, str(FUZZ))

from targets import TARGETS  # noqa: E402

CORPUS = sorted(path for path in (FUZZ / "corpus").glob("*/*"))


def _name(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"


@pytest.mark.parametrize("path", CORPUS, ids=_name)
def test_an_input_of_the_corpus_is_met_without_error(path: Path):
    target: Callable[[bytes], None] = TARGETS[path.parent.name]
    content = path.read_bytes()
    target(content)
    begin = time.process_time()
    target(content)
    assert time.process_time() - begin < 1.0


def test_the_corpus_is_small_and_every_target_has_one():
    assert sum(path.stat().st_size for path in CORPUS) < 2**20
    assert {path.parent.name for path in CORPUS} == TARGETS.keys()
