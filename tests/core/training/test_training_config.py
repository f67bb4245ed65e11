# SPDX-License-Identifier: Apache-2.0
"""Every shipped training file loads and says what its name says; a mistake is named with file, field and choices."""

from collections.abc import Iterator

import pytest
from pydantic import BaseModel
from repository import ROOT

from cvcdepth_core.errors import CheckpointError, ConfigError
from cvcdepth_core.model_choices import checkpoint_path
from cvcdepth_core.networks.checkpoint import Checkpoint, load_spec
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.networks.volume import VolumeSpec
from cvcdepth_core.training.config import TrainingConfig, load_training_config
from cvcdepth_core.training.starting_model import build_surround_model

SHIPPED = ROOT / "config" / "training"
DEPTH = "depth: {height: 64, width: 96, min_depth: 1, max_depth: 80}\n"


@pytest.mark.parametrize("path", sorted(SHIPPED.rglob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_training_file_loads(path):
    load_training_config(path)


def test_shipped_files_hold_the_published_hyper_parameters():
    ddad, nuscenes = (load_training_config(SHIPPED / f"{name}_r18.yaml") for name in ("ddad", "nuscenes"))
    assert (ddad.depth.height, ddad.depth.width, ddad.depth.min_depth, ddad.depth.max_depth) == (384, 640, 1.5, 200)
    assert (nuscenes.depth.height, nuscenes.depth.width) == (352, 640)
    assert (nuscenes.depth.min_depth, nuscenes.depth.max_depth, nuscenes.evaluation.max_depth) == (1, 80, 80)
    for config, weight in ((ddad, 0.2), (nuscenes, 0.05)):
        loss = config.objective
        assert (loss.smoothness, loss.spatial, loss.spatio_temporal) == (0.1, 0.03, 0.1)
        assert (loss.depth_consistency, loss.reconstruction_consistency) == (0.001, weight)
        assert not loss.corrected
        assert (config.optimizer.learning_rate, config.optimizer.epochs, config.seed) == (1e-4, 20, 42)
    r34 = load_training_config(SHIPPED / "nuscenes_r34.yaml")
    assert (r34.depth.encoder, r34.pose.encoder) == ("resnet34", "resnet34")
    assert r34.objective == nuscenes.objective


ABLATION = {  # pose method, DDCL or DCL, MVRCL, flip: the rows of the paper's tables
    "fsm_baseline": ("per_camera", None, False, "none"),
    "front_pose": ("front", None, False, "none"),
    "joint_pose": ("joint", None, False, "none"),
    "joint_front_pose": ("joint_front", None, False, "none"),
    "front_pose_ddcl": ("front", "ddcl", False, "none"),
    "front_pose_dcl": ("front", "dcl", False, "none"),
    "front_pose_mvrcl": ("front", None, True, "none"),
    "front_pose_hflip": ("front", None, False, "both"),
    "front_pose_hflip_depth": ("front", None, False, "depth"),
    "front_pose_hflip_pose": ("front", None, False, "pose"),
}


def test_there_is_one_file_per_row_of_the_ablation():
    assert {path.stem for path in (SHIPPED / "ablation").iterdir()} == set(ABLATION)


@pytest.mark.parametrize("name", ABLATION)
def test_ablation_files_change_what_their_row_says(name):
    config = load_training_config(SHIPPED / "ablation" / f"{name}.yaml")
    warping = config.objective.depth_warping if config.objective.depth_consistency else None
    mvrcl = config.objective.reconstruction_consistency > 0
    assert (config.pose.method, warping, mvrcl, config.augmentation.flip) == ABLATION[name]
    assert (config.objective.pose_consistency > 0) == (config.pose.method == "per_camera")
    assert config.depth == load_training_config(SHIPPED / "ddad_r18.yaml").depth


VERSATILITY = {  # pose method, DDCL, MVRCL, flip: the rows of the paper's last table, and one of ours
    "vfdepth": ("volume", False, False, "none"),
    "vfdepth_front_pose": ("front", False, False, "none"),
    "vfdepth_ddcl": ("volume", True, False, "none"),
    "vfdepth_mvrcl": ("volume", False, True, "none"),
    "vfdepth_all": ("front", True, True, "none"),
    "vfdepth_all_flips": ("front", True, True, "both"),
}


def test_there_is_one_file_per_row_of_the_versatility_table():
    assert {path.stem for path in (SHIPPED / "versatility").iterdir()} == set(VERSATILITY)


@pytest.mark.parametrize("name", VERSATILITY)
def test_versatility_files_change_what_their_row_says(name):
    config = load_training_config(SHIPPED / "versatility" / f"{name}.yaml")
    loss = config.objective
    row = (
        config.pose.method,
        loss.depth_consistency > 0,
        loss.reconstruction_consistency > 0,
        config.augmentation.flip,
    )
    assert row == VERSATILITY[name]
    assert (loss.smoothness, loss.synthesis_consistency, loss.synthesis_smoothness) == (0.001, 0.03, 0.05)
    assert (config.depth.network, config.depth.volume, config.synthesis.radians) == ("vfdepth", VolumeSpec(), True)


def test_depth_synthesis_without_a_volume_or_with_skips_is_refused_with_the_weights(tmp_path):
    fields = "objective: {synthesis_consistency: 0.03}\ndepth: {height: 64, width: 64, min_depth: 1, max_depth: 9"
    for more, reason in (
        ("}", "but depth.network is per_camera, expected vfdepth"),
        (", network: vfdepth, volume: {skips: true}}", "whose skips show a turned camera another one's picture"),
    ):
        (tmp_path / "here.yaml").write_text(fields + more)
        with pytest.raises(ConfigError, match=f"synthesis_consistency is 0.03 .*{reason}"):
            load_training_config(tmp_path / "here.yaml")


def sections(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    yield model
    for field in model.model_fields.values():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from sections(field.annotation)


def test_every_field_of_the_configuration_is_described():
    undescribed = [
        f"{section.__name__}.{name}"
        for section in sections(TrainingConfig)
        for name, field in section.model_fields.items()
        if not field.description
    ]
    assert undescribed == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            DEPTH + "objective: {spatail: 1}",
            r"objective.spatail is no known field; expected one of temporal, smoothness",
        ),
        (DEPTH + "nonsense: 1", r"nonsense is no known field; expected one of dataset, depth"),
        (DEPTH + "pose: {method: abc}", r"pose.method is 'abc'.*'front', 'joint_front', 'joint', 'per_camera' or"),
        (DEPTH + "objective: {depth_warping: splat}", r"objective.depth_warping is 'splat'.*'ddcl' or 'dcl'"),
        (DEPTH + "seed: hello", r"seed is 'hello'.*integer"),
        (DEPTH + "objective: {spatial: -1}", r"objective.spatial is -1.*greater than or equal to 0"),
        (DEPTH + "objective: {pose_consistency: 1}", r"pose_consistency is 1.0.*'front', expected 'per_camera'"),
        (DEPTH + "augmentation: {color_jitter: {hues: 1}}", r"color_jitter.hues is no known field.*brightness"),
        (DEPTH + "evaluation: {flip_fusion: true}", r"evaluation.flip_fusion is no known field; expected one of"),
        (DEPTH + "evaluation: {max_depth: .inf}", r"evaluation.max_depth is inf.*less than or equal to 10000"),
        (DEPTH.replace("64", "100"), r"depth.height is 100.*multiple of 32"),
        (DEPTH.replace("max_depth: 80", "max_depth: 0.5"), r"min_depth 1.0 must be below max_depth 0.5"),
        ("depth: {height: 64}", r"depth.width is missing"),
        ("depth: 64", r"depth is 64"),
        ("base: here.yaml", r"leads back to the file itself"),
        ("base: absent.yaml", r"absent.yaml: cannot be read"),
        ("base: 3", r"base is 3, expected the name of a file"),
        ("- 1", r"holds a list"),
        ("seed: [1", r"cannot be read: while parsing"),
    ],
)
def test_a_mistake_is_named_in_one_line_with_the_file_the_field_and_the_choices(tmp_path, text, message):
    path = tmp_path / "here.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as error:
        load_training_config(path)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("written", "meant"), [("true", "auto"), ("false", "none"), ("network", "network")])
def test_exposure_motion_may_be_a_switch(tmp_path, written, meant):
    path = tmp_path / "config.yaml"
    path.write_text(DEPTH + f"recordings: {{exposure_motion: {written}}}\n")
    config = load_training_config(path)
    assert config.recordings.exposure_motion == meant
    assert TrainingConfig.model_validate_json(config.model_dump_json()) == config


STARTS = {
    "per_camera": DepthModelSpec(
        encoder="efficientnet_lite0", height=192, width=320, min_depth=0.5, max_depth=100.0, focal_scale=160.0
    ),
    "rig_conditioned": DepthModelSpec(
        network="rig_conditioned", encoder="efficientnet_lite0", height=160, width=256, min_depth=0.4, max_depth=250.0,
        focal_scale=128.0,
    ),
}  # fmt: skip


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS)
def test_what_a_file_does_not_say_of_the_network_is_as_the_weights_have_it(tmp_path, start):
    path = tmp_path / "config.yaml"
    path.write_text("seed: 1\n")
    assert load_training_config(path, start).depth == start
    path.write_text("depth: {height: 96, width: 128}\n")
    smaller = load_training_config(path, start).depth
    assert (smaller.network, smaller.min_depth, smaller.max_depth) == (start.network, start.min_depth, start.max_depth)
    assert (smaller.height, smaller.width, smaller.focal_scale) == (96, 128, 64.0)
    assert load_training_config(SHIPPED / "finetune.yaml", start).depth == start


def test_what_a_file_says_of_the_network_stays_and_other_weights_are_refused(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("depth: {network: per_camera, max_depth: 100}\n")
    config = load_training_config(path, STARTS["rig_conditioned"])
    assert (config.depth.network, config.depth.max_depth, config.depth.min_depth) == ("per_camera", 100, 0.4)
    weights = Checkpoint(path, STARTS["rig_conditioned"], {}, {}, "")
    with pytest.raises(CheckpointError, match=r"network is rig_conditioned, but the configuration's depth.network is"):
        build_surround_model(config, weights)
    path.write_text("depth: {encoder: resnet34}\n")
    with pytest.raises(ConfigError, match=r"config.yaml: depth.*encoder is resnet34, but the network rig_conditioned"):
        load_training_config(path, STARTS["rig_conditioned"])


def test_without_weights_and_a_word_of_the_network_it_is_that_of_the_packages_model(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("seed: 1\n")
    assert load_training_config(path).depth == load_spec(checkpoint_path("default"))
