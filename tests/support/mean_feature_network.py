# SPDX-License-Identifier: Apache-2.0
"""The smallest network that looks at a whole rig: each camera's deepest features have the mean of all added."""

from typing import ClassVar

import torch
from torch import Tensor

from cvcdepth_core.networks import NETWORKS, DepthModelSpec, DepthNet, DepthNetwork, RigImages

KIND = "mean_feature"
SPEC_FIELDS = {"network": KIND, "encoder": "resnet18", "height": 64, "width": 96, "min_depth": 0.5, "max_depth": 100.0}


class MeanFeatureNet(DepthNetwork):
    """With the weights and the state of the published network; absent cameras are left out of the mean."""

    independent: ClassVar[bool] = False
    engines: ClassVar[tuple[str, ...]] = ("onnxruntime", "torch_eager")

    def __init__(self, encoder: str) -> None:
        super().__init__()
        network = DepthNet(encoder)
        self.depth_encoder, self.depth_decoder = network.depth_encoder, network.depth_decoder

    def forward(self, rig: RigImages) -> Tensor:
        features = self.depth_encoder(rig.images.flatten(0, 1))
        deepest = features[-1].view(*rig.images.shape[:2], *features[-1].shape[1:])
        weights = rig.present[:, :, None, None, None].to(deepest.dtype)
        mean = (deepest * weights).sum(1, keepdim=True) / weights.sum(1, keepdim=True)
        disparity = self.depth_decoder([*features[:-1], (deepest + 5 * mean).flatten(0, 1)])
        return disparity.view(*rig.images.shape[:2], *disparity.shape[1:])


def lively_mean_feature_net(spec: DepthModelSpec) -> MeanFeatureNet:
    """Random weights, strong enough that disparity varies and every camera matters to every other."""
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(3)
        network = MeanFeatureNet(spec.encoder)
        for parameter in network.depth_decoder.parameters():
            parameter.mul_(1.8)
    return network.eval()


def register(monkeypatch) -> DepthModelSpec:
    """Make the kind known for one test; return the spec of such a network."""
    monkeypatch.setitem(NETWORKS, KIND, lively_mean_feature_net)
    return DepthModelSpec(**SPEC_FIELDS)
