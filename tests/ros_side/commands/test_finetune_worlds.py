# SPDX-License-Identifier: Apache-2.0
"""`finetune --worlds`: a run learns from recordings and worlds, is scored on both, and says what it forgot."""

import json
from pathlib import Path

import pytest
import yaml
from recordings import SAMPLE
from simple_worlds import short_drive

from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.worlds.shards import write_shard
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.commands.arguments import training_file

pytest.importorskip("embreex", reason="worlds need embreex")
pytestmark = pytest.mark.timeout(600)

CHEAP = ("--skip", "places", "--no-masks", "--no-promotion", "--quiet", "--device", "cpu")
OF_RECORDINGS = {"temporal", "smoothness", "spatial", "recorded_motion", "truth", "truth_shape", "truth_uncertainty"}
OF_WORLDS = {f"worlds_truth{name}" for name in ("", "_shape", "_outlines", "_sky", "_uncertainty")}


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    for number in range(2):
        write_shard(folder / f"drive_{number:06d}.shard.zip", short_drive().model_copy(update={"seconds": 0.2}))
    return folder


def training(path: Path, **changes: object) -> Path:
    small = {
        "base": str(training_file("mixed")),
        "depth": {"height": 64, "width": 96, "focal_scale": 48.0},
        "recordings": {"held_out": 0.6, "further_travels": [], "supervise": "lidar"},
        "optimizer": {"epochs": 1, "warm_up": 0},
        "worlds": {"share": 0.25, "held_out": 0.5},
        "evaluation": {"sets": 2},
    }
    path.write_text(yaml.safe_dump(small | changes))
    return path


def finetune(config: Path, run: Path, *options: object) -> int:
    arguments = ["finetune", SAMPLE, "--config", config, "--from-scratch", "-o", run, *CHEAP, *options]
    return main([str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def run(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mixed")
    assert finetune(training(folder / "small.yaml"), folder / "run", "--worlds", shards) == 0
    return folder / "run"


def entries(run: Path, keyword: str) -> list[dict]:
    found = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return [entry for entry in found if keyword in entry]


def test_each_step_has_samples_of_recordings_and_views_of_worlds_with_their_own_terms(run: Path):
    steps = entries(run, "loss")
    assert [entry["samples"] for entry in steps] == [1, 1]
    for entry in steps:
        assert {name for name in entry["terms"] if name.startswith("worlds_")} == OF_WORLDS
        assert set(entry["terms"]) > OF_RECORDINGS
        assert not {"truth_sky", "truth_outlines", "depth_consistency"} & set(entry["terms"])


def test_both_are_scored_and_told_in_log_result_and_card(run: Path):
    validations = entries(run, "validation")
    assert all({"score", "worlds_abs_rel", "worlds_delta_1"} <= set(entry["validation"]) for entry in validations)
    worlds = json.loads((run / "finetune.json").read_text())["worlds"]
    assert (worlds["training_views"], worlds["held_out_views"], worlds["views_per_step"]) == (4, 4, 2)
    assert (worlds["share"], worlds["weight"]) == (0.25, 1.0)
    scores = worlds["scores"]
    assert scores["views"] == 4
    change = scores["after"]["delta_1"] - scores["before"]["delta_1"]
    assert scores["difference"]["difference"] == pytest.approx(change, abs=1e-4)
    assert scores["after"] != scores["before"]
    assert not scores["is_worse"]  # four views prove nothing
    assert "on worlds: δ < 1.25" in scores["verdict"]
    text = (run / "model_card.md").read_text()
    assert "## Worlds" in text
    assert "25% of the pictures" in text
    assert json.loads(load_checkpoint(run / "last.safetensors").metadata["worlds"])["views_per_step"] == 2


def test_a_run_goes_on_with_the_same_worlds_and_share_only(
    run: Path, shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config = training(tmp_path / "small.yaml")
    assert finetune(config, run) == 1
    assert "was made from something else: the worlds was 2 drives " in capsys.readouterr().err
    assert finetune(config, run, "--worlds", shards, "--keep-general", 0.5) == 1
    assert "was made with another configuration (worlds)" in capsys.readouterr().err


def test_a_share_of_nothing_scores_worlds_and_learns_from_none(shards: Path, tmp_path: Path):
    config = training(tmp_path / "small.yaml", recordings={"held_out": 0.0, "further_travels": []})
    assert finetune(config, tmp_path / "run", "--worlds", shards, "--keep-general", 0) == 0
    worlds = json.loads((tmp_path / "run" / "finetune.json").read_text())["worlds"]
    assert (worlds["views_per_step"], worlds["share"]) == (0, 0.0)
    assert worlds["scores"]["views"] == 4
    assert not any(name.startswith("worlds_") for name in entries(tmp_path / "run", "loss")[0]["terms"])


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--keep-general", "0.5"), "argument --keep-general: needs --worlds"),
        (("--worlds", "{tmp}", "--keep-general", "1"), "'1' is not a share, at least 0 and below 1"),
    ],
)
def test_a_ratio_without_worlds_or_of_everything_is_wrong_use(options, told, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        finetune(training(tmp_path / "small.yaml"), tmp_path / "run", *(o.format(tmp=tmp_path) for o in options))
    assert stopped.value.code == 2
    assert told in capsys.readouterr().err


def test_a_folder_without_shards_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert finetune(training(tmp_path / "small.yaml"), tmp_path / "run", "--worlds", tmp_path) == 1
    assert f"{tmp_path}: no shards (*.shard.zip) there" in capsys.readouterr().err
