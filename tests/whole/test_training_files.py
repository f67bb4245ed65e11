# SPDX-License-Identifier: Apache-2.0
"""Every shipped training file runs on recordings: as it stands, or by the two lines that docs/training.md shows."""

import re
import subprocess
from pathlib import Path

import pytest
import recordings
import torch
from repository import ROOT
from scenes import random_batch

from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.training.config import load_training_config
from cvcdepth_core.training.novel_views import draw_turns
from cvcdepth_core.training.objective import evaluate_objective
from cvcdepth_core.training.starting_model import build_surround_model
from cvcdepth_ros.bag_replay import main

SHIPPED = sorted((ROOT / "config" / "training").rglob("*.yaml"))
DATASETS = {path: load_training_config(path).dataset for path in SHIPPED}
FOR_DATA_SETS = [path for path, dataset in DATASETS.items() if dataset not in ("recording", "worlds")]
NOT_FOR_FINETUNE = [path for path, dataset in DATASETS.items() if dataset != "recording"]
# Quick; what rows differ in beside the encoder is kept.
SMALL = """
depth: {encoder: efficientnet_lite0, height: 64, width: 64PART}
pose: {encoder: efficientnet_lite0}
optimizer: {epochs: 1, samples_per_step: 1, samples_per_batch: 1}
"""
SMALL_PARTS = {
    "vfdepth": ", volume: {voxels: [12, 12, 4], voxel_size: [8, 8, 5], steps: 6, image_channels: 9, voxel_channels: 8}",
    "surrounddepth": ", cross_view: {blocks: 1}",
}


def on_recordings(row: Path, file: Path, more: str = "") -> Path:
    """The file that makes a data set's settings those for recordings."""
    file.write_text(f"base: {row}\ndataset: recording\n{more}")
    return file


def small(row: Path | None = None) -> str:
    network = "" if row is None else load_training_config(row).depth.network
    return SMALL.replace("PART", SMALL_PARTS.get(network, ""))


def name(path: Path) -> str:
    return path.stem


@pytest.mark.parametrize("path", SHIPPED, ids=name)
def test_a_file_is_for_recordings_or_says_what_it_is_for_and_what_to_do(path: Path):
    marked = "there is no reader yet; on recordings: two lines, see docs/training.md" in path.read_text()
    assert marked == (path in FOR_DATA_SETS)


@pytest.mark.parametrize("path", NOT_FOR_FINETUNE, ids=name)
def test_finetune_refuses_a_data_set_in_one_line_with_file_field_value_and_remedy(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    options = ["--config", str(path), "--from-scratch", "-o", str(tmp_path / "run")]
    assert main(["finetune", str(tmp_path / "not_looked_for.mcap"), *options]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    dataset = load_training_config(path).dataset
    assert f"{path}: dataset is {dataset!r}" in line
    assert f"write `dataset: recording` in this file, or in a new one below `base: {path}`" in line


@pytest.mark.parametrize("path", FOR_DATA_SETS, ids=name)
def test_the_two_lines_change_the_data_alone_and_the_row_can_be_learned(path: Path, tmp_path: Path):
    row, here = load_training_config(path), load_training_config(on_recordings(path, tmp_path / "here.yaml"))
    assert here == row.model_copy(update={"dataset": "recording"})
    config = load_training_config(on_recordings(path, tmp_path / "small.yaml", small(path)))
    model, batch, flips = build_surround_model(config).double(), random_batch(1, 3, 64, 64), torch.tensor([True])
    flipped = {network: flips & (config.augmentation.flip in (network, "both")) for network in ("depth", "pose")}
    turns = draw_turns(config.synthesis, 3, [torch.Generator()]).double() if config.objective.synthesises else None
    prediction = model(batch, batch.frames, flipped["depth"], flipped["pose"], turns)
    evaluate_objective(batch, prediction, config.objective).loss.backward()
    learned = [next(network.parameters()).grad for network in (model.depth_net, model.pose_net)]
    assert all(gradient.isfinite().all() and gradient.any() for gradient in learned)


def test_the_documented_lines_give_a_file_with_which_finetune_trains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    page = (ROOT / "docs" / "training.md").read_text(encoding="utf-8")
    (writing, command) = re.findall(r"^(printf .*|cvcdepth finetune .*--config here\.yaml.*)$", page, re.MULTILINE)
    (tmp_path / "config").symlink_to(ROOT / "config")
    monkeypatch.chdir(tmp_path)
    subprocess.run(["bash", "-c", writing], check=True)
    with Path("here.yaml").open("a", encoding="utf-8") as file:
        file.write(small() + "recordings: {held_out: 0.0}\n")
    recordings.write_rosbag2(tmp_path / "drives", recordings.sample_entries(4))
    arguments = command.split()[1:]
    assert main([*arguments, "--no-masks", "--skip", "places", "--quiet", "--device", "cpu", "--no-promotion"]) == 0
    assert "nothing was proven: no recording has a held-out part" in capsys.readouterr().out
    assert Path("run/last.safetensors").exists()


def test_the_file_of_a_network_that_fuses_its_cameras_trains_and_its_checkpoint_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config = tmp_path / "here.yaml"
    base = ROOT / "config" / "training" / "finetune_vfdepth.yaml"
    config.write_text(f"base: {base}\n{small(base)}recordings: {{held_out: 0.0}}\n")
    drives = recordings.write_rosbag2(tmp_path / "drives", recordings.sample_entries(4))
    options = ["--no-masks", "--skip", "places", "--quiet", "--device", "cpu", "--no-promotion", "--from-scratch"]
    assert main(["finetune", str(drives), "--config", str(config), *options, "-o", str(tmp_path / "run")]) == 0
    checkpoint = tmp_path / "run" / "last.safetensors"
    assert load_checkpoint(checkpoint).spec.volume == load_training_config(config).depth.volume
    ran = ["--checkpoint", str(checkpoint), "-o", str(tmp_path / "depth.mcap"), "--quiet", "--backend", "torch_eager"]
    assert main(["run", str(drives), *ran]) == 0
    assert (tmp_path / "depth.mcap").stat().st_size > 1000
