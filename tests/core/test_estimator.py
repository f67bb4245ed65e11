# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from recordings import SAMPLE

from cvcdepth_core.estimator import DepthEstimator, SurroundDepthEstimator, untrained_network
from cvcdepth_core.networks import DepthNet
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.surround_depth import SurroundPictures
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.recordings.rig import discover_rig

HEIGHT, WIDTH = 96, 160


@pytest.fixture(scope="module")
def surround():
    with open_recording(SAMPLE) as recording:
        rig = discover_rig(recording).complete()
    spec = DepthModelSpec(encoder="resnet18", height=HEIGHT, width=WIDTH, min_depth=1.5, max_depth=200.0)
    return SurroundDepthEstimator(rig, DepthEstimator.untrained(spec, "cpu"))


@pytest.fixture(scope="module")
def pictures():
    return list(np.random.default_rng(0).integers(0, 256, (6, HEIGHT, WIDTH, 3), dtype=np.uint8))


def test_cameras_without_a_picture_have_no_depth_and_leave_the_others_alone(surround, pictures):
    whole = surround.estimate(pictures)
    some = surround.estimate([None, pictures[1], None, None, pictures[4], None])
    assert whole.present.all()
    assert some.present.tolist() == [False, True, False, False, True, False]
    for camera in (1, 4):
        np.testing.assert_allclose(some.depth[camera], whole.depth[camera], rtol=1e-4)
        np.testing.assert_array_equal(some.pictures[camera], pictures[camera])
    for camera in (0, 2, 3, 5):
        assert np.isnan(some.depth[camera]).all()
        assert not some.pictures[camera].any()


def test_a_set_without_any_picture_costs_no_inference(surround):
    surround_depth = surround.estimate([None] * 6)
    assert surround_depth.depth.shape == (6, HEIGHT, WIDTH)
    assert np.isnan(surround_depth.depth).all()
    assert not surround_depth.present.any()


def test_depth_is_unknown_where_the_camera_sees_nothing(surround, pictures):
    depth = surround.estimate(pictures).depth
    np.testing.assert_array_equal(np.isfinite(depth), surround.preprocessor.valid)


@pytest.mark.parametrize("fusion", ["depth", "inverse_depth"])
def test_flip_fusion_shows_the_mirrored_rig_to_a_network_that_looks_at_mounts(surround, pictures, fusion):
    spec, mounts = surround.estimator.spec, []

    class MountWatcher(DepthNet):
        def forward(self, rig):
            mounts.append((rig.base_T_camera[0].numpy().copy(), rig.intrinsics[0].numpy().copy()))
            return super().forward(rig)

    network = MountWatcher("resnet18").eval()
    network.load_state_dict(untrained_network(spec).state_dict())
    fused = DepthEstimator(network, spec, "watcher", "cpu", "torch_eager", flip_fusion=fusion)
    depth = SurroundDepthEstimator(surround.rig, fused).estimate(pictures).depth
    straight, mirrored = mounts[0], mounts[len(mounts) // 2]
    np.testing.assert_allclose(mirrored[0][..., 1, 3], -straight[0][..., 1, 3], atol=1e-6)
    np.testing.assert_allclose(mirrored[1][..., 0, 2], WIDTH - 1 - straight[1][..., 0, 2], atol=1e-3)
    plain = surround.estimate(pictures).depth
    known = np.isfinite(depth)
    np.testing.assert_array_equal(known, np.isfinite(plain))
    assert np.abs(depth / plain - 1)[known].max() > 1e-3
    assert fused.model_id.endswith(f", flip fusion of {fusion.replace('_', ' ')}")


def test_flip_fused_depth_of_mirrored_pictures_is_the_mirrored_depth(surround, pictures):
    """In the middle columns, where both passes count alike; a network that sees each camera by itself."""
    fused = DepthEstimator.untrained(surround.estimator.spec, "cpu", backend="torch_eager", flip_fusion="depth")
    both = SurroundPictures(
        pictures=np.stack([pictures[0], pictures[0][:, ::-1]]),
        present=np.array([True, True]),
        intrinsics=surround.preprocessor.intrinsics[[0, 0]],
        base_T_camera=np.tile(np.eye(4), (2, 1, 1)),
        valid=np.ones((2, HEIGHT, WIDTH), bool),
    )
    depth = fused.estimate(both)
    middle = slice(WIDTH // 8, -WIDTH // 8)
    np.testing.assert_allclose(depth[1, :, ::-1][:, middle], depth[0][:, middle], rtol=1e-4)
