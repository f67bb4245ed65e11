# SPDX-License-Identifier: Apache-2.0
"""The EfficientNet-Lite0 encoder against another implementation of it.

`efficientnet_lite0_features.npz` holds what the package `efficientnet-lite-pytorch` 0.1.0 computes with `imported_state`.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from cvcdepth_core.checkpoint import load_imagenet_encoder, load_network_state
from cvcdepth_core.errors import CheckpointError
from cvcdepth_core.networks import DepthNet, PoseNet
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
    disparity = depth_net(torch.rand(2, 3, 64, 96))
    axis_angle, translation = pose_net(torch.rand(2, 1, 3, 64, 96), torch.rand(2, 1, 3, 64, 96))
    assert disparity.shape == (2, 1, 64, 96)
    (disparity.square().sum() + axis_angle.sum() + translation.square().sum()).backward()
    for network in (depth_net, pose_net):
        assert not [name for name, value in network.named_parameters() if value.grad is None]
