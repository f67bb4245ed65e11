# SPDX-License-Identifier: Apache-2.0
"""The model that comes with the package is the one that the documentation tells of, and is used where none is named."""

import hashlib
import json
from pathlib import Path

import pytest
from recordings import SAMPLE
from repository import ROOT

from cvcdepth_core.model_choices import NOTICE, checkpoint_path
from cvcdepth_core.networks import PoseNet
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.settings import ModelSettings


def test_the_file_is_small_and_its_hash_is_in_its_card():
    content = checkpoint_path("default").read_bytes()
    assert len(content) <= 20e6
    assert hashlib.sha256(content).hexdigest() in (ROOT / "docs" / "default_model.md").read_text(encoding="utf-8")


def test_it_holds_both_networks_so_that_training_can_start_from_it():
    checkpoint = load_checkpoint(checkpoint_path(""))
    checkpoint.build_depth_net()
    PoseNet(checkpoint.spec.encoder).load_state_dict(checkpoint.pose_net)


def test_a_path_stands_for_itself():
    assert checkpoint_path("default.safetensors") == Path("default.safetensors")
    assert ModelSettings(untrained=True).checkpoint_path is None  # type: ignore[call-arg]


def test_without_a_checkpoint_run_takes_it_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output = tmp_path / "depth"
    assert main(["run", str(SAMPLE), "-o", str(output), "--duration", "0.15", "--quiet"]) == 0
    assert f"warning: {NOTICE}" in capsys.readouterr().err
    digest = hashlib.sha256(checkpoint_path("").read_bytes()).hexdigest()
    assert digest[:12] in json.loads((output / "run.json").read_text())["model"]


def test_its_depth_on_the_sample_is_better_than_a_constant(tmp_path: Path):
    scores = {}
    for name, options in {"default": [], "constant": ["--predictor", "constant"]}.items():
        command = ["evaluate", str(SAMPLE), "-o", str(tmp_path / name), "--duration", "0.5", "--quiet", "--no-report"]
        assert main([*command, *options]) == 0
        metrics = json.loads((tmp_path / name / "metrics.json").read_text())
        scores[name] = metrics["scores"]["image"]["metric"]["mean"]["all"]["abs_rel"]
    assert scores["default"] < 0.8 * scores["constant"]
