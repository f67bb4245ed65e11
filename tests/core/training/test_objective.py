# SPDX-License-Identifier: Apache-2.0
"""The objective on rigs and scenes of our own: independence, physics, corrections, refusals."""

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mean_feature_network import MeanFeatureNet
from scenes import PlaneScene, passed_plane, random_batch, random_prediction, ring_neighbours, slanted_plane
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from cvcdepth_core.errors import ImageError, RigError
from cvcdepth_core.networks import DepthNet, PoseNet, RigImages
from cvcdepth_core.networks.mirroring import mirror_rig
from cvcdepth_core.rendering.projection import back_project, rigid
from cvcdepth_core.rendering.strips import Strips
from cvcdepth_core.rendering.view_synthesis import sample, sampling_grid
from cvcdepth_core.training import objective
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.model import SurroundModel, rig_images
from cvcdepth_core.training.motion import distribute_anchor_motion, relative_poses
from cvcdepth_core.training.objective import ObjectiveConfig, Prediction, evaluate_objective, synthesise_views

ALL_TERMS = ObjectiveConfig(pose_consistency=0.1)


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(7)


def one_sample(batch: RigBatch, prediction: Prediction, index: int) -> tuple[RigBatch, Prediction]:
    keep = slice(index, index + 1)
    fields = {name: getattr(batch, name)[keep] for name in ("frames", "masks", "intrinsics", "base_T_camera")}
    parts = (part[keep] for part in (prediction.disparity, prediction.depth, prediction.motions))
    return dataclasses.replace(batch, **fields), Prediction(*parts)


def noise_for(batch: RigBatch) -> Tensor:
    return torch.randn(batch.contexts[:, :, :, :1].shape, dtype=batch.frames.dtype)


@pytest.mark.parametrize("variant", [{}, {"corrected": True}, {"depth_warping": "dcl"}])
@pytest.mark.parametrize("cameras", [3, 4, 6])
def test_the_loss_of_a_batch_is_the_mean_of_its_samples_losses(cameras, variant):
    batch = random_batch(samples=3, cameras=cameras, height=19, width=27)
    batch.masks[1, 0] = 0  # no overlap at all for one camera of one sample
    prediction, noise = random_prediction(batch), noise_for(batch)
    config = ObjectiveConfig(pose_consistency=0.1, **variant)
    together = evaluate_objective(batch, prediction, config, noise)
    alone = [evaluate_objective(*one_sample(batch, prediction, i), config, noise[i : i + 1]).loss for i in range(3)]
    torch.testing.assert_close(together.per_sample, torch.stack(alone), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(together.loss, torch.stack(alone).mean(), rtol=1e-10, atol=1e-12)
    gradient = torch.autograd.grad(together.loss, prediction.disparity, retain_graph=True)[0]
    gradient_alone = torch.autograd.grad(torch.stack(alone).mean(), prediction.disparity)[0]
    torch.testing.assert_close(gradient, gradient_alone, rtol=1e-9, atol=1e-14)


def test_a_camera_may_have_any_number_of_neighbours():
    batch = random_batch(samples=1, cameras=4, height=16, width=24)
    prediction, noise = random_prediction(batch), noise_for(batch)
    everyone = [(camera, other) for camera in range(4) for other in range(4) if camera != other and camera > 0]
    pairs = torch.tensor([(0, 1), *everyone])
    uneven = dataclasses.replace(batch, targets=pairs[:, 0], sources=pairs[:, 1])
    shuffled = dataclasses.replace(batch, targets=pairs.flip(0)[:, 0], sources=pairs.flip(0)[:, 1])
    values = [evaluate_objective(each, prediction, ALL_TERMS, noise) for each in (uneven, shuffled)]
    assert values[0].loss.isfinite()
    torch.testing.assert_close(values[0].loss, values[1].loss, rtol=1e-12, atol=0)


def test_the_order_of_the_cameras_does_not_matter():
    batch = random_batch(samples=2, cameras=4, height=16, width=24)
    prediction, noise = random_prediction(batch), noise_for(batch)
    order = torch.tensor([2, 0, 3, 1])
    place = order.argsort()
    reordered = RigBatch(
        frames=batch.frames[:, :, order],
        masks=batch.masks[:, order],
        intrinsics=batch.intrinsics[:, order],
        base_T_camera=batch.base_T_camera[:, order],
        targets=place[batch.targets],
        sources=place[batch.sources],
        camera_names=[batch.camera_names[i] for i in order],
        anchor=int(place[0]),
    )
    moved = Prediction(prediction.disparity[:, order], prediction.depth[:, order], prediction.motions[:, :, order])
    value = evaluate_objective(batch, prediction, ALL_TERMS, noise)
    other = evaluate_objective(reordered, moved, ALL_TERMS, noise[:, :, order])
    torch.testing.assert_close(value.loss, other.loss, rtol=1e-12, atol=0)
    for name, term in value.terms.items():
        torch.testing.assert_close(term[:, order], other.terms[name], rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize(
    "variant", [{}, {"corrected": True}, {"depth_warping": "dcl"}, {"reconstruction_consistency": 0, "spatial": 0}]
)
@pytest.mark.parametrize("cameras", [5, 6])
def test_the_overlap_alone_gives_the_loss_and_gradients_of_whole_images(monkeypatch, cameras, variant):
    batch = random_batch(samples=2, cameras=cameras, height=32, width=160)
    batch.intrinsics[..., 0, 0] *= 1.6  # less overlap
    batch.intrinsics[:, 0, 0, 0] *= 0.8  # and not the same everywhere
    prediction, noise = random_prediction(batch), noise_for(batch)
    config = ObjectiveConfig(pose_consistency=0.1, **variant)

    def evaluated() -> tuple[Tensor, Tensor]:
        value = evaluate_objective(batch, prediction, config, noise)
        return value.per_sample, torch.autograd.grad(value.loss, prediction.disparity, retain_graph=True)[0]

    in_strips = evaluated()
    parts = synthesise_views(batch, prediction, config).overlap.parts
    assert sum(part.strips.width * len(part.strips.firsts) for part in parts) < 160 * cameras
    monkeypatch.setattr(objective, "divide_into_strips", lambda seen, *sizes: [Strips.from_whole_images(*sizes)])
    for ours, whole in zip(in_strips, evaluated(), strict=True):
        torch.testing.assert_close(ours, whole, rtol=1e-10, atol=1e-13)


def test_where_two_neighbours_see_a_pixel_the_correction_averages_and_the_release_adds():
    scene = slanted_plane()
    batch = RigBatch(  # the right camera twice: the left one sees the same pixels in both
        frames=scene.batch.frames[:, :, [0, 1, 1]],
        masks=torch.ones(1, 3, 1, 48, 64, dtype=torch.float64),
        intrinsics=scene.batch.intrinsics[:, [0, 1, 1]],
        base_T_camera=scene.batch.base_T_camera[:, [0, 1, 1]],
        targets=torch.tensor([0, 0, 1, 2]),
        sources=torch.tensor([1, 2, 0, 0]),
        camera_names=["left", "right", "right again"],
    )
    depth, motions = scene.depth[:, [0, 1, 1]], scene.motions[:, :, [0, 1, 1]]
    added, averaged = (
        synthesise_views(batch, Prediction(1 / depth, depth, motions), ObjectiveConfig(corrected=corrected)).overlap
        for corrected in (False, True)
    )
    seen = averaged.masks[0, 0, 0] > 0
    assert averaged.masks.max() == 1
    assert added.masks.max() == 2
    torch.testing.assert_close(added.depth[0, 0][seen], 2 * averaged.depth[0, 0][seen])
    assert float((averaged.images[0, 0, 0] - batch.images[0, 0])[:, seen[0]].abs().mean()) < 0.01
    torch.testing.assert_close(averaged.depth[0, 0][seen], depth[0, 0][seen], rtol=1e-3, atol=0)


def test_an_empty_mask_gives_zero_and_finite_gradients():
    batch = random_batch(samples=1, cameras=3, height=16, width=24)
    batch.masks.zero_()
    prediction = random_prediction(batch)
    value = evaluate_objective(batch, prediction, ALL_TERMS)
    for name in ("temporal", "spatial", "spatio_temporal", "depth_consistency", "reconstruction_consistency"):
        assert not value.terms[name].any(), name
    value.loss.backward()
    assert prediction.disparity.grad.isfinite().all()


@pytest.mark.parametrize("corrected", [False, True])
def test_constant_images_give_zero_photometric_gradients(corrected):
    batch = random_batch(samples=1, cameras=4, height=16, width=24)
    batch.frames.fill_(0.5)
    batch.masks.fill_(1.0)
    prediction = random_prediction(batch)
    depth = prediction.depth.detach().requires_grad_()
    config = ObjectiveConfig(depth_consistency=0.0, smoothness=0.0, corrected=corrected)
    constant = Prediction(prediction.disparity, depth, prediction.motions)
    evaluate_objective(batch, constant, config).loss.backward()
    assert depth.grad.isfinite().all()
    inside = synthesise_views(batch, constant, config).temporal_masks.bool().all(dim=1)
    # Pixels sampled half outside the image mix with the black around it; the others must not move.
    assert float(depth.grad[inside].abs().median()) < 1e-12


def test_points_in_the_focal_plane_of_a_neighbour_stay_finite_in_float32():
    batch = random_batch(samples=1, cameras=3, height=16, width=24)
    turned = rigid(torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), torch.zeros(3)).double()
    batch.base_T_camera[:, 0], batch.base_T_camera[:, 1] = torch.eye(4).double(), turned
    batch.intrinsics[..., 0, 2] = 12.0  # the middle column looks exactly along the neighbour's focal plane
    batch = batch.to(dtype=torch.float32)
    prediction = Prediction(*(getattr(random_prediction(batch), f).float() for f in ("disparity", "depth", "motions")))
    depth = prediction.depth.detach().requires_grad_()
    value = evaluate_objective(batch, dataclasses.replace(prediction, depth=depth), ALL_TERMS)
    value.loss.backward()
    assert value.loss.isfinite()
    assert depth.grad.isfinite().all()


# --- physics


def recover(scene: PlaneScene, start: float, term: str, config: ObjectiveConfig) -> Tensor:
    """Optimise depth, wrong by the factor `start`, through one term; return the relative error [1, N, 1, H, W].

    The unknowns are a grid of 13 x 17 log factors per camera.
    """
    height, width = scene.depth.shape[-2:]
    correction = torch.full((2, 1, 13, 17), start, dtype=torch.float64).log().requires_grad_()
    optimizer = torch.optim.Adam([correction], lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=150)
    for _ in range(150):
        optimizer.zero_grad()
        factor = F.interpolate(correction, (height, width), mode="bilinear", align_corners=True).exp()
        depth = scene.depth * factor
        value = evaluate_objective(scene.batch, Prediction(1 / depth, depth, scene.motions), config)
        value.terms[term].mean().backward()
        optimizer.step()
        schedule.step()
    return (depth / scene.depth - 1).abs().detach()


@pytest.mark.parametrize("start", [0.7, 1.3])
def test_spatial_term_recovers_the_metric_depth_of_a_slanted_plane(start):
    scene = slanted_plane()
    config = ObjectiveConfig(smoothness=0, spatio_temporal=0, depth_consistency=0, reconstruction_consistency=0)
    truth = Prediction(1 / scene.depth, scene.depth, scene.motions)
    overlap = synthesise_views(scene.batch, truth, config).overlap.masks[:, 0] > 0
    assert float(recover(scene, start, "spatial", config)[overlap].mean()) < 0.02


@pytest.mark.parametrize("start", [0.7, 1.3])
def test_temporal_term_recovers_the_metric_depth_when_the_motion_is_known(start):
    scene = slanted_plane()
    config = ObjectiveConfig(
        smoothness=0, spatial=0, spatio_temporal=0, depth_consistency=0, reconstruction_consistency=0
    )
    truth = Prediction(1 / scene.depth, scene.depth, scene.motions)
    seen = synthesise_views(scene.batch, truth, config).temporal_masks.amin(dim=1) > 0
    assert float(recover(scene, start, "temporal", config)[seen].mean()) < 0.02


def test_corrections_halve_the_error_of_the_recovered_depth():
    """The measured gain that method section 11 asks of every correction: here, of the masked deviation."""
    scene = slanted_plane()
    published = ObjectiveConfig(smoothness=0, spatio_temporal=0, depth_consistency=0, reconstruction_consistency=0)
    corrected = published.model_copy(update={"corrected": True})
    truth = Prediction(1 / scene.depth, scene.depth, scene.motions)
    overlap = synthesise_views(scene.batch, truth, published).overlap.masks[:, 0] > 0
    errors = [float(recover(scene, 1.3, "spatial", config)[overlap].mean()) for config in (published, corrected)]
    assert errors[1] < 0.5 * errors[0]


def test_dense_depth_consistency_is_nearer_to_the_truth_than_splatting_and_plain_warping():
    scene = slanted_plane()
    truth = Prediction(1 / scene.depth, scene.depth, scene.motions)
    views = {way: synthesise_views(scene.batch, truth, ObjectiveConfig(depth_warping=way)) for way in ("ddcl", "dcl")}
    constructed = {way: view.overlap.depth for way, view in views.items()}
    constructed["plain"] = plainly_warped_depth(scene)
    seen = inner_overlap(views["ddcl"].overlap.masks[:, 0])
    errors = {way: (depth - scene.depth).abs()[seen & (depth > 0)].mean().item() for way, depth in constructed.items()}
    assert errors["ddcl"] < 0.1 * errors["dcl"]
    assert errors["dcl"] < errors["plain"]
    holes = {way: (depth[seen] == 0).double().mean().item() for way, depth in constructed.items()}
    assert holes["ddcl"] == 0
    assert holes["dcl"] > 0.01


def plainly_warped_depth(scene: PlaneScene) -> Tensor:
    """Sample the neighbour's depth as it is, without expressing it along this camera's axis."""
    batch = scene.batch
    source_T_target = relative_poses(batch.base_T_camera, batch.targets, batch.sources)
    points = source_T_target[..., :3, :3] @ back_project(scene.depth, batch.inverse_intrinsics)[:, batch.targets]
    points = points + source_T_target[..., :3, 3:]
    grid, _ = sampling_grid(points, batch.intrinsics[:, batch.sources], scene.depth.shape[-2:])
    return sample(scene.depth[:, batch.sources], grid)


def inner_overlap(mask: Tensor) -> Tensor:
    """Leave out pixels that are sampled half outside the neighbour's image."""
    return -F.max_pool2d(-mask.flatten(0, 1), 3, stride=1, padding=1).view(mask.shape) > 0


@settings(max_examples=10, deadline=None)
@given(
    baseline=st.floats(0.2, 1.5),
    turn=st.floats(-0.1, 0.1),
    tilt=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
)
def test_dense_depth_consistency_vanishes_at_the_true_depth_and_grows_with_a_wrong_scale(baseline, turn, tilt):
    scene = slanted_plane(baseline=baseline, turn=turn, tilt=tilt)
    config = ObjectiveConfig(smoothness=0, spatial=0, spatio_temporal=0, reconstruction_consistency=0)
    losses = []
    for scale in (1.0, 1.03, 1.1, 1.3):
        depth = scene.depth.clone()
        depth[:, 0] *= scale
        value = evaluate_objective(scene.batch, Prediction(1 / depth, depth, scene.motions), config)
        losses.append(float(value.terms["depth_consistency"].mean()))
    assert losses[0] < 1e-3  # metres: z of a plane bends a little between the pixels that are interpolated
    assert losses == sorted(losses)
    assert losses[1] > 0.05


def recovered_scale(scene: PlaneScene, config: ObjectiveConfig) -> float:
    """Return what depth and motion are of the true ones after 40 steps, from 1.15 for both."""
    log_scales = torch.full((2,), 1.15, dtype=torch.float64).log().requires_grad_()
    optimizer = torch.optim.Adam([log_scales], lr=0.02)
    for _ in range(40):
        depth_scale, motion_scale = log_scales.exp()
        depth = depth_scale * scene.depth
        motions = rigid(scene.motions[..., :3, :3], motion_scale * scene.motions[..., :3, 3])
        optimizer.zero_grad()
        evaluate_objective(scene.batch, Prediction(1 / depth, depth, motions), config).loss.backward()
        optimizer.step()
    return float(log_scales[0].detach().exp())


@pytest.mark.parametrize("velocity", [0.3, -1.0])
def test_scale_is_recovered_although_one_camera_fires_half_a_frame_after_the_other(velocity):
    """Between the exposures the rig travels: at -1 m per frame, back by more than half of the baseline of 0.8 m."""
    config = ObjectiveConfig(
        spatial=1, smoothness=0, spatio_temporal=0, depth_consistency=0, reconstruction_consistency=0, corrected=True
    )
    scene = passed_plane((0.0, 0.5), velocity)
    simultaneous = dataclasses.replace(scene, batch=dataclasses.replace(scene.batch, exposure_delays=None))
    assert recovered_scale(scene, config) == pytest.approx(1, abs=0.02)
    assert abs(recovered_scale(simultaneous, config) - 1) > 0.1


def test_views_between_cameras_fit_when_the_rig_turns_between_their_exposures():
    scene = passed_plane((0.0, -0.4), velocity=0.3, yaw_rate=0.06)
    simultaneous = dataclasses.replace(scene.batch, exposure_delays=None)
    truth = Prediction(1 / scene.depth, scene.depth, scene.motions)
    told, ignored = (evaluate_objective(batch, truth, ObjectiveConfig()).terms for batch in (scene.batch, simultaneous))
    for name in ("spatial", "spatio_temporal", "depth_consistency"):
        assert told[name].mean() < 0.3 * ignored[name].mean(), name


# --- the networks on a rig


@pytest.mark.parametrize("method", ["front", "joint"])
def test_motions_lead_from_each_cameras_exposure_to_its_next(method):
    batch = random_batch(samples=2, cameras=3, height=64, width=64).to(dtype=torch.float32)
    delays = torch.tensor([[0.0, 0.03, -0.04], [0.0, -0.02, 0.05]])
    late = dataclasses.replace(batch, exposure_delays=delays, context_times=torch.tensor([[-0.1, 0.1], [-0.2, 0.1]]))
    model = SurroundModel(DepthNet(), PoseNet(), min_depth=1.5, max_depth=80, pose_method=method).eval()
    none = torch.tensor([False, False])
    motions = model(late, batch.frames, none, none).motions
    moved = late.at_exposures(motions[:, :, 0])
    torch.testing.assert_close(moved.base_T_camera[:, 0], batch.base_T_camera[:, 0])
    assert (moved.base_T_camera - batch.base_T_camera)[:, 1:].abs().amax(dim=(-2, -1)).min() > 1e-6
    expected = distribute_anchor_motion(motions[:, :, 0], moved.base_T_camera, 0)
    torch.testing.assert_close(motions, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(motions[:, :, 0], model(batch, batch.frames, none, none).motions[:, :, 0])


@pytest.mark.parametrize("method", ["front", "joint_front", "joint", "per_camera"])
def test_every_pose_method_trains_both_networks(method):
    batch = random_batch(samples=2, cameras=3, height=64, width=64).to(dtype=torch.float32)
    model = SurroundModel(DepthNet(), PoseNet(), min_depth=1.5, max_depth=80, pose_method=method)
    flips = torch.tensor([True, False])
    prediction = model(batch, batch.frames, flips, flips)
    assert prediction.motions.shape == (2, 2, 3, 4, 4)
    evaluate_objective(batch, prediction, ALL_TERMS).loss.backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_mirrored_samples_come_back_in_place_and_leave_the_others_alone():
    batch = random_batch(samples=2, cameras=3, height=64, width=64).to(dtype=torch.float32)
    model = SurroundModel(DepthNet(), PoseNet(), min_depth=1.5, max_depth=80).eval()
    none, second = torch.tensor([False, False]), torch.tensor([False, True])
    plain = model(batch, batch.frames, none, none)
    mirrored = model(batch, batch.frames.flip(-1), ~none, ~none)
    some = model(batch, batch.frames, second, none)
    torch.testing.assert_close(mirrored.disparity, plain.disparity.flip(-1), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(some.disparity[0], plain.disparity[0])
    assert not torch.allclose(some.disparity[1], plain.disparity[1], atol=1e-6)
    torch.testing.assert_close(some.motions, plain.motions)


def test_a_network_that_looks_at_the_rig_sees_a_flipped_sample_as_the_mirrored_world():
    batch = random_batch(samples=2, cameras=3, height=64, width=64).to(dtype=torch.float32)
    seen: list[RigImages] = []

    class Watching(MeanFeatureNet):
        def forward(self, rig: RigImages) -> torch.Tensor:
            seen.append(rig)
            return super().forward(rig)

    model = SurroundModel(Watching("resnet18"), PoseNet(), min_depth=1.5, max_depth=80).eval()
    none, second = torch.tensor([False, False]), torch.tensor([False, True])
    prediction = model(batch, batch.frames, second, none)
    plain = rig_images(batch, batch.images)
    for one, expected, before in zip(seen[0], mirror_rig(plain, second), plain, strict=True):
        assert torch.equal(one, expected)
        assert torch.equal(one[0], before[0])
    assert not torch.equal(seen[0].base_T_camera[1], batch.base_T_camera[1])
    torch.testing.assert_close(prediction.disparity[1], model.depth_net(seen[0])[1].flip(-1))
    evaluate_objective(batch, prediction, ALL_TERMS).loss.backward()
    assert all(parameter.grad.isfinite().all() for parameter in model.depth_net.parameters())


def test_half_precision_stays_within_the_networks():
    batch = random_batch(samples=1, cameras=3, height=64, width=64).to(dtype=torch.float32)
    model = SurroundModel(DepthNet(), PoseNet(), min_depth=1.5, max_depth=80)
    flips = torch.tensor([True])
    with torch.autocast("cpu", torch.bfloat16):
        prediction = model(batch, batch.frames, flips, flips)
        value = evaluate_objective(batch, prediction, ALL_TERMS)
    assert {tensor.dtype for tensor in (prediction.depth, prediction.motions, value.loss)} == {torch.float32}
    rotation = prediction.motions[..., :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand_as(rotation))
    value.loss.backward()
    assert all(parameter.grad.isfinite().all() for parameter in model.parameters())


# --- bad input


def damaged(**changes: Callable[[Any], Any]):
    batch = random_batch(samples=2, cameras=4, height=16, width=24)
    return dataclasses.replace(batch, **{name: change(getattr(batch, name)) for name, change in changes.items()})


def put(value: float, *index: int):
    def change(tensor: Tensor) -> Tensor:
        tensor = tensor.clone()
        tensor[index] = value
        return tensor

    return change


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"frames": put(float("nan"), 1, 0, 2, 0, 3, 3)}, ImageError, r"sample 1, camera camera2: image has 1 .* nan"),
        ({"frames": put(255.0, 0, 1, 3, 0, 3, 3)}, ImageError, r"sample 0, camera camera3: image has 1 .* 255"),
        ({"masks": put(-1.0, 0, 1, 0, 3, 3)}, ImageError, r"camera camera1: mask has 1 values .* -1"),
        ({"masks": lambda masks: masks[..., :-1]}, ImageError, r"masks of camera0.*expected \[2, 4, 1, 16, 24\]"),
        ({"intrinsics": put(0.0, 1, 2, 0, 0)}, RigError, r"sample 1, camera camera2: intrinsics"),
        ({"intrinsics": put(float("nan"), 0, 3, 1, 2)}, RigError, r"camera camera3: intrinsics .*nan"),
        ({"intrinsics": lambda K: K[:, :3]}, RigError, r"intrinsics of camera0.*expected \[2, 4, 3, 3\]"),
        ({"base_T_camera": put(2.0, 0, 1, 0, 0)}, RigError, r"sample 0, camera camera1: not a rigid transform"),
        ({"sources": lambda s: s[:-1]}, RigError, r"neighbour pairs: shapes"),
        ({"sources": lambda s: s.fill_(9)}, RigError, r"neighbour pair \(0, 9\).* 4 cameras"),
        ({"sources": lambda s: s.fill_(1)}, RigError, r"a pair occurs twice|two different indices"),
        ({"camera_names": lambda names: names[:3]}, RigError, r"4 cameras.* 3 camera names"),
        ({"frames": lambda frames: frames[:, :, :, :1]}, ImageError, r"expected \[B, 1 \+ F, N, 3, H, W\]"),
        (
            {"exposure_delays": lambda _: torch.ones(2, 3)},
            RigError,
            r"exposure_delays: found \[2, 3\].*seconds \[2, 4\]",
        ),
        ({"exposure_delays": lambda _: torch.ones(2, 4)}, RigError, r"context_times: found \[0\].*seconds \[2, 2\]"),
        (
            {"exposure_delays": lambda _: torch.ones(2, 4), "context_times": lambda _: torch.zeros(2, 2)},
            RigError,
            r"context_times .* of the target's moment",
        ),
        ({"anchor": lambda _: 4}, RigError, r"anchor camera is index 4, expected 0 to 3"),
    ],
)
def test_bad_input_is_refused_where_it_enters_by_camera_and_value(changes, error, message):
    with pytest.raises(error, match=message):
        damaged(**changes)


def test_a_camera_without_a_neighbour_is_named():
    targets, sources = ring_neighbours(4)
    keep = targets != 2
    with pytest.raises(RigError, match=r"camera camera2: no neighbour"):
        damaged(targets=lambda _: targets[keep], sources=lambda _: sources[keep])
