# SPDX-License-Identifier: Apache-2.0
"""`cvcdepth import`: weights from elsewhere become checkpoints, and what does not fit is named."""

import json
from pathlib import Path

import pytest
import torch

from cvcdepth_core.model_choices import checkpoint_path
from cvcdepth_core.networks import DepthNet, PoseNet
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.training.config import load_training_config
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.commands.arguments import training_file


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pair of files as CVCDepth's authors release them, with random weights."""
    folder = tmp_path_factory.mktemp("released") / "weights_19"
    folder.mkdir()
    torch.manual_seed(0)
    for name, network in (("depth_net", DepthNet()), ("pose_net", PoseNet())):
        torch.save({f"module.{key}": value for key, value in network.state_dict().items()}, folder / f"{name}.pth")
    return folder


@pytest.fixture(scope="module")
def classifier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ResNet-18 in torchvision's names, with random weights."""
    path = tmp_path_factory.mktemp("imagenet") / "resnet18-0000.pth"
    torch.manual_seed(1)
    state = dict(DepthNet().depth_encoder.encoder.state_dict())
    torch.save({**state, "fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}, path)
    return path


def imported(*arguments: object) -> int:
    return main(["import", *map(str, arguments)])


@pytest.mark.parametrize("name", ["ddad_r18", "nuscenes_r18"])
def test_released_weights_become_a_checkpoint_of_the_named_configuration(released: Path, name: str, tmp_path: Path):
    out = tmp_path / "model.safetensors"
    assert imported(released, "--config", name, "-o", out) == 0
    checkpoint = load_checkpoint(out)
    assert checkpoint.spec == load_training_config(training_file(name)).depth
    weights = torch.load(released / "depth_net.pth", weights_only=True)
    assert all(torch.equal(value, weights[f"module.{key}"]) for key, value in checkpoint.depth_net.items())
    assert checkpoint.pose_net
    assert checkpoint.metadata["imported_from"].startswith("weights_19 sha256:")
    checkpoint.build_depth_net()


def test_an_imagenet_file_starts_both_encoders_and_the_depth_where_it_is_told(classifier: Path, tmp_path: Path, capsys):
    out = tmp_path / "start.safetensors"
    assert imported(classifier, "--config", "ddad_r18", "-o", out, "--initial-depth", 20, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["encoder"], result["metadata"]) == ("resnet18", {"initialisation": classifier.name})
    checkpoint = load_checkpoint(out)
    first = torch.load(classifier, weights_only=True)["conv1.weight"]
    assert torch.equal(checkpoint.depth_net["depth_encoder.encoder.conv1.weight"], first)
    assert any(torch.equal(value[:, :3] * 2, first) for key, value in checkpoint.pose_net.items() if "conv1" in key)
    spec = checkpoint.spec
    disparity = float(torch.sigmoid(checkpoint.depth_net["depth_decoder.decoder.10.conv.bias"]))
    assert 1 / (1 / spec.max_depth + (1 / spec.min_depth - 1 / spec.max_depth) * disparity) == pytest.approx(
        20, rel=1e-4
    )


def test_a_checkpoint_is_made_half_as_large_and_says_of_what(released: Path, tmp_path: Path):
    whole, half = tmp_path / "whole.safetensors", tmp_path / "half.safetensors"
    assert imported(released, "--config", "ddad_r18", "-o", whole) == 0
    assert imported(whole, "--half", "-o", half) == 0
    assert half.stat().st_size < 0.51 * whole.stat().st_size
    before, after = load_checkpoint(whole), load_checkpoint(half)
    assert after.metadata == before.metadata | {"released_from": f"sha256:{before.sha256}"}
    assert (after.spec, after.depth_net.keys()) == (before.spec, before.depth_net.keys())
    name = "depth_decoder.decoder.10.conv.weight"
    assert torch.equal(after.depth_net[name], before.depth_net[name].half().float())


@pytest.mark.parametrize(
    ("source", "options", "told"),
    [
        ("released", ["--config", "ddad_r34"], "weights_19: depth network (resnet34): missing"),
        ("released", ["--config", "dad_r18"], "did you mean ddad_r18? There are "),
        ("classifier", ["--config", "finetune"], "ImageNet encoder: missing"),
        ("classifier", ["--config", "ddad_r18", "--initial-depth", "900"], "ddad_r18.yaml: initial depth is 900.0"),
        ("/nowhere/resnet18.pth", ["--config", "ddad_r18"], "/nowhere/resnet18.pth: no such file"),
    ],
)
def test_what_does_not_fit_is_named_in_one_line_and_nothing_is_written(
    source: str, options: list[str], told: str, tmp_path: Path, capsys, request: pytest.FixtureRequest
):
    path = source if "/" in source else request.getfixturevalue(source)
    assert imported(path, *options, "-o", tmp_path / "out.safetensors") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("source", "options", "told"),
    [
        ("released", [], "argument --config: these weights do not say what they were trained for"),
        ("released", ["--config", "ddad_r18", "--initial-depth", "8"], "--initial-depth: for ImageNet weights only"),
        ("default", [], "is a checkpoint already: only --half can change it"),
        ("default", ["--half", "--config", "ddad_r18"], "is a checkpoint already"),
    ],
)
def test_options_without_a_meaning_are_wrong_use(
    source: str, options: list[str], told: str, tmp_path: Path, capsys, request: pytest.FixtureRequest
):
    path = checkpoint_path("default") if source == "default" else request.getfixturevalue(source)
    with pytest.raises(SystemExit) as ended:
        imported(path, *options, "-o", tmp_path / "out.safetensors")
    assert ended.value.code == 2
    assert told in capsys.readouterr().err


def test_a_file_that_is_there_is_overwritten_by_force_only(released: Path, tmp_path: Path, capsys):
    out = tmp_path / "model.safetensors"
    out.write_text("mine")
    assert imported(released, "--config", "ddad_r18", "-o", out) == 1
    assert f"{out}: exists already; --force overwrites it" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert imported(released, "--config", "ddad_r18", "-o", out, "--force") == 0


def test_a_training_file_is_meant_by_its_path_or_by_the_name_of_a_shipped_one(tmp_path: Path, monkeypatch):
    assert training_file("finetune").parts[-3:] == ("config", "training", "finetune.yaml")
    assert training_file("joint_pose").parent.name == "ablation"
    monkeypatch.chdir(tmp_path)
    Path("finetune").write_text("mine")
    assert training_file("finetune") == Path("finetune")
