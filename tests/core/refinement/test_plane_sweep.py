# SPDX-License-Identifier: Apache-2.0
"""The plane sweep against exact truth: which hypothesis costs least where the depth of a textured plane is known."""

import math

import numpy as np
import pytest
import torch
from solid_world import Rectangle, camera_matrix, pose, render
from surround_drive import FOCAL, SIZE, looking

from cvcdepth_core.refinement.moments import View
from cvcdepth_core.refinement.plane_sweep import sweep

LOG_RATIOS = torch.arange(-8, 9) * 0.1
K = camera_matrix(*SIZE, FOCAL)


def wall(distance: float, yaw: float = 0.0) -> list[Rectangle]:
    """A wall whose texture the picture resolves at this distance."""
    return [Rectangle(pose(x=distance, yaw=yaw), seed=3, wavelengths=(0.05 * distance, 0.4 * distance))]


def view(surfaces: list[Rectangle], world_T_camera: np.ndarray) -> tuple[View, torch.Tensor]:
    picture, depth = render(surfaces, world_T_camera, K, SIZE)
    grey = torch.from_numpy(picture[..., 0].astype(np.float32) - 128)
    return View(torch.nn.functional.pad(grey, (1, 1, 1, 1), value=torch.nan), K, world_T_camera), torch.from_numpy(
        depth
    )


def swept(surfaces: list[Rectangle], own: np.ndarray, others: list[np.ndarray], ratio: float = 0.0):
    """The sweep of a view whose prior is the truth times exp(-ratio)."""
    seen, depth = view(surfaces, own)
    return sweep(seen, depth * math.exp(-ratio), [view(surfaces, other)[0] for other in others], LOG_RATIOS)


def share_at(found, ratio: float, least_radius: float = 0.0) -> float:
    """Share of the pixels with parallax, so far from the middle, whose least cost is at the right hypothesis."""
    best = LOG_RATIOS[found.cost.argmin(0)]
    v, u = torch.meshgrid(*(torch.arange(size) - size / 2 for size in SIZE), indexing="ij")
    judged = (found.evidence > 0.9) & (found.cost.amin(0) < 0.5) & (torch.hypot(u, v) >= least_radius)
    assert judged.float().mean() > 0.05
    return float(((best - ratio).abs() < 0.051)[judged].float().mean())


@pytest.mark.parametrize("distance", [3.0, 6.0, 12.0, 25.0])
@pytest.mark.parametrize("ratio", [-0.4, 0.0, 0.3])
def test_sideways_motion_finds_the_plane_at_every_distance(distance: float, ratio: float):
    found = swept(wall(distance), looking(), [looking(y=0.4)], ratio)
    assert share_at(found, ratio) > 0.99


@pytest.mark.parametrize("ratio", [-0.3, 0.2])
def test_forward_motion_finds_the_plane_away_from_where_it_leads(ratio: float):
    found = swept(wall(6.0), looking(), [looking(x=-0.5)], ratio)
    assert share_at(found, ratio, least_radius=30) > 0.99


@pytest.mark.parametrize("ratio", [-0.2, 0.4])
def test_a_neighbour_turned_by_thirty_degrees_finds_the_plane(ratio: float):
    found = swept(wall(6.0), looking(), [looking(yaw=30, y=0.6)], ratio)
    assert share_at(found, ratio) > 0.99


def test_patches_follow_the_slope_of_the_prior():
    slanted = wall(6.0, yaw=40)
    seen, depth = view(slanted, looking())
    source = [view(slanted, looking(y=0.4))[0]]
    following = sweep(seen, depth * math.exp(-0.2), source, LOG_RATIOS)
    flat = sweep(seen, torch.full_like(depth, float(depth.median()) * math.exp(-0.2)), source, LOG_RATIOS)
    assert share_at(following, 0.2) > 0.99
    assert following.cost.amin(0)[8:-8, 40:-40].mean() < 0.5 * flat.cost.amin(0)[8:-8, 40:-40].mean()


@pytest.mark.parametrize(
    "source",
    [looking(yaw=180), looking(yaw=90), looking(x=20.0), looking(y=60.0)],
    ids=["behind", "aside", "past", "far"],
)
def test_a_source_that_sees_nothing_of_the_view_says_nothing(source: np.ndarray):
    seen, depth = view(wall(6.0), looking())
    found = sweep(seen, depth, [view(wall(6.0), source)[0]], LOG_RATIOS)
    assert not found.cost.any()
    assert not found.evidence.any()


def test_a_source_without_a_picture_says_nothing_and_the_others_count_as_without_it():
    seen, depth = view(wall(6.0), looking())
    good, other = view(wall(6.0), looking(y=0.4))[0], view(wall(6.0), looking(y=-0.4))[0]
    masked = other._replace(grey=torch.full_like(other.grey, torch.nan))
    alone, both = sweep(seen, depth, [good], LOG_RATIOS), sweep(seen, depth, [masked, good], LOG_RATIOS)
    assert torch.equal(alone.cost, both.cost)
    assert torch.equal(alone.evidence, both.evidence)


def test_the_same_place_gives_no_evidence():
    found = swept(wall(6.0), looking(), [looking()])
    assert not found.evidence.any()
    assert not found.cost.any()


def test_the_order_of_sources_does_not_matter():
    places = [looking(y=0.4), looking(x=-0.5), looking(yaw=20, y=-0.3)]
    one, other = swept(wall(6.0), looking(), places), swept(wall(6.0), looking(), places[::-1])
    torch.testing.assert_close(one.cost, other.cost, atol=1e-5, rtol=0)
    torch.testing.assert_close(one.evidence, other.evidence, atol=1e-6, rtol=0)


def test_where_the_prior_is_unknown_nothing_is_said_and_nothing_else_changes():
    seen, depth = view(wall(6.0), looking())
    source = [view(wall(6.0), looking(y=0.4))[0]]
    whole = sweep(seen, depth, source, LOG_RATIOS)
    depth = depth.clone()
    depth[40:50, 70:90] = torch.nan
    holed = sweep(seen, depth, source, LOG_RATIOS)
    assert not holed.evidence[42:48, 72:88].any()
    assert torch.equal(whole.cost[:, :30], holed.cost[:, :30])
    assert not torch.isnan(holed.cost).any()


def test_brightness_and_contrast_of_a_source_do_not_matter():
    seen, depth = view(wall(6.0), looking())
    source = view(wall(6.0), looking(y=0.4))[0]
    darker = source._replace(grey=source.grey * 0.6 - 20)
    plain, dark = (sweep(seen, depth, [one], LOG_RATIOS) for one in (source, darker))
    torch.testing.assert_close(plain.cost, dark.cost, atol=0.02, rtol=0)


def test_coordinates_far_from_the_origin_of_the_world_cost_no_accuracy():
    near = swept(wall(6.0), looking(), [looking(y=0.4)])
    shift = np.eye(4)
    shift[:3, 3] = 5e5, 4e6, 30.0  # such as UTM has
    seen, depth = view(wall(6.0), looking())
    source, _ = view(wall(6.0), looking(y=0.4))
    moved = [v._replace(world_T_camera=shift @ v.world_T_camera) for v in (seen, source)]
    far = sweep(moved[0], depth, [moved[1]], LOG_RATIOS)
    torch.testing.assert_close(near.cost, far.cost, atol=1e-3, rtol=0)
