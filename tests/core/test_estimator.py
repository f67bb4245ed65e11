# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from recordings import SAMPLE

from cvcdepth_core.estimator import DepthEstimator, SurroundDepthEstimator
from cvcdepth_core.networks.registry import DepthModelSpec
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
