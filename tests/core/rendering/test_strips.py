# SPDX-License-Identifier: Apache-2.0
"""Strips: they hold all that neighbours see, and what is computed in them is what whole images give."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import ring_neighbours, ring_poses
from torch import Tensor

from cvcdepth_core.rendering.projection import Reprojection, axis_angle_to_rotation, rigid
from cvcdepth_core.rendering.strips import Strips, divide_into_strips, seen_columns
from cvcdepth_core.rendering.view_synthesis import warp_by_depth
from cvcdepth_core.training.motion import relative_poses

FLOAT64 = torch.float64
HEIGHT, WIDTH = 18, 80
SEEDS = st.integers(0, 2**31)


def lenses(fov: float) -> Tensor:
    focal = WIDTH / 2 / math.tan(math.radians(fov) / 2)
    return torch.tensor([[focal, 0, WIDTH / 2 - 0.5], [0, focal, HEIGHT / 2 - 0.5], [0, 0, 1]], dtype=FLOAT64)


def of_neighbours(depth: Tensor, poses: Tensor, fov: float) -> tuple[Reprojection, Tensor]:
    """Return the way [B, 1, P] from each target of a ring to its source, and the targets."""
    targets, sources = ring_neighbours(depth.shape[1])
    K = lenses(fov)
    return Reprojection.from_cameras(K.inverse(), relative_poses(poses, targets, sources)[:, None], K), targets


def is_sampled(depth: Tensor, way: Reprojection, targets: Tensor) -> Tensor:
    """Tell for each pair and column [P, W] whether a white source leaves anything of itself in it."""
    white = torch.ones(*way.turn.shape[:3], 1, HEIGHT, WIDTH, dtype=FLOAT64)
    warp = warp_by_depth(depth[:, None, targets], white, white, way, in_front_only=False)
    return (warp.images > 0).flatten(0, 1).any(dim=0).flatten(1, 2).any(dim=1)


@settings(max_examples=60, deadline=None)
@given(
    seed=SEEDS,
    cameras=st.sampled_from([3, 4, 6]),
    fov=st.floats(50, 140),
    nearest=st.floats(0.05, 5),
    turned=st.floats(0, 3),
)
def test_no_column_that_a_neighbour_is_seen_in_is_left_out(seed, cameras, fov, nearest, turned):
    torch.manual_seed(seed)
    depth = nearest / torch.rand(2, cameras, 1, HEIGHT, WIDTH, dtype=FLOAT64)
    anyhow = rigid(
        axis_angle_to_rotation(turned * torch.randn(2, cameras, 3, dtype=FLOAT64)),
        turned * torch.randn(2, cameras, 3, dtype=FLOAT64),
    )
    way, targets = of_neighbours(depth, ring_poses(2, cameras) @ anyhow, fov)
    intervals = seen_columns(depth, targets, way)
    for columns, (first, last) in zip(is_sampled(depth, way, targets), intervals, strict=True):
        assert not columns[:first].any()
        assert not columns[last:].any()
        # Windows of SSIM reach one column further.
        assert first == 0 or not columns[first]
        assert last == WIDTH or not columns[last - 1]


def test_cameras_of_a_ring_see_little_of_each_other_and_strips_leave_the_rest_out():
    torch.manual_seed(0)
    depth = 8 + torch.rand(1, 6, 1, HEIGHT, WIDTH, dtype=FLOAT64)
    way, targets = of_neighbours(depth, ring_poses(1, 6), fov=80)
    intervals = seen_columns(depth, targets, way)
    groups = divide_into_strips(intervals, targets.tolist(), 6, WIDTH)
    sampled = is_sampled(depth, way, targets).sum(dim=1)
    assert all(last - first <= columns + 8 for (first, last), columns in zip(intervals, sampled, strict=True))
    assert all(strips.width < WIDTH / 2 for strips in groups)
    assert sum(len(strips.firsts) for strips in groups) == len(targets)


def test_pairs_that_see_columns_in_common_share_a_strip_and_others_have_their_own():
    seen = [(0, 20), (15, 30), (90, 100), (40, 50)]
    narrow, wide = divide_into_strips(seen, [0, 0, 0, 1], cameras=2, width=100)
    assert (narrow.width, wide.width) == (13, 39)
    assert (wide.pairs, wide.strip_of_pair, wide.camera_of_strip, wide.firsts) == ((0, 1), (0, 0), (0,), (0,))
    # The first begins earlier than what is seen, for it would end beyond the image.
    assert (narrow.pairs, narrow.camera_of_strip, narrow.firsts) == ((2, 3), (0, 1), (87, 40))


def test_strips_that_save_nothing_are_whole_images():
    (strips,) = divide_into_strips([(0, 97), (5, 100)], [0, 1], cameras=2, width=100)
    images = torch.rand(1, 2, 3, 4, 100)
    assert strips.are_whole_images
    assert strips.cut(images) is images
    assert strips.paste(images) is images


def test_one_whole_image_among_narrow_strips_is_a_strip_like_the_others():
    narrow, whole = divide_into_strips([(0, 100), (90, 100)], [1, 0], cameras=2, width=100)
    images = torch.rand(1, 2, 3, 4, 100)
    assert not whole.are_whole_images
    assert torch.equal(whole.cut(images), images[:, 1:])
    assert torch.equal(narrow.cut(images), images[:, :1, ..., 87:])


def test_a_pair_that_sees_nothing_has_a_strip_all_the_same():
    far_apart = ring_poses(1, 3)
    far_apart[0, :, :3, 3] *= 1e6
    depth = torch.ones(1, 3, 1, HEIGHT, WIDTH, dtype=FLOAT64)
    way, targets = of_neighbours(depth, far_apart, fov=20)
    (strips,) = divide_into_strips(seen_columns(depth, targets, way), targets.tolist(), 3, WIDTH)
    assert strips.width == 10
    assert strips.pairs == tuple(range(len(targets)))


@pytest.mark.parametrize("leading", [(), (2,), (2, 3)])
def test_cutting_and_pasting_are_each_others_transpose(leading):
    strips = Strips(3, 100, 32, (0, 0, 1), (0, 68, 40), (0, 1, 2), (0, 1, 2))
    images = torch.rand(*leading, 3, 2, 4, 100, dtype=FLOAT64, requires_grad=True)
    parts = torch.rand(*leading, 3, 2, 4, 32, dtype=FLOAT64, requires_grad=True)
    cut, pasted = strips.cut(images), strips.paste(parts)
    torch.testing.assert_close((cut * parts).sum(), (images * pasted).sum())
    (grad_images,) = torch.autograd.grad((cut * parts.detach()).sum(), images)
    torch.testing.assert_close(grad_images, pasted)
    (grad_parts,) = torch.autograd.grad((pasted * images.detach()).sum(), parts)
    torch.testing.assert_close(grad_parts, cut)
