# SPDX-License-Identifier: Apache-2.0
"""`tools/motion_trial.py`: which runs it plans, and the table that it makes of their scores."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from repository import load_tool

from cvcdepth_core.training.config import load_training_config

TOOL = load_tool("motion_trial")


def metrics(abs_rel: float, ratio: float | None) -> dict[str, Any]:
    group = {"abs_rel": abs_rel, "truth_points": 10}
    far = {"20-40": {"abs_rel": 0.2, "truth_points": 300}, "40-80": {"abs_rel": 0.6, "truth_points": 100}}
    return {
        "scores": {"image": {"metric": {"mean": {"all": group, **far}}}},
        "scale_ratio": {"image": {"front": 0.5, "back": 2.0}},
        "pose_network": {"ratio": ratio, "degrees": 0.1},
    }


def options(folder: Path, other: Path | None = None) -> SimpleNamespace:
    return SimpleNamespace(rig=Path("rig.yaml"), other_rig=other, epochs=3, output=folder, config=TOOL.SHIPPED)


def test_far_points_count_by_their_number_and_seeds_are_summed_up():
    rows = [TOOL.row(metrics(value, 0.5)) for value in (0.2, 0.3)]
    assert rows[0].far == pytest.approx(0.3)
    assert rows[0].scale == pytest.approx(1)
    table = TOOL.table({"start": rows[:1], "recorded motion": rows})
    assert "| start | 0.200 | 0.300 | 1.000 | 0.500 | 0.100 |" in table
    assert "| recorded motion | 0.250 ± 0.071 |" in table


def test_every_way_has_as_many_steps_and_differs_in_what_its_name_says(tmp_path):
    arms = list(TOOL.planned_arms(options(tmp_path, Path("other.yaml"))))
    assert [arm.rig.name for arm in arms] == ["rig.yaml", "rig.yaml", "other.yaml"]
    found = []
    for arm in arms:
        path = tmp_path / f"{arm.name}.yaml"
        path.write_text(yaml.safe_dump(TOOL.training_file(options(tmp_path), arm, seed=1)))
        found.append(load_training_config(path))
    assert [config.recordings.motion for config in found] == ["network", "recorded", "recorded"]
    same = {json.dumps(config.model_copy(update={"recordings": None}).model_dump(mode="json")) for config in found}
    assert len(same) == 1
    assert found[0].optimizer.epochs == found[0].validate_every == 3
