# SPDX-License-Identifier: Apache-2.0
"""SurroundDepth on any rig: what holds of its transformers and its depth, whatever the weights are."""

import pytest
import torch
from torch import Tensor

from cvcdepth_core.errors import CheckpointError, ConfigError
from cvcdepth_core.networks import DepthModelSpec, PoseNet, RigImages, build_depth_network
from cvcdepth_core.networks.checkpoint import import_released, load_checkpoint, save_checkpoint
from cvcdepth_core.networks.cross_view import (
    DECODER_NAMES,
    ENCODER_NAMES,
    CrossViewDepthNet,
    CrossViewSpec,
    CrossViewTransformer,
)
from cvcdepth_core.networks.vfdepth import renamed

HEIGHT, WIDTH = 64, 96
SPEC = DepthModelSpec(
    network="surrounddepth",
    encoder="efficientnet_lite0",
    height=HEIGHT,
    width=WIDTH,
    min_depth=0.5,
    max_depth=50,
    cross_view=CrossViewSpec(blocks=2),
)

RELEASED = DepthModelSpec(
    network="surrounddepth",
    height=HEIGHT,
    width=WIDTH,
    min_depth=0.5,
    max_depth=50,
    cross_view=CrossViewSpec(blocks=1, scales=4, released_layout=True),
)


def rig_of(cameras: int, samples: int = 1) -> RigImages:
    """Pictures; the network looks at nothing else."""
    generator = torch.Generator().manual_seed(cameras)
    images = torch.rand(samples, cameras, 3, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    shape = (samples, cameras)
    return RigImages(
        images,
        torch.eye(3).expand(*shape, 3, 3),
        torch.eye(4).expand(*shape, 4, 4),
        torch.ones(shape, dtype=torch.bool),
        torch.ones_like(images[:, :, :1]),
    )


@pytest.fixture(scope="module", params=[False, True], ids=["corrected", "released"])
def network(request) -> CrossViewDepthNet:
    torch.manual_seed(1)
    layout = SPEC.cross_view.model_copy(update={"released_layout": request.param})
    return build_depth_network(SPEC.model_copy(update={"cross_view": layout})).double().eval()


def apart(ours: Tensor, expected: Tensor) -> float:
    return float((ours - expected).detach().abs().max())


@torch.inference_mode()
@pytest.mark.parametrize("cameras", [1, 2, 3, 4, 5, 6, 7])
def test_any_number_of_cameras_in_any_order(network, cameras):
    rig = rig_of(cameras)
    disparity = network(rig)
    assert disparity.shape == (1, cameras, 1, HEIGHT, WIDTH)
    order = torch.randperm(cameras, generator=torch.Generator().manual_seed(2)).tolist()
    assert apart(network(rig.of_cameras(order)), disparity[:, order]) < 1e-12


@torch.inference_mode()
def test_a_dead_camera_and_one_that_is_not_there_are_the_same_for_the_others(network):
    rig, living = rig_of(4), [0, 1, 3]
    dead = rig.present.clone()
    dead[:, 2] = False
    without = network(rig.of_cameras(living))
    assert apart(network(rig._replace(present=dead))[:, living], without) < 1e-12
    assert apart(network(rig)[:, living], without) > 1e-9
    assert network(rig._replace(present=torch.zeros_like(dead))).isfinite().all()


@torch.inference_mode()
def test_samples_of_a_batch_do_not_know_of_each_other(network):
    rig = rig_of(3, samples=2)
    seen = rig.present.clone()
    seen[1, 0] = False
    rig = rig._replace(present=seen)
    both = network(rig)
    for sample in (0, 1):
        alone = network(RigImages(*(part[sample : sample + 1] for part in rig)))
        assert apart(alone, both[sample : sample + 1]) < 1e-12


@torch.inference_mode()
def test_every_camera_sees_every_others_picture_and_only_in_its_own_layout():
    torch.manual_seed(3)
    features = torch.rand(1, 4, 64, 16, 24, dtype=torch.float64)
    changed, seen = features.clone(), torch.ones(1, 4, dtype=torch.bool)
    changed[:, 2] = 1 - changed[:, 2]
    made = {
        layout: CrossViewTransformer(64, 1, CrossViewSpec(released_layout=layout)).double() for layout in (True, False)
    }
    made[False].load_state_dict(made[True].state_dict())
    answers = {layout: one(features, seen) for layout, one in made.items()}
    for layout, one in made.items():
        assert float((one(changed, seen) - answers[layout]).abs().amax((0, 2, 3, 4)).min()) > 1e-9
    assert apart(answers[True], answers[False]) > 1e-3


def test_a_checkpoint_carries_the_transformers_form(network, tmp_path):
    spec = SPEC.model_copy(update={"cross_view": network.cross_view})
    save_checkpoint(tmp_path / "a.safetensors", spec, network.state_dict())
    loaded = load_checkpoint(tmp_path / "a.safetensors")
    assert loaded.spec.cross_view == network.cross_view
    with torch.inference_mode():
        assert apart(loaded.build_depth_net().double()(rig_of(2)), network(rig_of(2))) < 1e-6


def test_transformers_are_the_usual_ones_where_none_are_given_and_refused_for_other_networks():
    sizes = {"height": HEIGHT, "width": WIDTH, "min_depth": 1, "max_depth": 50}
    assert DepthModelSpec(network="surrounddepth", **sizes).cross_view == CrossViewSpec()
    with pytest.raises(ValueError, match="cross_view is given, but the network per_camera has none"):
        DepthModelSpec(cross_view=CrossViewSpec(), **sizes)


def test_heads_that_do_not_divide_the_encoders_widths_are_refused_with_both():
    heads = SPEC.model_copy(update={"cross_view": CrossViewSpec(heads=7)})
    with pytest.raises(ConfigError, match=r"heads is 7, which does not divide the widths of efficientnet_lite0: \("):
        build_depth_network(heads)


@pytest.fixture
def released(tmp_path):
    """Four files as SurroundDepth's authors release them, with random weights, and the networks that they come from."""
    torch.manual_seed(5)
    depth, pose = build_depth_network(RELEASED), PoseNet(RELEASED.encoder)
    theirs = renamed(depth.state_dict(), {ours: name for name, ours in (DECODER_NAMES | ENCODER_NAMES).items()})
    encoder = {key: value for key, value in theirs.items() if key.startswith("encoder.")}
    classifier = {"encoder.fc.weight": torch.zeros(1000, 512), "encoder.fc.bias": torch.zeros(1000)}
    torch.save(encoder | classifier | {"height": 64, "width": 96, "use_stereo": False}, tmp_path / "encoder.pth")
    torch.save({key: value for key, value in theirs.items() if key not in encoder}, tmp_path / "depth.pth")
    motions = {key: value for key, value in pose.state_dict().items() if key.startswith("pose_decoder.")}
    motions = renamed(motions, {"pose_decoder.": ""})
    for key in ("net.3.weight", "net.3.bias"):
        motions[key] = torch.cat([motions[key], torch.ones_like(motions[key])])
    torch.save(motions, tmp_path / "pose.pth")
    of_encoder = renamed(pose.pose_encoder.state_dict(), {"encoder.": "encoder."})
    torch.save(of_encoder | classifier, tmp_path / "pose_encoder.pth")
    return tmp_path, depth, pose


def test_released_weights_are_imported_without_the_parts_that_are_never_used(released):
    directory, depth, pose = released
    imported = import_released(directory, RELEASED)
    for found, network in ((imported.depth_net, depth), (imported.pose_net, pose)):
        assert found.keys() == network.state_dict().keys()
        assert all(torch.equal(found[key], value) for key, value in network.state_dict().items())


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("depth", {"decoder.99.bias": torch.zeros(1)}, r"unexpected depth_decoder.decoder.99.bias"),
        ("pose", {"net.0.bias": torch.zeros(3)}, r"pose.pth: .*misshapen pose_decoder.net.0.bias is \[3\]"),
        ("encoder", {"note": "hello"}, "encoder.pth: holds a dict, expected a plain dictionary of tensors"),
    ],
)
def test_released_weights_that_do_not_fit_are_refused_by_name(released, part, change, message):
    path = released[0] / f"{part}.pth"
    torch.save(torch.load(path) | change, path)
    with pytest.raises(CheckpointError, match=message):
        import_released(released[0], RELEASED)
