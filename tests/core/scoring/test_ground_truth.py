# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.rig.pinhole import PinholeView
from cvcdepth_core.rig.view import PicturePart
from cvcdepth_core.scoring import sparse_depth as sparse_depth_module
from cvcdepth_core.scoring.ground_truth import overlap_pixels, resized_truth, sample_prediction, sparse_depth
from cvcdepth_core.scoring.sparse_depth import OcclusionFilter, SparseDepth

K = np.array([[100.0, 0.0, 49.5], [0.0, 100.0, 39.5], [0.0, 0.0, 1.0]])
# Optical frame (z forward, x right, y down) in the base frame (x forward, y left, z up).
FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def view(x: float = 0.0, y: float = 0.0, z: float = 0.0, turned: float = 0.0) -> PinholeView:
    """An 80 x 100 picture taken at (x, y, z), `turned` degrees to the left."""
    angle = math.radians(turned)
    base_T_camera = np.eye(4)
    base_T_camera[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    base_T_camera = base_T_camera @ FORWARD
    base_T_camera[:3, 3] = x, y, z
    return PinholeView(K, base_T_camera, 80, 100)


def at_pixel(row: float, column: float, depth: float) -> list[float]:
    """A point in the base frame that the camera at the origin sees at this pixel and depth."""
    return [depth, -(column - 49.5) / 100 * depth, -(row - 39.5) / 100 * depth]


def test_a_point_falls_on_the_nearest_pixel_and_keeps_its_depth_along_the_axis():
    truth = sparse_depth(np.array([at_pixel(12.4, 70.6, 8.0)]), view())
    assert (truth.rows.tolist(), truth.columns.tolist()) == ([12], [71])
    assert truth.depth == pytest.approx([8.0])


def test_of_several_points_in_a_pixel_the_nearest_counts():
    points = np.array([at_pixel(10, 20, depth) for depth in (9.0, 4.0, 30.0)])
    truth = sparse_depth(points, view())
    assert truth.depth == pytest.approx([4.0])


def test_points_behind_outside_and_nan_are_left_out():
    outside = [at_pixel(-1, 5, 3), at_pixel(80, 5, 3), at_pixel(5, 100, 3), at_pixel(5, -1, 3)]
    points = np.array([[-5.0, 0, 0], [0, 0, 0], [math.nan, 1, 1], *outside, at_pixel(79.4, 99.4, 3)])
    truth = sparse_depth(points, view())
    assert (truth.rows.tolist(), truth.columns.tolist()) == ([79], [99])


def test_no_points_give_no_truth():
    assert len(sparse_depth(np.empty((0, 3)), view(), OcclusionFilter())) == 0


def test_a_point_seen_past_a_nearer_surface_is_no_truth():
    near = [at_pixel(row, column, 5.0) for row in range(30, 40) for column in range(40, 50)]
    points = np.array([*near, at_pixel(35, 49.9, 20.0), at_pixel(35, 53, 20.0)])
    everything = sparse_depth(points, view())
    filtered = sparse_depth(points, view(), OcclusionFilter(radius=1.0))  # 1.7 pixels
    assert len(everything) == 102
    assert len(filtered) == 101
    assert (35, 50) not in zip(filtered.rows, filtered.columns, strict=True)
    assert (35, 53) in zip(filtered.rows, filtered.columns, strict=True)


@pytest.mark.parametrize("surface", ["ground", "wall"])
@pytest.mark.parametrize("turned", [0, 60])
def test_surfaces_at_a_grazing_angle_do_not_hide_themselves(surface, turned):
    forward, across = np.meshgrid(np.linspace(0, 60, 600), np.linspace(-1, 30, 300))
    fixed = np.full_like(forward, -1.5 if surface == "ground" else 1.5)
    axes = (forward, across, fixed) if surface == "ground" else (forward, fixed, across / 20)
    camera = view(turned=turned)
    truth = sparse_depth(np.stack(axes, axis=-1).reshape(-1, 3), camera)
    assert len(truth) > 200
    assert OcclusionFilter(radius=3.0).visible(truth, 100.0).all()


def test_what_a_long_lens_spreads_over_many_pixels_is_hidden_as_soon(monkeypatch: pytest.MonkeyPatch):
    """Two degrees over 2800 pixels: half a degree are 700 of them, a disc of a million and a half."""
    focal_length, columns = 80_000.0, np.arange(0, 2800, 40)
    occluder = columns < 1400
    rows = np.where(occluder, 200, 400)
    truth = SparseDepth(rows, columns, np.where(occluder, 50.0, 300.0), 1600, 2800)
    offsets = sparse_depth_module._offsets_within
    searched: list[tuple[int, int]] = []
    monkeypatch.setattr(
        sparse_depth_module, "_offsets_within", lambda reach: searched.extend(offsets(reach)) or searched
    )
    visible = OcclusionFilter().visible(truth, focal_length)
    assert 0 < len(searched) < 20_000
    assert visible[occluder].all()
    hidden = ~visible[~occluder]
    distance = np.hypot(columns[~occluder] - 1360, 200)
    assert hidden[distance < 670].all()
    assert not hidden[distance > 730].any()


@pytest.mark.parametrize("field", ["radius", "clearance", "margin"])
def test_an_impossible_filter_is_refused_by_name(field):
    with pytest.raises(ConfigError, match=f"{field} is 0"):
        OcclusionFilter(**{field: 0.0})


def test_sampling_at_sparse_truth_equals_resizing_the_whole_prediction():
    rng = np.random.default_rng(1)
    for small, large in (((24, 40), (67, 131)), ((24, 40), (24, 40)), ((24, 40), (10, 17))):
        prediction = rng.uniform(1, 80, small)
        resized = interpolate(torch.tensor(prediction)[None, None], large, mode="bilinear", align_corners=False)
        image = np.where(rng.random(large) < 0.3, 5.0, np.nan)
        truth = SparseDepth.from_image(image)
        sampled = sample_prediction(prediction, truth)
        assert sampled == pytest.approx(resized[0, 0].numpy()[truth.rows, truth.columns], rel=1e-12)


def test_a_prediction_with_holes_has_none_exactly_where_it_would_be_interpolated_from_one():
    prediction = np.ones((4, 4))
    prediction[1, 1] = np.nan
    sampled = sample_prediction(prediction, SparseDepth.from_image(np.ones((8, 8)))).reshape(8, 8)
    assert np.isnan(sampled[1:5, 1:5]).all()
    assert np.isnan(sampled).sum() == 16
    same_size = sample_prediction(prediction, SparseDepth.from_image(np.ones((4, 4))))
    assert np.isnan(same_size).sum() == 1


def test_a_prediction_of_a_part_is_sampled_there_and_is_none_elsewhere():
    """Rows are cut off above and below, and columns are added left and right that show nothing."""
    truth = SparseDepth.from_image(np.ones((8, 8)))
    prediction = np.tile(np.arange(4.0), (4, 1)).T
    cropped = sample_prediction(prediction, truth, PicturePart(0, 2, 8, 4)).reshape(8, 8)
    assert np.isnan(cropped[[0, 1, 6, 7]]).all()
    np.testing.assert_allclose(cropped[2:6], np.tile(np.arange(4.0)[:, None], (1, 8)))
    padded = sample_prediction(prediction.T, truth, PicturePart(-4, 0, 16, 8)).reshape(8, 8)
    np.testing.assert_allclose(padded[3], [0.625, 0.875, 1.125, 1.375, 1.625, 1.875, 2.125, 2.375])


def test_truth_as_an_image_and_back_is_the_same():
    truth = sparse_depth(np.array([at_pixel(3, 4, 5.5), at_pixel(60, 70, 33.0)]), view())
    again = SparseDepth.from_image(truth.image())
    assert (again.rows.tolist(), again.columns.tolist()) == (truth.rows.tolist(), truth.columns.tolist())
    assert again.depth == pytest.approx(truth.depth)
    assert sample_prediction(truth.image(), truth) == pytest.approx(truth.depth)


def test_overlap_is_what_a_neighbour_sees_too():
    truth = sparse_depth(np.array([at_pixel(40, column, 10.0) for column in range(100)]), view())
    neighbour = view(turned=30.0)
    seen = overlap_pixels(truth, view(), [neighbour])
    # 30 degrees to the left, the neighbour's right border (26.6 degrees) lies 3.4 degrees left of our axis.
    border = 49.5 - 100 * math.tan(math.radians(30) - math.atan(0.495))
    assert seen.tolist() == [column <= border for column in range(100)]
    assert not overlap_pixels(truth, view(), []).any()
    assert not overlap_pixels(truth, view(), [view(turned=180.0)]).any()


def test_truth_comes_to_another_size_at_its_pixels_centres_and_is_never_averaged():
    rows, columns = np.divmod(np.arange(80 * 100), 100)
    depth = 1.0 + np.arange(80 * 100)
    dense = SparseDepth(rows, columns, depth, 80, 100)
    small = resized_truth(dense, 16, 20)
    assert np.array_equal(small, depth.reshape(80, 100)[2::5, 2::5].astype(np.float32))
    part = PicturePart(10.0, 20.0, 50.0, 40.0)  # left, top, width, height
    assert np.array_equal(resized_truth(dense, 40, 50, part), depth.reshape(80, 100)[20:60, 10:60].astype(np.float32))


def test_of_sparse_truth_each_pixel_has_what_is_nearest_to_its_centre_the_sky_is_infinite_the_rest_unknown():
    sky = np.array([[71, 41], [79, 99]])
    truth = SparseDepth(np.array([0, 2, 70]), np.array([0, 3, 40]), np.array([5.0, 9.0, 7.0]), 80, 100, sky=sky)
    small = resized_truth(truth, 16, 20)
    assert small[0, 0] == 9.0
    assert small[14, 8] == math.inf
    assert small[15, 19] == math.inf
    assert np.isnan(small).sum() == 16 * 20 - 3
