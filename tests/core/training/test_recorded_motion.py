# SPDX-License-Identifier: Apache-2.0
"""Training by recorded motion: what the losses take from it, what the pose network is taught, and a rig of loners."""

import dataclasses

import pytest
import torch
from scenes import PlaneScene, passed_plane, random_batch, random_prediction, seen_plane
from torch import Tensor

from cvcdepth_core.errors import RigError
from cvcdepth_core.rendering.projection import axis_angle_to_rotation, rigid
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.losses import motion_error
from cvcdepth_core.training.objective import ObjectiveConfig, Prediction, evaluate_objective

EVERY_VIEW = ("temporal", "spatial", "spatio_temporal", "reconstruction_consistency", "depth_consistency")


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(7)


def with_recorded_motion(scene: PlaneScene, base_poses: Tensor) -> RigBatch:
    """The scene's batch as a recording with odometry gives it; `base_poses` [3, N, 4, 4] at target, before, after."""
    poses = (base_poses @ scene.batch.base_T_camera)[None]
    return dataclasses.replace(
        scene.batch, base_T_camera=poses[:, 0], recorded_poses=poses, exposure_delays=None, context_times=None
    )


def speeding_up(delays: tuple[float, float], velocity: float, gain: float) -> tuple[PlaneScene, Tensor]:
    """A plane passed sideways, and the base frame's poses [3, 2, 4, 4]; `gain` is in metres per frame squared."""
    times = torch.tensor([0.0, -1.0, 1.0], dtype=torch.float64)[:, None] + torch.tensor(delays)
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 2, 1, 1)
    poses[..., 0, 3] = velocity * times + gain / 2 * times**2
    mounts = passed_plane(delays, velocity).batch.base_T_camera
    return seen_plane(poses @ mounts, mounts, height=48, width=64, tilt=(0.25, 0.15)), poses


def noise_for(batch: RigBatch) -> Tensor:
    return torch.randn(batch.contexts[:, :, :, :1].shape, dtype=batch.frames.dtype)


def test_recorded_motion_gives_the_terms_that_true_predicted_motion_gives():
    scene, poses = speeding_up((0.0, 0.4), velocity=0.3, gain=0.0)
    batch, noise = with_recorded_motion(scene, poses), noise_for(scene.batch)
    delayed = passed_plane((0.0, 0.4), velocity=0.3).batch  # the same, and the delays told
    wrong = rigid(scene.motions[..., :3, :3], 0.1 * scene.motions[..., :3, 3])
    recorded = evaluate_objective(batch, Prediction(1 / scene.depth, scene.depth, wrong), ObjectiveConfig(), noise)
    truth = Prediction(1 / scene.depth, scene.depth, scene.motions)
    predicted = evaluate_objective(delayed, truth, ObjectiveConfig(), noise)
    for name in EVERY_VIEW:
        torch.testing.assert_close(recorded.terms[name], predicted.terms[name], rtol=1e-6, atol=1e-9)
    assert "recorded_motion" not in predicted.terms
    assert recorded.terms["recorded_motion"].min() > 0.5


def test_neighbours_are_where_they_were_at_each_moment_although_the_vehicle_speeds_up():
    scene, poses = speeding_up((0.0, 0.4), velocity=0.3, gain=0.2)
    batch, noise = with_recorded_motion(scene, poses), noise_for(scene.batch)
    truth = Prediction(1 / scene.depth, scene.depth, batch.recorded_motions)
    steady = dataclasses.replace(batch, recorded_poses=None)  # right is each camera's own motion only
    exact, guessed = (evaluate_objective(one, truth, ObjectiveConfig(), noise).terms for one in (batch, steady))
    assert exact["spatio_temporal"].mean() < 0.5 * guessed["spatio_temporal"].mean()
    torch.testing.assert_close(exact["spatial"], guessed["spatial"])


def test_only_the_term_of_its_own_teaches_the_pose_network():
    batch = random_batch(samples=2, cameras=3, height=16, width=24)
    drawn = random_prediction(batch)
    poses = torch.cat([batch.base_T_camera[:, None], batch.base_T_camera[:, None] @ drawn.motions], dim=1)
    batch = dataclasses.replace(batch, recorded_poses=poses)
    prediction = dataclasses.replace(drawn, motions=drawn.motions.clone().requires_grad_())
    untaught = evaluate_objective(batch, prediction, ObjectiveConfig(recorded_motion=0), noise_for(batch))
    assert "recorded_motion" not in untaught.terms
    (none,) = torch.autograd.grad(untaught.loss, prediction.motions, allow_unused=True)
    assert none is None
    taught = evaluate_objective(batch, prediction, ObjectiveConfig(), noise_for(batch))
    (some,) = torch.autograd.grad(taught.loss, prediction.motions)
    assert some[..., :3, 3].abs().min() > 0


def test_a_motion_is_learned_from_the_recorded_one():
    true = rigid(axis_angle_to_rotation(torch.tensor([0.0, 0.01, 0.002])), torch.tensor([0.02, 0.0, -0.45]))
    vector = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, -0.2], requires_grad=True)
    optimizer = torch.optim.Adam([vector], lr=0.01)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=200)
    for _ in range(200):
        optimizer.zero_grad()
        motion_error(rigid(axis_angle_to_rotation(vector[:3]), vector[3:]), true).backward()
        optimizer.step()
        schedule.step()
    assert float(motion_error(rigid(axis_angle_to_rotation(vector[:3]), vector[3:]), true).detach()) < 0.02


def test_the_error_of_a_motion_is_a_share_of_the_way_and_finite_at_zero():
    true = torch.eye(4).repeat(3, 1, 1)
    true[:, 2, 3] = torch.tensor([0.5, 2.0, 0.0])
    half = true.clone().requires_grad_()
    halved = rigid(half[:, :3, :3], 0.5 * half[:, :3, 3])
    torch.testing.assert_close(motion_error(halved, true), torch.tensor([0.5, 0.5, 0.0]), atol=1e-3, rtol=0)
    turned = rigid(axis_angle_to_rotation(torch.tensor([0.0, 0.01, 0.0])), true[1, :3, 3])
    torch.testing.assert_close(motion_error(turned, true[1]), torch.tensor(0.05), atol=1e-3, rtol=0)
    (gradient,) = torch.autograd.grad(motion_error(half, true).sum(), half)
    assert gradient.isfinite().all()


def test_cameras_without_neighbours_learn_the_scale_from_recorded_motion():
    scene, poses = speeding_up((0.0, 0.4), velocity=0.3, gain=0.0)
    none = torch.zeros(0, dtype=torch.int64)
    batch = dataclasses.replace(with_recorded_motion(scene, poses), targets=none, sources=none)
    config = ObjectiveConfig(smoothness=0, corrected=True)
    log_scale = torch.tensor(1.15, dtype=torch.float64).log().requires_grad_()
    optimizer = torch.optim.Adam([log_scale], lr=0.02)
    for _ in range(40):
        optimizer.zero_grad()
        depth = log_scale.exp() * scene.depth
        value = evaluate_objective(batch, Prediction(1 / depth, depth, 0 * scene.motions + torch.eye(4)), config)
        value.loss.backward()
        optimizer.step()
    assert set(value.terms) == {"temporal", "recorded_motion"}
    assert float(log_scale.detach().exp()) == pytest.approx(1, abs=0.02)


def test_without_recorded_motion_loners_are_refused_and_impossible_poses_always():
    batch = random_batch(samples=1, cameras=3, height=8, width=8)
    none = torch.zeros(0, dtype=torch.int64)
    with pytest.raises(RigError, match="camera camera0, camera1, camera2: no neighbour"):
        dataclasses.replace(batch, targets=none, sources=none)
    with pytest.raises(RigError, match=r"recorded_poses: shape is \[1, 2, 3, 4, 4\], expected finite poses"):
        dataclasses.replace(batch, recorded_poses=batch.base_T_camera[:, None].repeat(1, 2, 1, 1, 1))
    endless = batch.base_T_camera[:, None].repeat(1, 3, 1, 1, 1)
    endless[0, 1, 2, 0, 3] = torch.nan
    with pytest.raises(RigError, match="recorded_poses"):
        dataclasses.replace(batch, recorded_poses=endless)
