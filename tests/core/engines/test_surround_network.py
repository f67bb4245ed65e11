# SPDX-License-Identifier: Apache-2.0
"""A network that looks at all cameras together, through every engine and estimator: never camera by camera."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from mean_feature_network import KIND, SPEC_FIELDS, MeanFeatureNet, register

from cvcdepth_core.engines import build_engine, is_installed, selection
from cvcdepth_core.engines.engine import DeviceMemoryError
from cvcdepth_core.engines.example_rigs import ring_of_cameras
from cvcdepth_core.engines.guarded_engine import GuardedEngine
from cvcdepth_core.errors import CheckpointError, ConfigError, EngineError
from cvcdepth_core.estimator import DepthEstimator
from cvcdepth_core.model_choices import BACKENDS
from cvcdepth_core.networks import DepthModelSpec, RigImages, build_depth_network, disparity_to_depth
from cvcdepth_core.networks.checkpoint import load_checkpoint, save_checkpoint
from cvcdepth_core.surround_depth import SurroundPictures
from cvcdepth_ros.bag_replay import main

HEIGHT, WIDTH = SPEC_FIELDS["height"], SPEC_FIELDS["width"]
OTHERS = [name for name in BACKENDS if name not in (*MeanFeatureNet.engines, "auto")]
ENGINES = [
    pytest.param(name, marks=pytest.mark.skipif(not is_installed(name), reason=f"{name} is not installed"))
    for name in MeanFeatureNet.engines
]


@pytest.fixture
def spec(monkeypatch) -> DepthModelSpec:
    return register(monkeypatch)


def surround(present: list[bool]) -> SurroundPictures:
    rng = np.random.default_rng(4)
    count, here = len(present), np.array(present)
    pictures = rng.integers(0, 256, (count, HEIGHT, WIDTH, 3), dtype=np.uint8) * here[:, None, None, None]
    intrinsics = np.tile([[60.0, 0, 47.5], [0, 60.0, 31.5], [0, 0, 1]], (count, 1, 1))
    mounts = np.tile(np.eye(4), (count, 1, 1))
    return SurroundPictures(pictures, here, intrinsics, mounts, np.ones((count, HEIGHT, WIDTH), bool))


@torch.inference_mode()
def exact_depth(spec: DepthModelSpec, pictures: SurroundPictures) -> np.ndarray:
    """The network's own answer, in float64."""
    disparity = build_depth_network(spec).double()(RigImages.from_pictures(pictures).to(dtype=torch.float64))[0]
    return disparity_to_depth(disparity, torch.as_tensor(pictures.fx), spec.min_depth, spec.max_depth)[:, 0].numpy()


@pytest.mark.parametrize("backend", ENGINES)
@pytest.mark.parametrize("cameras", [2, 6])
def test_every_engine_that_it_allows_gives_its_depth(spec, backend: str, cameras: int):
    pictures = surround([True] * cameras)
    estimator = DepthEstimator(build_depth_network(spec), spec, "toy", "cpu", backend)
    exact = exact_depth(spec, pictures)
    np.testing.assert_allclose(estimator.estimate(pictures), exact, rtol=1e-5)
    assert exact.std() > 0.02 * exact.mean()
    alone = SurroundPictures(*(part[:1] for part in vars(pictures).values()))
    assert np.abs(exact_depth(spec, alone)[0] / exact[0] - 1).max() > 1e-3  # camera by camera it would be another depth


@pytest.mark.parametrize("backend", OTHERS)
def test_every_other_engine_refuses_it_by_name(spec, backend: str):
    message = f"backend {backend} cannot run the network {KIND}, resnet18: expected auto or one of onnxruntime, torch_e"
    with pytest.raises(ConfigError, match=message):
        build_engine(build_depth_network(spec), spec, "cpu", backend)


@pytest.mark.parametrize("backend", ENGINES)
def test_a_dead_camera_is_absent_for_the_others_and_changes_nothing_else(spec, backend: str):
    pictures = surround([True, True, False, True])
    estimator = DepthEstimator(build_depth_network(spec), spec, "toy", "cpu", backend)
    found = estimator.estimate(pictures)
    living = pictures.present
    np.testing.assert_allclose(found[living], exact_depth(spec, pictures)[living], rtol=1e-5)
    fewer = SurroundPictures(*(part[living] for part in vars(pictures).values()))
    np.testing.assert_allclose(found[living], estimator.estimate(fewer), rtol=1e-5)
    black = replace(pictures, present=np.ones(4, bool))
    assert np.abs(estimator.estimate(black)[living] / found[living] - 1).max() > 1e-3


def test_auto_takes_the_first_of_its_engines_that_is_installed(spec, monkeypatch):
    first = "onnxruntime" if is_installed("onnxruntime") else "torch_eager"
    assert build_engine(build_depth_network(spec), spec, "cpu").name.startswith(first)
    monkeypatch.setattr(selection, "find_spec", lambda _: None)
    assert build_engine(build_depth_network(spec), spec, "cpu").name.startswith("torch_eager")


def test_a_network_none_of_whose_engines_can_run_here_says_what_each_lacks(spec, monkeypatch):
    monkeypatch.setattr(MeanFeatureNet, "engines", ("tensorrt", "onnxruntime"))
    monkeypatch.setattr(selection, "find_spec", lambda _: None)
    with pytest.raises(EngineError) as found:
        build_engine(build_depth_network(spec), spec, "cpu")
    assert str(found.value) == (
        f"network {KIND}, resnet18: none of its engines can run on 'cpu': tensorrt runs on cuda only, "
        "onnxruntime not installed (pip install 'cvcdepth_ros[onnx]')"
    )


def test_an_engine_that_rewrites_the_published_network_refuses_another_that_lists_it(spec, monkeypatch):
    monkeypatch.setattr(MeanFeatureNet, "engines", ("torch",))
    with pytest.raises(EngineError, match=f"backend torch rewrites .* {KIND}, resnet18 is a MeanFeatureNet: take the"):
        build_engine(build_depth_network(spec), spec, "cpu")


class SmallDevice:
    """An engine whose device holds five cameras."""

    name, device, chunk = "small", torch.device("cpu"), None

    def disparity(self, rig: RigImages) -> torch.Tensor:
        if rig.images.shape[1] > 5:
            raise DeviceMemoryError("no room")
        return rig.images[:, :, :1]


def test_with_too_little_memory_it_is_not_run_in_chunks():
    engine = GuardedEngine(SmallDevice(), independent=False)
    engine.disparity(surround([True] * 5))
    with pytest.raises(EngineError, match="out of memory with all cameras, which the network must see together"):
        engine.disparity(surround([True] * 6))


@pytest.mark.skipif(not is_installed("onnxruntime"), reason="onnxruntime is not installed")
def test_an_engine_that_sees_one_camera_at_a_time_fails_the_check(spec, monkeypatch):
    from cvcdepth_core.engines.onnx_engine import OnnxRuntimeEngine

    def one_by_one(self, rig: RigImages) -> torch.Tensor:
        cameras = range(rig.images.shape[1])
        return torch.cat([whole(self, rig.of_cameras([camera])) for camera in cameras], dim=1)

    whole = OnnxRuntimeEngine.disparity
    monkeypatch.setattr(OnnxRuntimeEngine, "disparity", one_by_one)
    with pytest.raises(EngineError, match="relative depth error against float64 is"):
        build_engine(build_depth_network(spec), spec, "cpu", "onnxruntime")


def test_the_example_rig_has_an_absent_camera_and_six_different_views():
    rig = ring_of_cameras(HEIGHT, WIDTH)
    assert rig.present.tolist() == [[True] * 5 + [False]]
    assert not rig.images[0, -1].any()
    assert len({tuple(mount.flatten().tolist()) for mount in rig.base_T_camera[0]}) == 6
    forward = rig.base_T_camera[0, 0, :3, 2]
    torch.testing.assert_close(forward, torch.tensor([1.0, 0.0, 0.0]), atol=1e-6, rtol=0)


@pytest.mark.skipif(not is_installed("onnxruntime"), reason="onnxruntime is not installed")
def test_export_writes_it_with_all_cameras_and_says_so(spec, tmp_path):
    import onnxruntime

    path = tmp_path / "toy.safetensors"
    save_checkpoint(path, spec, build_depth_network(spec).state_dict())
    assert main(["export", str(path)]) == 0
    described = json.loads(path.with_suffix(".json").read_text())
    assert described["network"] == KIND
    assert described["input"].startswith("images [1, N, 3, H, W]")
    session = onnxruntime.InferenceSession(path.with_suffix(".onnx"))
    rig = RigImages.from_pictures(surround([True, False, True]))
    inputs = {given.name: getattr(rig, given.name).numpy() for given in session.get_inputs()}
    assert {"images", "present"} <= inputs.keys()
    (disparity,) = session.run(["disparity"], inputs)
    with torch.inference_mode():
        np.testing.assert_allclose(disparity, build_depth_network(spec)(rig).numpy(), rtol=1e-4)


def test_export_of_a_network_without_that_engine_is_refused(spec, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(MeanFeatureNet, "engines", ("torch_eager",))
    path = tmp_path / "toy.safetensors"
    save_checkpoint(path, spec, build_depth_network(spec).state_dict())
    assert main(["export", str(path)]) == 1
    assert f"backend onnxruntime cannot run the network {KIND}, resnet18" in capsys.readouterr().err
    assert not path.with_suffix(".onnx").exists()


def test_its_checkpoint_names_it_and_builds_it_again(spec, tmp_path):
    path, network = tmp_path / "toy.safetensors", build_depth_network(spec)
    save_checkpoint(path, spec, network.state_dict())
    loaded = load_checkpoint(path)
    assert loaded.spec == spec
    assert isinstance(loaded.build_depth_net(), MeanFeatureNet)


def test_a_checkpoint_of_an_unknown_kind_is_refused_with_the_kinds_known(spec, tmp_path, monkeypatch):
    path = tmp_path / "toy.safetensors"
    save_checkpoint(path, spec, build_depth_network(spec).state_dict())
    monkeypatch.undo()
    with pytest.raises(
        CheckpointError, match=r"toy\.safetensors: spec: network is 'mean_feature': expected one of per_camera"
    ):
        load_checkpoint(path)
