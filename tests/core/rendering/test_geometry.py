# SPDX-License-Identifier: Apache-2.0
"""Poses and projection as laws that hold for any values."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import ring_neighbours, ring_poses
from torch import Tensor

from cvcdepth_core.networks.mirroring import mirror_motion
from cvcdepth_core.rendering.projection import (
    PROJECTION_EPSILON,
    Reprojection,
    axis_angle_to_rotation,
    back_project,
    project,
    rigid,
    rigid_inverse,
    rigid_power,
    rotation_to_euler_xyz,
    transform,
)
from cvcdepth_core.rendering.view_synthesis import (
    BlackBeyond,
    KnownView,
    align_intensity,
    sample,
    splat_depth,
    warp_by_depth,
    warp_views,
)
from cvcdepth_core.training.motion import (
    distribute_anchor_motion,
    distribute_vehicle_motion,
    motion_to_context,
    motions_seen_from_anchor,
    poses_at_exposure,
    relative_poses,
)

FLOAT64 = torch.float64
EYE = torch.eye(4, dtype=FLOAT64)
SEEDS = st.integers(0, 2**31)
ANGLES = st.floats(-1.5, 1.5)


def random_poses(seed: int, *shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    vectors = torch.randn(2, *shape, 3, dtype=FLOAT64, generator=generator)
    return rigid(axis_angle_to_rotation(vectors[0]), vectors[1])


@settings(deadline=None)
@given(seed=SEEDS, first=st.floats(-1, 1), second=st.floats(-1, 1), size=st.sampled_from([0.0, 1e-4, 0.09, 0.5]))
def test_powers_of_a_motion_are_parts_of_its_way(seed, first, second, size):
    vectors = size * torch.randn(2, 5, 3, dtype=FLOAT64, generator=torch.Generator().manual_seed(seed))
    motion = rigid(axis_angle_to_rotation(vectors[0]), vectors[1])
    one, other, both = (
        rigid_power(motion, torch.full((5,), a, dtype=FLOAT64)) for a in (first, second, first + second)
    )
    torch.testing.assert_close(one @ other, both, rtol=0, atol=1e-8)
    torch.testing.assert_close(rigid_power(motion, torch.ones(5, dtype=FLOAT64)), motion, rtol=0, atol=1e-8)


def test_a_part_of_the_way_is_differentiable_at_standstill_and_elsewhere():
    def half(vector: Tensor) -> Tensor:
        return rigid_power(rigid(axis_angle_to_rotation(vector[:3]), vector[3:]), torch.tensor(0.5, dtype=FLOAT64))

    for size in (0.0, 0.05, 0.5):
        assert torch.autograd.gradcheck(half, (size * torch.ones(6, dtype=FLOAT64)).requires_grad_())


@settings(deadline=None)
@given(seed=SEEDS)
def test_poses_at_exposure_are_those_of_a_vehicle_with_constant_velocity_and_turn_rate(seed):
    generator = torch.Generator().manual_seed(seed)
    spin, velocity = 0.3 * torch.randn(2, 3, dtype=FLOAT64, generator=generator)
    twist = torch.zeros(4, 4, dtype=FLOAT64)
    twist[:3, :3], twist[:3, 3] = torch.linalg.cross(spin.expand(3, 3), torch.eye(3, dtype=FLOAT64)).T, velocity
    base_T_camera = random_poses(seed, 1, 4)
    delays = torch.rand(1, 4, dtype=FLOAT64, generator=generator) - 0.5
    delays[0, 2] = 0
    times = torch.tensor([[-0.8, 1.1]], dtype=FLOAT64)
    target_T_context = torch.linalg.matrix_exp(times[..., None, None] * twist)
    anchor_motion = rigid_inverse(target_T_context @ base_T_camera[:, None, 2]) @ base_T_camera[:, None, 2]
    found = poses_at_exposure(base_T_camera, anchor_motion, 2, delays, times)
    expected = torch.linalg.matrix_exp(delays[..., None, None] * twist) @ base_T_camera
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-8)


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS, height=st.integers(1, 9), width=st.integers(1, 9), focal=st.floats(5, 2000))
def test_back_projected_pixels_project_to_where_they_came_from(seed, height, width, focal):
    depth = 0.5 + 80 * torch.rand(2, 3, 1, height, width, dtype=FLOAT64, generator=torch.Generator().manual_seed(seed))
    K = torch.tensor([[focal, 0.1, width / 2], [0, 0.9 * focal, height / 2], [0, 0, 1]], dtype=FLOAT64).expand(
        2, 3, 3, 3
    )
    pixels, z = project(back_project(depth, torch.linalg.inv(K)), K)
    v, u = torch.meshgrid(torch.arange(height, dtype=FLOAT64), torch.arange(width, dtype=FLOAT64), indexing="ij")
    expected = torch.stack([u, v]).flatten(1).expand_as(pixels)
    torch.testing.assert_close(pixels, expected, rtol=1e-6, atol=1e-5)
    torch.testing.assert_close(z.view(depth.shape), depth)


@settings(deadline=None)
@given(seed=SEEDS)
def test_poses_are_a_group(seed):
    a, b, c = random_poses(seed, 3)
    points = torch.randn(3, 5, dtype=FLOAT64)
    torch.testing.assert_close(rigid_inverse(a) @ a, EYE)
    torch.testing.assert_close(rigid_inverse(a @ b), rigid_inverse(b) @ rigid_inverse(a))
    torch.testing.assert_close(transform(a @ b, points), transform(a, transform(b, points)))
    torch.testing.assert_close((a @ b) @ c, a @ (b @ c))


@settings(deadline=None)
@given(vector=st.tuples(ANGLES, ANGLES, ANGLES))
def test_axis_angle_gives_rotations_that_keep_their_axis(vector):
    axis_angle = torch.tensor(vector, dtype=FLOAT64)
    R = axis_angle_to_rotation(axis_angle)
    torch.testing.assert_close(R @ R.mT, EYE[:3, :3])
    torch.testing.assert_close(R @ axis_angle, axis_angle)
    assert float(torch.linalg.det(R)) == pytest.approx(1)
    torch.testing.assert_close(axis_angle_to_rotation(-axis_angle), R.mT)


def test_axis_angle_is_differentiable_at_zero():
    assert torch.autograd.gradcheck(axis_angle_to_rotation, torch.zeros(2, 3, dtype=FLOAT64, requires_grad=True))


@settings(deadline=None)
@given(angles=st.tuples(ANGLES, ANGLES, ANGLES))
def test_euler_angles_are_those_of_x_then_y_then_z(angles):
    turns = axis_angle_to_rotation(torch.diag(torch.tensor(angles, dtype=FLOAT64)))
    torch.testing.assert_close(
        rotation_to_euler_xyz(turns[0] @ turns[1] @ turns[2]), torch.tensor(angles, dtype=FLOAT64), rtol=1e-6, atol=1e-9
    )


@settings(deadline=None)
@given(seed=SEEDS)
def test_forward_and_backward_motion_of_the_same_vector_are_inverse(seed):
    vectors = torch.randn(2, 4, 3, dtype=FLOAT64, generator=torch.Generator().manual_seed(seed))
    product = motion_to_context(*vectors, backward=True) @ motion_to_context(*vectors, backward=False)
    torch.testing.assert_close(product, EYE.expand(4, 4, 4))


@settings(deadline=None)
@given(seed=SEEDS, anchor=st.integers(0, 3))
def test_distributed_motion_respects_composition_and_comes_back_from_every_camera(seed, anchor):
    extrinsics = random_poses(seed, 2, 4)
    first, second = random_poses(seed + 1, 2, 2, 1)
    distribute = [distribute_anchor_motion(motion, extrinsics, anchor) for motion in (first, second, first @ second)]
    torch.testing.assert_close(distribute[0] @ distribute[1], distribute[2])
    torch.testing.assert_close(distribute[0][:, :, anchor], first)
    seen = motions_seen_from_anchor(distribute[0], extrinsics, anchor)
    torch.testing.assert_close(seen, first.unsqueeze(2).expand_as(seen))


@settings(deadline=None)
@given(seed=SEEDS)
def test_all_cameras_agree_on_where_the_vehicle_went(seed):
    extrinsics, vehicle = random_poses(seed, 2, 4), random_poses(seed + 1, 2, 1)
    motions = distribute_vehicle_motion(vehicle, extrinsics)
    in_vehicle = extrinsics[:, None] @ motions @ rigid_inverse(extrinsics)[:, None]
    torch.testing.assert_close(in_vehicle, vehicle.unsqueeze(2).expand_as(in_vehicle))


def test_relative_poses_close_every_loop_of_the_ring():
    targets, sources = ring_neighbours(5)
    poses = relative_poses(ring_poses(2, 5), targets, sources)
    rightwards = {int(t): index for index, (t, s) in enumerate(zip(targets, sources, strict=True)) if s == (t + 1) % 5}
    loop = EYE
    for camera in range(5):
        loop = poses[:, rightwards[camera]] @ loop
    torch.testing.assert_close(loop, EYE.expand(2, 4, 4))


@settings(deadline=None)
@given(seed=SEEDS, axis=st.integers(0, 2))
def test_mirroring_motions_is_an_involution_that_respects_composition(seed, axis):
    a, b = random_poses(seed, 2, 3)
    flips = torch.tensor([True, False, True])
    mirrored = mirror_motion(a, flips, axis)
    torch.testing.assert_close(mirror_motion(mirrored, flips, axis), a)
    torch.testing.assert_close(mirrored @ mirror_motion(b, flips, axis), mirror_motion(a @ b, flips, axis))
    torch.testing.assert_close(mirrored @ mirrored.mT.mT.inverse(), EYE.expand(3, 4, 4))
    torch.testing.assert_close(mirrored[1], a[1])
    assert not torch.allclose(mirrored[0], a[0])


def test_an_unmoved_camera_renders_its_own_image():
    images, masks = torch.rand(2, 3, 6, 7, dtype=FLOAT64), torch.ones(2, 1, 6, 7, dtype=FLOAT64)
    K = torch.tensor([[5.0, 0, 3], [0, 5, 2.5], [0, 0, 1]], dtype=FLOAT64)
    points = back_project(4 + torch.rand(2, 1, 6, 7, dtype=FLOAT64), torch.linalg.inv(K))
    warp = warp_views(points, images, masks, EYE, K, in_front_only=True)
    inside = (slice(None), slice(None), slice(1, -1), slice(1, -1))  # 1e-7 in the projection may push the border out
    torch.testing.assert_close(warp.images[inside], images[inside], rtol=1e-5, atol=1e-5)
    assert warp.masks[inside].all()


def test_a_point_in_the_focal_plane_projects_to_finite_pixels_with_finite_gradients():
    points = torch.tensor([[1.0, 0.0], [2.0, 0.0], [-PROJECTION_EPSILON] * 2]).requires_grad_()
    pixels, _ = project(points, torch.eye(3))
    assert pixels.isfinite().all()
    (0.0 * pixels).sum().backward()
    assert points.grad.isfinite().all()


def test_sampling_infinitely_far_outside_gives_black_with_zero_gradient():
    grid = torch.tensor([[torch.inf, 0.0], [-torch.inf, 3e38]]).view(1, 1, 2, 2).requires_grad_()
    sampled = sample(torch.ones(1, 3, 6, 7), grid)
    assert not sampled.nan_to_num(1).any()
    sampled.sum().backward()
    assert not grid.grad.nan_to_num(1).any()


def test_points_behind_the_camera_are_seen_only_by_the_published_validity():
    images, masks = torch.rand(1, 3, 6, 7, dtype=FLOAT64), torch.ones(1, 1, 6, 7, dtype=FLOAT64)
    K = torch.tensor([[5.0, 0, 3], [0, 5, 2.5], [0, 0, 1]], dtype=FLOAT64)
    behind = -back_project(torch.full((1, 1, 6, 7), 4.0, dtype=FLOAT64), torch.linalg.inv(K))
    seen = [warp_views(behind, images, masks, EYE, K, in_front_only=only).masks.sum() for only in (False, True)]
    assert seen[0] > 0
    assert seen[1] == 0


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS, first=st.integers(0, 3))
def test_views_by_depth_are_those_by_points_with_the_same_gradients(seed, first):
    torch.manual_seed(seed)
    images, masks = torch.rand(2, 3, 3, 6, 9, dtype=FLOAT64), torch.rand(2, 3, 1, 6, 9, dtype=FLOAT64)
    K = torch.tensor([[5.0, 0.3, 4], [0, 5, 2.5], [0, 0, 1]], dtype=FLOAT64)
    depth = (2 + torch.rand(2, 1, 1, 6, 9, dtype=FLOAT64)).requires_grad_()
    source_T_target = (random_poses(seed, 2, 3) * 0.05 + EYE * 0.95).requires_grad_()
    points = back_project(depth, K.inverse()).unflatten(-1, (6, 9))[..., first:].flatten(-2)
    homogeneous = (K @ transform(source_T_target, points)).unflatten(-1, (6, -1))
    in_order = homogeneous[..., :2, :, :] / (homogeneous[..., 2:, :, :] + PROJECTION_EPSILON)
    grid = (2 * in_order / torch.tensor([8.0, 5.0], dtype=FLOAT64)[:, None, None] - 1).movedim(-3, -1)
    by_points = sample(images, grid)
    way = Reprojection.from_cameras(K.inverse(), source_T_target, K).from_column(torch.tensor(float(first)))
    by_depth = warp_by_depth(depth[..., first:], images, masks, way, in_front_only=True)
    torch.testing.assert_close(by_depth.images, by_points)
    torch.testing.assert_close(by_depth.grid, grid)
    weights = torch.rand_like(by_points)
    for ours, theirs in zip(
        torch.autograd.grad((by_depth.images * weights).sum(), (depth, source_T_target)),
        torch.autograd.grad((by_points * weights).sum(), (depth, source_T_target)),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


def test_a_part_of_a_view_is_aligned_as_the_whole_is():
    warped, target = torch.rand(2, 3, 6, 20, dtype=FLOAT64), torch.rand(2, 3, 6, 20, dtype=FLOAT64)
    masks = torch.rand(2, 1, 6, 20, dtype=FLOAT64)
    warped[..., :12], masks[..., :12] = 0, 0
    whole = align_intensity(warped, masks, target, torch.ones_like(masks), masked_deviation=False)
    part = align_intensity(
        warped[..., 12:],
        masks[..., 12:],
        target[..., 12:],
        torch.ones_like(masks[..., 12:]),
        masked_deviation=False,
        whole_warped=BlackBeyond(8 / 20),
        whole_target=KnownView.from_images(target),
    )
    torch.testing.assert_close(part, whole[..., 12:])
    assert not whole[..., :12].any()


def test_alignment_gives_a_view_the_brightness_of_its_target_and_leaves_one_without_overlap_alone():
    target = torch.rand(2, 3, 6, 7, dtype=FLOAT64)
    darker = 0.1 + 0.3 * target
    masks = torch.ones(2, 1, 6, 7, dtype=FLOAT64)
    masks[1] = 0
    aligned = align_intensity(darker, torch.ones_like(masks), target, masks, masked_deviation=False)
    torch.testing.assert_close(aligned[0], target[0], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(aligned[1], darker[1])


def test_splatting_keeps_the_nearest_point_and_leaves_holes():
    K = torch.eye(3, dtype=FLOAT64).expand(1, 1, 3, 3)
    points = torch.tensor([[1.0, 1, 5], [2.0, 2, 2], [-9.0, 0, 1], [0.0, 0, -3]], dtype=FLOAT64).T.reshape(1, 1, 3, 4)
    points[:, :, :2, 0] *= 5  # pixel (1, 1) at 5 m
    points = points.requires_grad_()
    valid = torch.ones(1, 1, 1, 2, 2, dtype=FLOAT64)
    depth = splat_depth(points, valid, K, torch.tensor([0]), cameras=1)
    torch.testing.assert_close(depth[0, 0, 0], torch.tensor([[0.0, 0.0], [0.0, 2.0]], dtype=FLOAT64))
    depth.sum().backward()
    torch.testing.assert_close(points.grad[0, 0, 2], torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=FLOAT64))
