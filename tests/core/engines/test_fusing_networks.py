# SPDX-License-Identifier: Apache-2.0
"""Networks that fuse their cameras, by the engines that they name: their own depth, dead cameras, another rig.

Every other engine refuses them.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from cvcdepth_core.engines import build_engine, is_installed
from cvcdepth_core.engines.example_rigs import ring_of_pictures
from cvcdepth_core.errors import ConfigError
from cvcdepth_core.estimator import DepthEstimator, untrained_network
from cvcdepth_core.model_choices import BACKENDS
from cvcdepth_core.networks import DepthModelSpec, DepthNetwork, RigImages, disparity_to_depth
from cvcdepth_core.networks.cross_view import CrossViewSpec
from cvcdepth_core.networks.volume import VolumeSpec
from cvcdepth_core.surround_depth import SurroundPictures

SIZES = {"encoder": "efficientnet_lite0", "height": 64, "width": 96, "min_depth": 0.5, "max_depth": 50}
VOLUME = VolumeSpec(
    voxels=(12, 12, 4),
    voxel_size=(2, 2, 1.5),
    first_voxel=(-11, -11, -1),
    nearest=1,
    farthest=10,
    steps=6,
    image_channels=8,
    voxel_channels=6,
)
SPECS = {
    "vfdepth": DepthModelSpec(network="vfdepth", volume=VOLUME, **SIZES),
    "surrounddepth": DepthModelSpec(network="surrounddepth", cross_view=CrossViewSpec(blocks=2), **SIZES),
}
ENGINES = ["torch_eager", "onnxruntime"]
SEES_THE_RIG = {"vfdepth"}


@pytest.fixture(scope="module", params=SPECS)
def spec(request) -> DepthModelSpec:
    return SPECS[request.param]


@pytest.fixture(scope="module")
def network(spec) -> DepthNetwork:
    """Random weights, strong enough that every camera matters to its neighbours."""
    network = untrained_network(spec)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if "encoder" not in name and parameter.ndim > 1:
                parameter.mul_(3.0)
    return network


@torch.inference_mode()
def exact_depth(network: DepthNetwork, spec: DepthModelSpec, pictures: SurroundPictures) -> np.ndarray:
    """The network's own answer, in float64."""
    exact = untrained_network(spec).double().eval()
    exact.load_state_dict(network.state_dict())
    disparity = exact(RigImages.from_pictures(pictures).to(dtype=torch.float64))[0]
    return disparity_to_depth(disparity, torch.as_tensor(pictures.fx), spec.min_depth, spec.max_depth)[:, 0].numpy()


@pytest.mark.parametrize(
    "backend",
    [pytest.param(name, marks=pytest.mark.skipif(not is_installed(name), reason=f"no {name}")) for name in ENGINES],
)
def test_an_engine_gives_the_networks_depth_when_pictures_cameras_and_rigs_change(network, spec, backend):
    estimator = DepthEstimator(network, spec, "small", "cpu", backend)
    first = ring_of_pictures(64, 96)
    moved = first.base_T_camera.copy()
    moved[:, 0, 3] += 0.3
    inputs = {
        "the first": first,
        "other pictures": replace(first, pictures=255 - first.pictures),
        "a dead camera": replace(first, present=np.arange(6) != 2),
        "another rig": replace(first, base_T_camera=moved),
        "the first again": first,
    }
    found = {}
    for name, pictures in inputs.items():
        found[name] = estimator.estimate(pictures)[pictures.present]
        exact = exact_depth(network, spec, pictures)[pictures.present]
        np.testing.assert_allclose(found[name], exact, rtol=5e-4, err_msg=name)
    assert exact.std() > 0.02 * exact.mean()
    for name in ("other pictures", *(["another rig"] if spec.network in SEES_THE_RIG else [])):
        assert np.abs(found[name] / found["the first"] - 1).max() > 1e-3, name
    neighbours = [1, 3]  # of the dead camera, which is left out
    assert np.abs(found["a dead camera"][[1, 2]] / found["the first"][neighbours] - 1).max() > 1e-3


@pytest.mark.parametrize("backend", [name for name in BACKENDS if name not in (*ENGINES, "auto")])
def test_every_other_engine_refuses_it_by_name(network, spec, backend):
    assert sorted(network.engines) == sorted(ENGINES)
    with pytest.raises(ConfigError, match=f"backend {backend} cannot run the network {spec.network}, efficient"):
        build_engine(network, spec, "cpu", backend)
