# SPDX-License-Identifier: Apache-2.0
"""A run whose network is told its rig looks for the ground once, keeps what it found, and tells it."""

from pathlib import Path

import pytest
from recordings import SAMPLE

from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.finetuning import preparation
from cvcdepth_ros.finetuning.preparation import Prepared, Source, prepare
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.settings import MatchingSettings

CHECKS = ("overlaps", "ego masks", "LiDAR", "motion", "encodings", "brightness", "places", "lenses", "ground")
"""That cost time, and tell nothing of what is tested here."""


def prepared(run: Path, *, needs_ground: bool, layout: RigLayout | None = None) -> Prepared:
    source = Source([SAMPLE], layout, MatchingSettings(), CHECKS, with_masks=False, needs_ground=needs_ground)
    return prepare(source, run)


def told(found: Prepared) -> list[str]:
    return [warning for warning in found.warnings if "ground at" in warning]


def test_the_ground_is_found_kept_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    first = prepared(tmp_path, needs_ground=True)
    assert first.indexes[0].layout.ground_height == pytest.approx(-0.3, abs=0.03)
    assert len(told(first)) == 1
    assert "base_link: from LiDAR" in told(first)[0]
    monkeypatch.setattr(preparation, "recorded_ground", None)  # it is not looked for again
    again = prepared(tmp_path, needs_ground=True)
    assert (again.indexes[0].layout, told(again)) == (first.indexes[0].layout, told(first))


def test_it_is_not_looked_for_where_it_is_stated_or_of_no_use(tmp_path: Path):
    unused = prepared(tmp_path / "unused", needs_ground=False)
    assert (unused.indexes[0].layout.ground_height, told(unused)) == (None, [])
    with open_recording(SAMPLE) as recording:
        layout = RecordedRig.from_recording(recording).layout.model_copy(update={"ground_height": -0.5})
    stated = prepared(tmp_path / "stated", needs_ground=True, layout=layout)
    assert (stated.indexes[0].layout.ground_height, told(stated)) == (-0.5, [])
