# SPDX-License-Identifier: Apache-2.0
"""The EfficientNet-Lite0 encoder against another implementation of it.

`efficientnet_lite0_features.npz` holds what the package `efficientnet-lite-pytorch` computes with `imported_state`.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from repository import ROOT

from cvcdepth_core.errors import CheckpointError
from cvcdepth_core.networks import DepthNet, PoseNet, disparity_to_depth
from cvcdepth_core.networks.checkpoint import load_checkpoint, load_imagenet_encoder, load_network_state
from cvcdepth_core.networks.efficientnet_lite import EfficientNetLite0Encoder

GOLDEN = Path(__file__).parent / "efficientnet_lite0_features.npz"


def imported_state(names, shapes):
    """Random weights by the names and shapes of the published file, the same on every machine."""
    generator = np.random.default_rng(0)
    state = {}
    for name, text in zip(names.tolist(), shapes.tolist(), strict=True):
        shape = tuple(int(number) for number in text.split(",") if number)
        values = generator.random(shape, dtype=np.float32)
        if len(shape) > 1:
            values = (2 * values - 1) * np.sqrt(6 / np.prod(shape[1:]), dtype=np.float32)
        elif name.endswith(("weight", "running_var")):
            values = values + 0.5
        state[name] = torch.zeros((), dtype=torch.long) if not shape else torch.from_numpy(values)
    return state


@pytest.fixture
def golden():
    with np.load(GOLDEN) as arrays:
        return dict(arrays)


def test_imported_weights_give_the_features_of_the_implementation_they_come_from(golden):
    encoder = EfficientNetLite0Encoder().eval()
    state = encoder.adapt_imagenet_state(imported_state(golden["names"], golden["shapes"]))
    load_network_state(encoder.encoder, state, origin="golden")
    with torch.no_grad():
        features = encoder(torch.from_numpy(golden["image"]))
    for index, feature in enumerate(features):
        expected = torch.from_numpy(golden[f"features_{index}"])
        torch.testing.assert_close(feature, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


def test_a_pair_of_equal_images_gives_the_features_of_one(golden):
    state = imported_state(golden["names"], golden["shapes"])
    single, pair = EfficientNetLite0Encoder().eval(), EfficientNetLite0Encoder(in_channels=6).eval()
    for encoder in (single, pair):
        load_network_state(encoder.encoder, encoder.adapt_imagenet_state(state), origin="golden")
    image = torch.from_numpy(golden["image"])
    with torch.no_grad():
        torch.testing.assert_close(pair(torch.cat([image, image], 1))[-1], single(image)[-1], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda state: state.pop("_blocks.7._bn1.running_var"), "missing stages.3.2.depthwise_norm.running_var"),
        (lambda state: state.update({"_blocks.16._bn1.weight": torch.ones(3)}), "unexpected _blocks.16._bn1.weight"),
        (lambda state: state.update({"_swish.weight": torch.ones(3)}), "unexpected _swish.weight"),
    ],
)
def test_a_classifier_that_does_not_fit_is_refused_by_the_key(golden, tmp_path, change, named):
    state = imported_state(golden["names"], golden["shapes"])
    change(state)
    torch.save(state, tmp_path / "classifier.pth")
    with pytest.raises(CheckpointError, match=named):
        load_imagenet_encoder(EfficientNetLite0Encoder(), tmp_path / "classifier.pth")


def test_the_features_halve_the_input_five_times_with_the_announced_widths():
    encoder = EfficientNetLite0Encoder().eval()
    features = encoder(torch.rand(2, 3, 64, 96))
    assert tuple(feature.shape[1] for feature in features) == encoder.channels
    assert [tuple(feature.shape[2:]) for feature in features] == [(32, 48), (16, 24), (8, 12), (4, 6), (2, 3)]


def test_both_networks_take_the_encoder_and_train_all_of_it():
    depth_net, pose_net = DepthNet("efficientnet_lite0"), PoseNet("efficientnet_lite0")
    disparity = depth_net.disparity(torch.rand(2, 3, 64, 96))
    axis_angle, translation = pose_net(torch.rand(2, 1, 3, 64, 96), torch.rand(2, 1, 3, 64, 96))
    assert disparity.shape == (2, 1, 64, 96)
    (disparity.square().sum() + axis_angle.sum() + translation.square().sum()).backward()
    for network in (depth_net, pose_net):
        assert not [name for name, value in network.named_parameters() if value.grad is None]


def test_the_import_tool_makes_a_checkpoint_that_begins_at_the_initial_depth(golden, tmp_path):
    torch.save(imported_state(golden["names"], golden["shapes"]), tmp_path / "classifier.pth")
    tool, config = ROOT / "tools" / "imagenet_checkpoint.py", ROOT / "config" / "training" / "default_model.yaml"
    out = tmp_path / "start.safetensors"
    subprocess.run(
        [sys.executable, tool, config, tmp_path / "classifier.pth", "-o", out, "--initial-depth", "5"],
        check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    checkpoint = load_checkpoint(out)
    stem = checkpoint.depth_net["depth_encoder.encoder.stem.weight"]
    assert torch.equal(stem, imported_state(golden["names"], golden["shapes"])["_conv_stem.weight"])
    spec = checkpoint.spec
    disparity = torch.sigmoid(checkpoint.depth_net["depth_decoder.decoder.10.conv.bias"])
    depth = disparity_to_depth(
        disparity.view(1, 1, 1), torch.tensor(spec.focal_scale), spec.min_depth, spec.max_depth, spec.focal_scale
    )
    assert float(depth) == pytest.approx(5, rel=1e-4)
    assert checkpoint.pose_net
