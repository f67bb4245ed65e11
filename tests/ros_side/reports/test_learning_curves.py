# SPDX-License-Identifier: Apache-2.0
"""The learning curves of a run: whatever the log has is drawn."""

import json
from pathlib import Path

import pytest

pytest.importorskip("matplotlib", reason="no packages for the page in this environment")

from cvcdepth_ros.reports.learning_curves import RunLog, held_out_curves, loss_curves


def log_with(terms: int) -> RunLog:
    steps = [{"step": n, "loss": 1 / n, "terms": {f"term_{i}": (i + 1) / n for i in range(terms)}} for n in (1, 2, 3)]
    return RunLog(steps, [])


@pytest.mark.parametrize("terms", [1, 7, 8, 20])
def test_every_term_of_the_loss_is_drawn_in_a_colour_of_its_own(terms: int):
    _, axes = loss_curves(log_with(terms)).axes
    curves = {line.get_label(): line.get_color() for line in axes.get_lines() if line.get_label()[0] != "_"}
    assert list(curves) == [f"term_{i}" for i in range(terms)]
    assert len(set(curves.values())) == terms
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == list(curves)


def test_a_term_that_came_later_is_drawn_from_there(tmp_path: Path):
    entries = [
        {"step": 1, "loss": 0.5, "terms": {"temporal": 0.4}},
        {"step": 2, "loss": 0.4, "terms": {"temporal": 0.3, "spatial": 0.2}},
        {"step": 2, "validation": {"score": 0.3, "spatial": 0.1}},
    ]
    (tmp_path / "log.jsonl").write_text("".join(f"{json.dumps(entry)}\n" for entry in entries))
    log = RunLog.read(tmp_path / "log.jsonl")
    _, axes = loss_curves(log).axes
    steps = {line.get_label(): list(line.get_xdata()) for line in axes.get_lines() if line.get_label()[0] != "_"}
    assert steps == {"temporal": [1, 2], "spatial": [2]}
    score, others = held_out_curves(log).axes
    assert [line.get_label() for line in (*score.get_lines(), *others.get_lines())] == ["score", "spatial"]


def test_a_run_without_a_log_has_no_entries(tmp_path: Path):
    assert RunLog.read(tmp_path / "log.jsonl") == RunLog([], [])
