# SPDX-License-Identifier: Apache-2.0
"""`finetune`: three steps on the shipped recording, and what it refuses."""

import json
import subprocess
import sys

import pytest
import recordings
import yaml
from recordings import SAMPLE

from cvcdepth_core.checkpoint import load_checkpoint
from cvcdepth_core.training_config import load_training_config
from cvcdepth_ros.bag_replay import main

SMALL = {
    "dataset": "recording",
    "depth": {"encoder": "efficientnet_lite0", "height": 64, "width": 96, "min_depth": 0.5, "max_depth": 80},
    "pose": {"encoder": "efficientnet_lite0"},
    "recordings": {"held_out": 0.3, "min_travel": 0.1},
    "optimizer": {"epochs": 1, "samples_per_step": 2},
}


@pytest.fixture
def config(tmp_path):
    def write(**changes: object):
        path = tmp_path / "finetune.yaml"
        path.write_text(yaml.safe_dump(SMALL | changes))
        return path

    return write


def finetune(config, run, *options: object, bags=(SAMPLE,)):
    start = [] if "--from" in options else ["--from-scratch"]
    arguments = ["finetune", *bags, "--config", config, "-o", run, "--quiet", "--device", "cpu", *start, *options]
    return main([str(argument) for argument in arguments])


def test_a_recording_becomes_a_checkpoint_and_the_same_command_again_adds_nothing(config, tmp_path, capsys):
    assert finetune(config(), tmp_path / "run", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["epochs"], result["steps"], result["skipped_steps"]) == (1, 3, 0)
    assert result["recordings"][0]["training_samples"] == 5
    checkpoint = load_checkpoint(tmp_path / "run" / "last.safetensors")
    assert result["sha256"] == checkpoint.sha256
    assert checkpoint.spec.encoder == "efficientnet_lite0"
    assert load_training_config(tmp_path / "run" / "config.yaml") == load_training_config(config())
    assert json.loads((tmp_path / "run" / "finetune.json").read_text()) == result
    assert finetune(config(), tmp_path / "run") == 0
    assert load_checkpoint(tmp_path / "run" / "last.safetensors").metadata["step"] == "3"


def test_torchrun_trains_with_two_processes_as_one_does_with_their_samples(config, tmp_path):
    alone = SMALL["optimizer"] | {"samples_per_batch": 2}
    assert finetune(config(optimizer=alone), tmp_path / "alone") == 0
    torchrun = ["torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "cvcdepth_ros.bag_replay"]
    arguments = [
        "finetune",
        SAMPLE,
        "--config",
        config(),
        "-o",
        tmp_path / "both",
        "--from-scratch",
        "--device",
        "cpu",
        "--json",
    ]
    finished = subprocess.run(
        [sys.executable, "-m", *torchrun, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
    assert json.loads(finished.stdout)["steps"] == 3
    logs = [(tmp_path / run / "log.jsonl").read_text().splitlines() for run in ("alone", "both")]
    one, two = ([json.loads(line)["loss"] for line in lines] for lines in logs)
    assert len(two) == 3
    assert two[0] == pytest.approx(one[0], rel=1e-3)  # Adam makes of rounding whole steps; see test_distributed.py


def test_training_goes_on_from_a_checkpoint_of_the_same_network_only(config, tmp_path, capsys):
    assert finetune(config(optimizer={"epochs": 1, "samples_per_step": 8}), tmp_path / "first") == 0
    start = tmp_path / "first" / "last.safetensors"
    assert finetune(config(), tmp_path / "second", "--from", start) == 0
    assert "started from last.safetensors sha256:" in capsys.readouterr().out
    other = config(depth=SMALL["depth"] | {"max_depth": 200})
    assert finetune(other, tmp_path / "third", "--from", start) == 1
    assert "max_depth is 80.0, but the configuration's depth.max_depth is 200.0" in capsys.readouterr().err


def test_a_vehicle_that_stands_still_is_refused_before_the_first_step(config, tmp_path, capsys):
    standing = config(recordings={"min_travel": 9})
    assert finetune(standing, tmp_path / "run") == 1
    error = capsys.readouterr().err
    assert "pandaset_002_excerpt: no training sample" in error
    assert "min_travel is 9" in error
    assert not (tmp_path / "run" / "last.safetensors").exists()


def test_a_recording_that_cannot_be_used_is_left_out_by_name_beside_one_that_can(config, tmp_path, capsys):
    entries = [e for e in recordings.sample_entries(2) if e.topic != "/camera/left/image_raw/compressed"]
    lame = recordings.write_rosbag2(tmp_path / "lame", entries)
    assert finetune(config(), tmp_path / "run", bags=(lame, SAMPLE)) == 0
    assert "left out" in (caught := capsys.readouterr().err)
    assert "camera camera/left" in caught


def test_a_configuration_for_another_dataset_is_refused(config, tmp_path, capsys):
    assert finetune(config(dataset="ddad"), tmp_path / "run") == 1
    assert "dataset is 'ddad', finetune takes 'recording'" in capsys.readouterr().err
