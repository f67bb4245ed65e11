# SPDX-License-Identifier: Apache-2.0
"""`pretrain` as a command: it learns from shards, goes on where it was, and its checkpoint runs on a rig."""

import json
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file
from simple_worlds import short_drive

from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.networks.efficientnet_lite import EfficientNetLite0Encoder
from cvcdepth_core.training.trainer import Trainer
from cvcdepth_core.worlds.shards import write_shard
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.commands.arguments import training_file

pytest.importorskip("embreex", reason="worlds need embreex")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    for number in range(2):
        write_shard(folder / f"drive_{number:06d}.shard.zip", short_drive().model_copy(update={"seconds": 0.2}))
    return folder


def training(path: Path, epochs: int = 2, **changes: object) -> Path:
    small = {
        "base": str(training_file("pretrain")),
        "depth": {"height": 64, "width": 64, "focal_scale": 32.0},
        "optimizer": {"samples_per_step": 2, "samples_per_batch": 2, "warm_up": 1, "epochs": epochs},
        "worlds": {"held_out": 0.5},
        "checkpoint_every": 1,
    }
    path.write_text(yaml.safe_dump(small | changes))
    return path


def pretrained(shards: Path, config: Path, run: Path, *options: str) -> int:
    return main(["pretrain", str(shards), "--config", str(config), *(options or ("--from-scratch",)), "-o", str(run)])


def test_it_learns_and_scores_what_it_has_not_seen(shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = training(tmp_path / "small.yaml", epochs=3)
    assert pretrained(shards, config, tmp_path / "run", "--from-scratch", "--json", "--quiet") == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["drives"], result["steps"], result["epochs"]) == (2, 6, 3)
    assert [entry["epoch"] for entry in result["validations"]] == [0, 1, 2, 3]
    entries = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    steps = [entry for entry in entries if "loss" in entry]
    assert set(steps[0]["terms"]) == {"truth", "truth_shape", "truth_outlines", "truth_sky", "truth_uncertainty"}
    rates = [entry["learning_rate"] for entry in steps]
    assert rates == sorted(rates, reverse=True)  # a cosine
    assert rates[-1] < 0.1 * rates[0]
    checkpoint = load_checkpoint(result["checkpoint"])
    assert checkpoint.spec.network == "rig_conditioned"
    assert float(checkpoint.depth_net["rig_stem.weight"].abs().max()) > 0  # was zero


def test_a_run_that_is_interrupted_goes_on_and_ends_where_it_would_have(shards: Path, tmp_path: Path, monkeypatch):
    config = training(tmp_path / "small.yaml")
    assert pretrained(shards, config, tmp_path / "whole", "--from-scratch", "--quiet") == 0
    step = Trainer._step

    def interrupted(self: Trainer, batches: object) -> object:
        if self.progress.step == 3:
            raise KeyboardInterrupt
        return step(self, batches)

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "_step", interrupted)
        assert pretrained(shards, config, tmp_path / "cut", "--from-scratch", "--quiet") == 1
    assert pretrained(shards, config, tmp_path / "cut", "--from-scratch", "--quiet") == 0
    whole, cut = (load_file(tmp_path / run / "last.safetensors") for run in ("whole", "cut"))
    assert all(torch.equal(whole[name], cut[name]) for name in whole)


def test_imagenet_weights_start_its_encoder(tmp_path: Path):
    torch.manual_seed(0)
    state = EfficientNetLite0Encoder().encoder.state_dict()
    torch.save(state, tmp_path / "efficientnet-lite0-0000.pth")
    out = tmp_path / "imagenet.safetensors"
    source = str(tmp_path / "efficientnet-lite0-0000.pth")
    assert main(["import", source, "--config", "pretrain", "-o", str(out)]) == 0
    found = load_checkpoint(out)
    assert found.spec.network == "rig_conditioned"
    assert torch.equal(found.depth_net["depth_encoder.encoder.stem.weight"], state["stem.weight"])
    assert not found.depth_net["rig_stem.weight"].any()


def test_what_cannot_be_is_refused_in_one_line(shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def refusal(config: Path, shards: Path = shards) -> str:
        assert pretrained(shards, config, tmp_path / "run") == 1
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert "dataset is 'recording', expected 'worlds' for shards" in refusal(training_file("finetune"))
    assert f"{tmp_path}: no shards (*.shard.zip) there" in refusal(training(tmp_path / "a.yaml"), tmp_path)
    none_left = training(tmp_path / "b.yaml", worlds={"held_out": 0.9})
    assert "worlds.held_out is 0.9: of 2 drives none is left" in refusal(none_left)
