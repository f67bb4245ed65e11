# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from recordings import SAMPLE

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.estimator import SurroundDepthEstimator
from cvcdepth_core.pointcloud import CloudLimits, merged_cloud
from cvcdepth_core.rendering.agreement import PosedDepth
from cvcdepth_core.scoring.consistency import spatial_rows
from cvcdepth_core.scoring.references import best_constant, constant_depth, ground_plane_depth
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.recordings.rig import discover_rig


@pytest.fixture(scope="module")
def rig():
    with open_recording(SAMPLE) as recording:
        return discover_rig(recording).complete()


def estimate(rig, predictor):
    surround = SurroundDepthEstimator(rig, predictor)
    pictures = [np.zeros((predictor.spec.height, predictor.spec.width, 3), np.uint8)] * len(rig.cameras)
    return surround.estimate(pictures)


def test_constant_depth_is_the_same_everywhere(rig):
    depth = estimate(rig, constant_depth(rig, 7.5, 96, 160)).depth
    assert depth.shape == (6, 96, 160)
    assert (depth == 7.5).all()


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_the_best_constant_has_the_least_relative_error_of_all(count):
    truth = np.random.default_rng(count).uniform(1.0, 80.0, count)
    found = best_constant(truth)
    errors = [np.abs(candidate - truth) @ (1 / truth) for candidate in (found, *np.linspace(0.5, 90.0, 2000))]
    assert errors[0] <= min(errors) + 1e-12
    assert np.isnan(best_constant(truth[:0]))


def test_every_point_of_the_ground_plane_lies_on_it_unless_it_is_at_the_far_limit(rig):
    surround = estimate(rig, ground_plane_depth(rig, ground_height=-0.4, far=50.0, height=96, width=160))
    ground = merged_cloud(surround, rig, CloudLimits(max_range=49.9))
    assert len(ground) > 0.2 * surround.depth.size
    assert ground[:, 2] == pytest.approx(-0.4, abs=1e-3)
    assert surround.depth.max() == 50.0
    at_limit = surround.depth == 50.0
    assert at_limit[:, 0].all()  # the sky
    assert not at_limit[:, -1].any()


def test_the_ground_agrees_between_all_neighbours_and_a_constant_does_not(rig):
    ground = PosedDepth.from_rig(estimate(rig, ground_plane_depth(rig, height=192, width=320)), rig, None)
    constant = PosedDepth.from_rig(estimate(rig, constant_depth(rig, height=192, width=320)), rig, None)
    flat = spatial_rows(rig, ground, max_depth=30.0)
    assert all(row.agreement.percentile_90 < 1e-3 for row in flat if row.agreement.pixels)
    assert sum(row.agreement.pixels > 300 for row in flat) >= 8
    for row in spatial_rows(rig, constant, max_depth=30.0):
        assert row.agreement.median > 0.02


def test_a_predictor_made_for_another_calibration_is_refused(rig):
    predictor = ground_plane_depth(rig, height=96, width=160)
    other = replace(rig.cameras[0], calibration=rig.cameras[1].calibration)
    with pytest.raises(ConfigError, match="made for fx"):
        estimate(replace(rig, cameras=(other, *rig.cameras[1:])), predictor)


def test_impossible_references_are_refused(rig):
    with pytest.raises(ConfigError, match="constant depth is 0 m"):
        constant_depth(rig, 0)
    with pytest.raises(ConfigError, match=r"ground at z = 1\.8 m is not below camera"):
        ground_plane_depth(rig, ground_height=1.8)
    with pytest.raises(ConfigError, match="far is -1 m"):
        ground_plane_depth(rig, far=-1)
