# SPDX-License-Identifier: Apache-2.0
"""The network that is told its rig: what it is told, what it makes of it, and every engine that runs it."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from torch import Tensor

from cvcdepth_core.engines import build_engine, is_installed, selection
from cvcdepth_core.engines.engine import DisparityEngine
from cvcdepth_core.engines.example_rigs import ring_of_cameras, ring_of_pictures
from cvcdepth_core.engines.selection import choices_of_auto
from cvcdepth_core.errors import ConfigError, ImageError
from cvcdepth_core.estimator import DepthEstimator, PredictedDepth
from cvcdepth_core.model_choices import BACKENDS
from cvcdepth_core.networks import DepthModelSpec, RigImages, build_depth_network, disparity_to_depth
from cvcdepth_core.networks.checkpoint import load_checkpoint, save_checkpoint
from cvcdepth_core.networks.mirroring import mirror_rig
from cvcdepth_core.networks.rig_conditioned import CHANNELS, RigConditionedNet
from cvcdepth_ros.bag_replay import main

FIELDS = {"encoder": "efficientnet_lite0", "height": 64, "width": 96, "min_depth": 0.4, "max_depth": 250.0}
SPEC = DepthModelSpec(network="rig_conditioned", focal_scale=48.0, **FIELDS)
OTHERS = [name for name in BACKENDS if name not in (*RigConditionedNet.engines, "auto")]
ENGINES = [
    pytest.param(name, marks=pytest.mark.skipif(not is_installed(name), reason=f"{name} is not installed"))
    for name in RigConditionedNet.engines
]


@pytest.fixture(scope="module")
def network() -> RigConditionedNet:
    """Random weights, strong enough that what it is told matters."""
    torch.manual_seed(3)
    built = build_depth_network(SPEC).eval()
    assert isinstance(built, RigConditionedNet)
    with torch.no_grad():
        built.rig_stem.weight.normal_(0, 0.3)
        for parameter in built.depth_decoder.parameters():
            parameter.mul_(1.5)
    return built


def depth(network: RigConditionedNet, rig: RigImages) -> Tensor:
    with torch.inference_mode():
        disparity = network(rig)
    return disparity_to_depth(disparity, rig.intrinsics[..., 0, 0], SPEC.min_depth, SPEC.max_depth, SPEC.focal_scale)


def with_bias(network: RigConditionedNet, output: int, bias: float) -> RigConditionedNet:
    """A network whose output (0 depth, 1 gate, 2 sky) is this everywhere."""
    changed = copy.deepcopy(network)
    with torch.no_grad():
        changed.depth_decoder.head.conv.weight[4 * output : 4 * output + 4] = 0
        changed.depth_decoder.head.conv.bias[4 * output : 4 * output + 4] = bias
    return changed


def ground_depth(rig: RigImages) -> Tensor:
    """Depth of the plane z = 0 along each pixel's ray, [B, N, 1, H, W], by intersecting lines; inf above it."""
    height, width = rig.images.shape[-2:]
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)])
    rays = rig.base_T_camera[..., :3, :3].double() @ torch.linalg.inv(rig.intrinsics.double())
    down = -torch.einsum("bnj,jhw->bnhw", rays[..., 2, :], pixels)[:, :, None]
    heights = rig.base_T_camera[..., 2, 3].double()[..., None, None, None]
    return torch.where(down > 0, heights / down, torch.inf)


def test_with_its_gate_open_it_gives_the_depth_of_flat_ground(network):
    rig = ring_of_cameras(SPEC.height, SPEC.width)
    opened = with_bias(with_bias(network, 1, 30.0), 2, -30.0)
    exact = ground_depth(rig)
    near = exact < 100
    assert 0.3 < float(near.double().mean()) < 0.6
    torch.testing.assert_close(depth(opened, rig).double()[near], exact[near], rtol=1e-4, atol=1e-4)


def test_where_it_sees_the_sky_depth_is_the_farthest_there_is(network):
    rig = ring_of_cameras(SPEC.height, SPEC.width)
    farthest = SPEC.max_depth * rig.intrinsics[..., 0, 0] / SPEC.focal_scale
    found = depth(with_bias(network, 2, 30.0), rig)
    torch.testing.assert_close(found, farthest[..., None, None, None].expand_as(found))


def test_a_higher_camera_sees_the_same_picture_at_a_larger_scale(network):
    rig = ring_of_cameras(SPEC.height, SPEC.width)
    higher = rig.base_T_camera.clone()
    higher[..., 2, 3] *= 1.5
    opened = with_bias(with_bias(network, 1, 30.0), 2, -30.0)
    low, high = (depth(opened, rig._replace(base_T_camera=poses)) for poses in (rig.base_T_camera, higher))
    near = ground_depth(rig) < 60
    torch.testing.assert_close(high[near], 1.5 * low[near], rtol=1e-4, atol=1e-4)


def test_what_it_is_told_changes_nothing_before_it_has_learned():
    rig = ring_of_cameras(SPEC.height, SPEC.width)
    fresh = build_depth_network(SPEC).eval()
    assert isinstance(fresh, RigConditionedNet)
    told = fresh.conditioning(rig)[0, :, :CHANNELS]
    with torch.inference_mode():
        with_rig = fresh._features(rig.images[0], told)
        without = fresh.depth_encoder(rig.images[0])
    assert all(torch.equal(a, b) for a, b in zip(with_rig, without, strict=True))


def test_the_mirrored_world_is_told_mirrored_with_left_and_right_exchanged(network):
    rig = ring_of_cameras(SPEC.height, SPEC.width)
    signs = torch.ones(CHANNELS + 1)
    signs[[4, 5]] = -1.0  # direction to the left; x
    mirrored = network.conditioning(mirror_rig(rig, torch.tensor([True])))
    expected = network.conditioning(rig).flip(-1) * signs[:, None, None]
    torch.testing.assert_close(mirrored, expected, rtol=1e-4, atol=1e-5)


def test_its_cameras_do_not_depend_on_each_other(network):
    rig = ring_of_cameras(SPEC.height, SPEC.width)
    together = depth(network, rig)
    for camera in (0, 4):
        torch.testing.assert_close(together[:, [camera]], depth(network, rig.of_cameras([camera])), rtol=1e-4, atol=0)


def test_batch_statistics_stay_as_they_were_when_it_trains(network):
    trained = copy.deepcopy(network).train()
    before = trained.depth_encoder.encoder.stem_norm.running_mean.clone()
    trained(ring_of_cameras(SPEC.height, SPEC.width))
    assert trained.training
    assert torch.equal(before, trained.depth_encoder.encoder.stem_norm.running_mean)


def test_a_picture_of_a_size_that_it_cannot_take_is_refused(network):
    with pytest.raises(ImageError, match=r"input is 100x64 .width x height., both must be multiples of 32"):
        network(ring_of_cameras(64, 100))


def test_its_encoder_is_its_own():
    with pytest.raises(ValidationError, match="encoder is resnet18, but the network rig_conditioned has efficientnet"):
        DepthModelSpec.model_validate(SPEC.model_dump() | {"encoder": "resnet18"})


def test_a_checkpoint_keeps_it(network, tmp_path):
    save_checkpoint(tmp_path / "model.safetensors", SPEC, network.state_dict())
    loaded = load_checkpoint(tmp_path / "model.safetensors").build_depth_net()
    rig = ring_of_cameras(SPEC.height, SPEC.width)
    assert torch.equal(depth(network, rig), depth(loaded, rig))


@pytest.mark.parametrize("backend", ENGINES)
def test_every_engine_that_it_allows_gives_its_depth_for_every_rig_in_turn(network, backend: str):
    engine = build_engine(network, SPEC, "cpu", backend)
    first = ring_of_pictures(SPEC.height, SPEC.width)
    poses = first.base_T_camera.copy()
    poses[:, 2, 3] = np.linspace(0.8, 2.5, len(poses))
    second = replace(first, base_T_camera=poses)
    exact = [network.double()(RigImages.from_pictures(p).to(dtype=torch.float64))[0] for p in (first, second)]
    network.float()
    assert (exact[1] / exact[0] - 1).abs().median() > 1e-2
    for pictures, wanted in ((first, exact[0]), (second, exact[1]), (first, exact[0])):
        torch.testing.assert_close(engine.disparity(pictures).double(), wanted.detach(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("backend", ENGINES)
def test_every_engine_tells_the_sky_and_the_error_that_is_expected(network, backend: str):
    pictures = ring_of_pictures(SPEC.height, SPEC.width)
    found = build_engine(network, SPEC, "cpu", backend).details(pictures)
    exact = copy.deepcopy(network).double().details(RigImages.from_pictures(pictures).to(dtype=torch.float64))
    for one, wanted in zip(found, exact, strict=True):
        assert wanted.std() > 1e-3
        torch.testing.assert_close(one.double(), wanted[0].detach(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("fusion", ["none", "depth", "inverse_depth"])
def test_the_estimator_tells_how_likely_each_pixel_is_sky(network, fusion: str):
    pictures = ring_of_pictures(SPEC.height, SPEC.width)

    def told(bias: float) -> PredictedDepth:
        changed = with_bias(network, 2, bias)
        return DepthEstimator(changed, SPEC, "toy", "cpu", "torch", flip_fusion=fusion).details(pictures)

    for bias in (3.0, -3.0):
        np.testing.assert_allclose(told(bias).sky, 1 / (1 + np.exp(-bias)), rtol=1e-5)
    assert told(3.0).log_uncertainty.shape == told(3.0).depth.shape == pictures.valid.shape


def test_auto_takes_the_best_of_its_engines_that_is_installed(network, monkeypatch):
    cpu, cuda = torch.device("cpu"), torch.device("cuda")
    assert set(choices_of_auto(network, SPEC, cpu)) == {name for name in network.engines if is_installed(name)}
    assert choices_of_auto(network, SPEC, cuda)[0] == "torch"
    assert choices_of_auto(network, SPEC, cuda)[-1] == "torch_eager"
    monkeypatch.setattr(selection, "find_spec", lambda _: None)
    assert choices_of_auto(network, SPEC, cpu) == ["torch", "torch_eager"]
    assert build_engine(network, SPEC, "cpu").name.startswith("torch ")


@pytest.mark.parametrize("backend", OTHERS)
def test_every_other_engine_refuses_it_by_name(network, backend: str):
    with pytest.raises(ConfigError, match=f"backend {backend} cannot run the network rig_conditioned, efficientnet_li"):
        build_engine(network, SPEC, "cpu", backend)


def test_what_it_is_told_is_made_once_for_each_calibration(network, monkeypatch):
    engine: DisparityEngine = build_engine(network, SPEC, "cpu", "torch_eager")._engine
    calls = []
    made = RigConditionedNet.conditioning
    monkeypatch.setattr(RigConditionedNet, "conditioning", lambda self, rig: calls.append(1) or made(self, rig))
    rig = ring_of_cameras(SPEC.height, SPEC.width).of_cameras([0, 1])
    for _ in range(3):
        engine.disparity(rig)
    assert len(calls) == 2
    engine.disparity(rig._replace(base_T_camera=rig.base_T_camera + 0.01))
    assert len(calls) == 4


def test_what_export_writes_down_is_enough_to_tell_it_a_rig(network, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    checkpoint = tmp_path / "model.safetensors"
    save_checkpoint(checkpoint, SPEC, network.state_dict())
    assert main(["export", str(checkpoint)]) == 0
    described = json.loads((tmp_path / "model.json").read_text())
    session = onnxruntime.InferenceSession(tmp_path / "model.onnx")
    assert [output.name for output in session.get_outputs()] == ["disparity", "sky", "log_uncertainty"]
    rig = ring_of_cameras(SPEC.height, SPEC.width).of_cameras([2])
    K, pose = rig.intrinsics[0, 0].double().numpy(), rig.base_T_camera[0, 0].double().numpy()
    v, u = np.mgrid[: SPEC.height, : SPEC.width]
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    forward, left, up = np.tensordot(pose[:3, :3], np.stack([x, y, np.ones_like(x)]), axes=1)
    names = vars(np) | {"x": x, "y": y, "forward": forward, "left": left, "up": up}
    names |= {"height": pose[2, 3], "fx": K[0, 0], "focal_scale": described["focal_scale"]}
    for name in ("level", "ground", "near", "below"):
        names[name] = eval(described["conditioning"][name], {}, names)
    channels = [eval(text, {}, names) for text in described["conditioning"]["channels"]]
    found = np.stack([np.broadcast_to(channel, x.shape) for channel in channels])
    np.testing.assert_allclose(found, network.conditioning(rig)[0, 0].numpy(), rtol=1e-4, atol=1e-5)
