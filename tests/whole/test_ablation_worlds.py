# SPDX-License-Identifier: Apache-2.0
"""`tools/ablation_worlds.py` with a budget of seconds: it runs through, goes on where it stood, and tells intervals."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from repository import load_tool
from simple_worlds import street_spec

from cvcdepth_core.training.config import load_training_config

pytest.importorskip("embreex", reason="worlds need embreex")
load_tool("ablation")  # which the other imports, as a script finds it beside itself
TOOL = load_tool("ablation_worlds")

TINY = """
base: {shipped}
depth: {{height: 64, width: 64, focal_scale: 32.0}}
optimizer: {{epochs: 1, decay_after_epochs: 1}}
"""


@pytest.fixture(scope="module")
def arguments(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("ablation")
    (folder / "tiny.yaml").write_text(TINY.format(shipped=TOOL.SHIPPED))
    options = ["--drives", "1", "--sets", "3", "--held-out", "2", "--seeds", "1", "--rows"]
    rows = [TOOL.REFERENCE, "+ DDCL"]
    return ["-o", str(folder / "out"), "--config", str(folder / "tiny.yaml"), *options, *rows]


@pytest.fixture(scope="module")
def small_worlds() -> Iterator[None]:
    """Drives on a street that is built in a moment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TOOL, "random_world", lambda seed, kind, seconds: street_spec(seed=seed))
        yield


@pytest.fixture(scope="module")
def finished(arguments: list[str], small_worlds: None) -> Path:
    TOOL.main(arguments)
    return Path(arguments[1])


def test_it_trains_every_row_scores_it_by_dense_truth_and_writes_the_table(finished: Path):
    lines = (finished / "table.md").read_text().splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| front pose (d)", "| + DDCL"]
    assert [line.rsplit(" | ")[-1] for line in lines[2:]] == ["0.229 |", "0.215 |"]
    assert lines[3].count(" to ") == 3  # an interval for all, for the overlaps, and median-scaled
    (scores, *_), *_ = TOOL.read_scores(list(TOOL.planned_runs(TOOL.parse_options(options_of(finished))))).values()
    assert [table.recording for table in scores.images] == ["drive_000", "drive_001"]
    assert scores.summary().mean["overlap"].truth > 500


def options_of(finished: Path) -> list[str]:
    return ["-o", str(finished), "--seeds", "1", "--rows", TOOL.REFERENCE, "+ DDCL"]


def test_what_is_finished_is_not_done_again_and_what_is_missing_is(arguments: list[str], finished: Path):
    checkpoints = {path: path.stat().st_mtime_ns for path in finished.glob("runs/*/last.safetensors")}
    assert len(checkpoints) == 2
    gone = next(finished.glob("runs/ddcl*/scores.json"))
    before = json.loads(gone.read_text())
    gone.unlink()
    TOOL.main([*arguments, "--only-table"])
    assert "DDCL" not in (finished / "table.md").read_text()
    TOOL.main(arguments)
    assert json.loads(gone.read_text()) == before
    assert all(path.stat().st_mtime_ns == time for path, time in checkpoints.items())


def test_rows_differ_in_what_the_papers_files_say_and_in_nothing_else(tmp_path: Path):
    runs = list(TOOL.planned_runs(TOOL.parse_options(["-o", str(tmp_path), "--seeds", "2"])))
    assert len(runs) == 2 * len(TOOL.ROWS) == len({run.folder for run in runs})
    for run in runs:
        row = load_training_config(TOOL.PUBLISHED / TOOL.ROWS[run.variant])
        objective = row.objective.model_copy(update=TOOL.CHANGES.get(run.variant, {}))
        assert (run.config.objective, run.config.augmentation) == (objective, row.augmentation)
        assert run.config.pose.method == row.pose.method
    differing = {"objective", "augmentation", "pose", "seed"}
    assert len({run.config.model_dump_json(exclude=differing) for run in runs}) == 1


def test_every_row_of_the_papers_files_is_there():
    assert {Path(file).name for file in TOOL.ROWS.values()} == {path.name for path in TOOL.PUBLISHED.glob("*.yaml")} | {
        "ddad_r18.yaml"
    }


def test_seeds_are_averaged_before_drives_are_compared(finished: Path):
    assert np.isnan(TOOL.nan_mean(np.array([[np.nan], [np.nan]])))
    assert TOOL.nan_mean(np.array([[1.0, np.nan], [2.0, 5.0]])) == pytest.approx([1.5, 5.0])
