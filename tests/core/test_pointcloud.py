# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import SAMPLE

from cvcdepth_core.pointcloud import CloudLimits, merged_cloud, on_edges, organised_cloud, pack_rgb, thinned
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.bench.baseline_cloud import baseline_cloud
from cvcdepth_ros.recordings.rig import discover_rig

HEIGHT, WIDTH = 100, 150  # no whole number of blocks


@pytest.fixture(scope="module")
def rig():
    with open_recording(SAMPLE) as recording:
        return discover_rig(recording).complete()


@pytest.fixture(scope="module")
def surround(rig):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.1, 100.0, (6, HEIGHT, WIDTH)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = np.nan
    pictures = rng.integers(0, 256, (6, HEIGHT, WIDTH, 3), dtype=np.uint8)
    intrinsics = np.array([[160.0, 0.3, 74.0], [0, 158.0, 52.0], [0, 0, 1]])
    return SurroundDepth(depth, pictures, np.stack([intrinsics] * 6), np.ones(6, bool))


def straightforward(surround, rig, camera, stride=1):
    """Points [h, w, 3] in the base frame, in double precision and step by step."""
    v, u = np.mgrid[:HEIGHT:stride, :WIDTH:stride]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(surround.intrinsics[camera]).T
    points = rays * surround.depth[camera, ::stride, ::stride, None]
    pose = rig.cameras[camera].base_T_camera
    return points @ pose[:3, :3].T + pose[:3, 3], points


def test_the_organised_cloud_is_the_back_projected_depth_with_nan_where_unknown(surround, rig):
    cloud = organised_cloud(surround, 2)
    assert cloud.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_allclose(cloud[..., :3], straightforward(surround, rig, 2)[1], rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(np.isnan(cloud[..., 2]), np.isnan(surround.depth[2]))
    np.testing.assert_array_equal(cloud[..., 3].view(np.uint32), pack_rgb(surround.pictures[2]).view(np.uint32))


def test_colours_are_packed_as_pcl_packs_them():
    packed = pack_rgb(np.array([[[1, 2, 3], [255, 254, 253]]], np.uint8))
    assert packed.view(np.uint32).tolist() == [[0x010203, 0xFFFEFD]]


@pytest.mark.parametrize("stride", [1, 3])
def test_the_merged_cloud_has_every_known_point_inside_the_limits_in_the_base_frame(surround, rig, stride):
    cloud = merged_cloud(surround, rig, CloudLimits(stride, 2.0, 50.0))
    expected, colours = [], []
    for camera in range(6):
        depth = surround.depth[camera, ::stride, ::stride]
        inside = (depth >= 2.0) & (depth <= 50.0)
        expected.append(straightforward(surround, rig, camera, stride)[0][inside])
        colours.append(pack_rgb(surround.pictures[camera, ::stride, ::stride])[inside])
    np.testing.assert_allclose(cloud[:, :3], np.concatenate(expected), rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(cloud[:, 3].view(np.uint32), np.concatenate(colours).view(np.uint32))


def test_the_benchmarks_baseline_makes_the_same_cloud(surround, rig):
    limits = CloudLimits(2, 2.0, 50.0)
    ours, theirs = merged_cloud(surround, rig, limits), baseline_cloud(surround, rig, limits)
    np.testing.assert_allclose(ours[:, :3], theirs[:, :3], rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(ours[:, 3].view(np.uint32), theirs[:, 3].view(np.uint32))


def test_without_limits_every_known_point_is_there_and_no_other(surround, rig):
    cloud = merged_cloud(surround, rig, CloudLimits())
    assert len(cloud) == np.isfinite(surround.depth).sum()
    assert np.isfinite(cloud[:, :3]).all()


def test_cameras_that_are_missing_add_no_point(surround, rig):
    present = np.array([True, False, True, True, False, True])
    some = SurroundDepth(surround.depth, surround.pictures, surround.intrinsics, present)
    assert len(merged_cloud(some, rig, CloudLimits())) == np.isfinite(surround.depth[present]).sum()
    nobody = SurroundDepth(surround.depth, surround.pictures, surround.intrinsics, np.zeros(6, bool))
    assert merged_cloud(nobody, rig, CloudLimits()).shape == (0, 4)


@given(st.integers(0, 5000), st.floats(0.05, 20), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_thinning_keeps_the_first_point_of_every_cube(count, edge, seed):
    points = np.random.default_rng(seed).normal(0, 10, (count, 4)).astype(np.float32)
    kept = thinned(points, edge)
    cubes = np.floor(points[:, :3] * np.float32(1 / edge)).astype(int)
    _, first = np.unique(cubes, axis=0, return_index=True)
    np.testing.assert_array_equal(kept, points[np.sort(first)])


def test_thinning_the_merged_cloud_leaves_one_point_per_cube(surround, rig):
    whole = merged_cloud(surround, rig, CloudLimits(max_range=50.0))
    thin = merged_cloud(surround, rig, CloudLimits(max_range=50.0, voxel=2.0))
    np.testing.assert_array_equal(thin, thinned(whole, 2.0))
    assert 0 < len(thin) < 0.7 * len(whole)


def test_pixels_that_are_not_sure_enough_make_no_points(surround, rig):
    confidence = np.random.default_rng(1).random(surround.depth.shape).astype(np.float32)
    sure = replace(surround, confidence=confidence)
    known = ~np.isnan(surround.depth) & (confidence >= 0.7)
    assert len(merged_cloud(sure, rig, CloudLimits(min_confidence=0.7))) == known.sum()
    np.testing.assert_array_equal(np.isnan(organised_cloud(sure, 2, 0.7)[..., 0]), ~known[2])
    everything = CloudLimits()
    np.testing.assert_array_equal(merged_cloud(sure, rig, everything), merged_cloud(surround, rig, everything))


def test_where_nothing_is_known_of_confidence_nothing_is_sure(surround, rig):
    assert len(merged_cloud(surround, rig, CloudLimits(min_confidence=0.1))) == 0


def test_the_sky_makes_no_points(surround, rig):
    sky = np.random.default_rng(2).random(surround.depth.shape) < 0.3
    clear = replace(surround, sky=sky)
    assert len(merged_cloud(clear, rig, CloudLimits())) == (~sky & ~np.isnan(surround.depth)).sum()
    np.testing.assert_array_equal(np.isnan(organised_cloud(clear, 2)[..., 0]), sky[2] | np.isnan(surround.depth[2]))


def test_only_heights_inside_the_band_stay(surround, rig):
    whole = merged_cloud(surround, rig, CloudLimits())
    band = merged_cloud(surround, rig, CloudLimits(min_height=-1.0, max_height=2.5))
    np.testing.assert_array_equal(band, whole[(whole[:, 2] >= -1.0) & (whole[:, 2] <= 2.5)])


def test_pixels_between_a_post_and_the_wall_behind_it_are_edges_and_slanted_surfaces_are_none():
    focal, rows = 160.0, np.arange(100) - 20.0
    ground = np.where(rows > 4, 1.5 * focal / np.maximum(rows, 1), np.nan)[:, None].repeat(60, 1).astype(np.float32)
    assert not on_edges(ground, focal, 0.3).any()
    columns = np.arange(60) - 30.0
    wall = np.broadcast_to(
        (4.0 / (1 + 1.5 * columns / focal)).astype(np.float32), (100, 60)
    )  # passes far from the camera
    assert not on_edges(wall, focal, 0.3).any()
    depth = np.full((100, 60), 12.0, np.float32)
    depth[:, 20:30] = 4.0
    depth[:, 30:33] = (5.5, 7.5, 10.0)  # as networks join two surfaces
    edges = on_edges(depth, focal, 0.3)
    assert edges[:, 29:33].all()
    assert not edges[:, 21:29].any()
    assert not edges[:, 34:].any()


def test_edges_make_no_points_whatever_the_stride(surround, rig):
    depth = np.full(surround.depth.shape, 12.0, np.float32)
    depth[:, :, :75] = 3.0
    steps = replace(surround, depth=depth)
    for stride, left in ((1, 148), (3, 48)):
        cloud = merged_cloud(steps, rig, CloudLimits(stride, edge_clearance=0.3))
        assert len(cloud) == 6 * left * len(range(0, HEIGHT, stride))
    assert len(merged_cloud(steps, rig, CloudLimits())) == depth.size
