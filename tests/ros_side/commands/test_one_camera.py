# SPDX-License-Identifier: Apache-2.0
"""One camera is enough for depth: every command but `finetune` takes a recording of one."""

import json
from pathlib import Path

import pytest
import recordings
from recordings import CAMERAS

from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_ros.bag_replay import main

SMALL = ("--untrained", "--height", "64", "--width", "96")


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's first two sets with its front camera only."""
    others = [f"/camera/{name}/" for name in CAMERAS if name != "front"]
    entries = recordings.without(recordings.sample_entries(2), *others)
    return recordings.write_rosbag2(tmp_path_factory.mktemp("alone") / "alone", entries)


def test_check_warns_that_scale_cannot_be_learned_and_finds_nothing_wrong(alone: Path, capsys):
    assert main(["check", str(alone), "--json", "--quiet"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["recordings"]
    checks = {check["name"]: check for check in found["checks"]}
    assert checks["cameras"]["status"] == checks["overlaps"]["status"] == "warning"
    assert "scale is learned from two cameras" in checks["cameras"]["remedy"]


def test_a_rig_file_of_one_camera_is_written_and_read(alone: Path, tmp_path: Path):
    assert main(["rig", str(alone), "-o", str(tmp_path / "rig.yaml")]) == 0
    assert load_rig_layout(tmp_path / "rig.yaml").names == ["front"]


def test_run_gives_its_depth_and_cloud(alone: Path, tmp_path: Path):
    assert main(["run", str(alone), "-o", str(tmp_path / "depth"), *SMALL]) == 0
    topics = {entry.topic for entry in recordings.entries_of(tmp_path / "depth")}
    assert {"/surround_depth/front/depth/image_rect", "/surround_depth/points"} <= topics


@pytest.mark.parametrize("options", [(), ("--no-lidar",)])
def test_evaluate_scores_it(alone: Path, options: tuple[str, ...], tmp_path: Path):
    assert main(["evaluate", str(alone), "-o", str(tmp_path), "--quiet", *SMALL, *options]) == 0
    result = json.loads((tmp_path / "metrics.json").read_text())
    assert (result["sets"], result["recordings"][0]["cameras"]) == (2, ["front"])
    assert bool(result["truth_points"]) == (not options)
    assert result["label_free"]["mean"]["spatial"] is None
    assert (tmp_path / "report.html").is_file()
