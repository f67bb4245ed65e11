# SPDX-License-Identifier: Apache-2.0
"""The networks: sizes, ranges, refusals. Their values are compared in test_golden.py."""

import pytest
import torch

from cvcdepth_core.errors import ConfigError, ImageError
from cvcdepth_core.networks import DepthNet, PoseNet, disparity_to_depth


@pytest.mark.parametrize(
    ("encoder", "depth", "pose"), [("resnet18", 14327217, 12498950), ("resnet34", 24435377, 22607110)]
)
def test_networks_have_the_published_number_of_parameters(encoder, depth, pose):
    assert sum(parameter.numel() for parameter in DepthNet(encoder).parameters()) == depth
    assert sum(parameter.numel() for parameter in PoseNet(encoder).parameters()) == pose


@pytest.mark.parametrize("train", [True, False])
def test_depth_network_gives_one_disparity_per_pixel_at_any_multiple_of_32(train):
    network = DepthNet().train(train)
    for height, width in ((64, 96), (96, 64)):
        disparity = network.disparity(torch.rand(2, 3, height, width))
        assert disparity.shape == (2, 1, height, width)
        assert 0 < float(disparity.detach().min()) <= float(disparity.detach().max()) < 1


@pytest.mark.parametrize(("height", "width"), [(380, 640), (384, 650), (32, 64)])
def test_an_input_of_a_size_that_does_not_fit_is_refused_with_that_size(height, width):
    with pytest.raises(ImageError, match=rf"{width}x{height} .* multiples of 32 and at least 64"):
        DepthNet().disparity(torch.rand(1, 3, height, width))


@pytest.mark.parametrize("network", [DepthNet, PoseNet])
def test_an_unknown_encoder_is_refused_with_the_known_ones(network):
    with pytest.raises(ConfigError, match=r"'resnet50'.*resnet18, resnet34"):
        network("resnet50")


def test_depth_spans_the_range_and_grows_with_the_focal_length():
    disparity = torch.tensor([0.0, 1.0]).view(1, 2, 1, 1, 1).expand(2, 2, 1, 1, 1)
    fx = torch.tensor([[300.0, 300.0], [600.0, 600.0]])
    depth = disparity_to_depth(disparity, fx, 1.5, 200.0)
    torch.testing.assert_close(depth.flatten(), torch.tensor([200.0, 1.5, 400.0, 3.0]))


def test_pose_network_fuses_any_number_of_views_whatever_their_order():
    network = PoseNet().eval()
    earlier, later = torch.rand(2, 3, 3, 64, 64), torch.rand(2, 3, 3, 64, 64)
    axis_angle, translation = network(earlier, later)
    assert axis_angle.shape == translation.shape == (2, 3)
    turned = network(earlier.roll(1, dims=1), later.roll(1, dims=1))
    torch.testing.assert_close(turned, (axis_angle, translation), rtol=1e-4, atol=1e-7)


def test_predicted_translations_stay_within_four_metres():
    network = PoseNet().eval()
    torch.nn.init.constant_(network.pose_decoder.net[3].bias, 1e4)
    _, translation = network(torch.rand(1, 1, 3, 64, 64), torch.rand(1, 1, 3, 64, 64))
    torch.testing.assert_close(translation.detach(), torch.full((1, 3), 4.0))
