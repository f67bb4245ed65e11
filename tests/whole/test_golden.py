# SPDX-License-Identifier: Apache-2.0
"""Equality with the published program: every array family of golden/README.md, a to h.

float64 to 1e-9 of the greatest value, float32 to the tolerances of the README. What we do differently on purpose is
asserted to be what method.md says it is.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from golden_arrays import FLOAT64, GoldenArrays, assert_equal, assert_equal_each, assert_masks_equal, weight
from numpy.typing import NDArray
from torch import Tensor, nn

from cvcdepth_core.networks import DepthNet, PoseNet, disparity_to_depth
from cvcdepth_core.networks.mirroring import fuse_flipped, mirror, mirror_motion
from cvcdepth_core.rendering.photometric import masked_mean, photometric_error, ssim_distance
from cvcdepth_core.rendering.projection import back_project, rigid_inverse, transform
from cvcdepth_core.rendering.view_synthesis import align_intensity, overlap_statistics, sample, warp_views
from cvcdepth_core.scoring.ground_truth import downsample_ground_truth, sample_prediction
from cvcdepth_core.scoring.metrics import METRIC_NAMES
from cvcdepth_core.scoring.scorer import DepthSamples, SurroundScorer
from cvcdepth_core.scoring.scores import ALL, Score, ScoreSettings
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_core.training import objective
from cvcdepth_core.training.augmentation import apply_changes
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.losses import auto_mask, smoothness
from cvcdepth_core.training.motion import distribute_anchor_motion, motion_to_context, relative_poses
from cvcdepth_core.training.objective import (
    ObjectiveConfig,
    Prediction,
    evaluate_objective,
    masked_errors,
    synthesise_views,
)

CAMERAS = ["front", "front_left", "front_right", "back_left", "back_right", "back"]
NEIGHBOURS = {0: [1, 2], 1: [0, 3], 2: [0, 4], 3: [1, 5], 4: [2, 5], 5: [3, 4]}
PAIRS = torch.tensor([(camera, other) for camera in NEIGHBOURS for other in NEIGHBOURS[camera]])
LOSS_COLUMNS = [
    "temporal",
    "smoothness",
    "spatial",
    "spatio_temporal",
    "depth_consistency",
    "reconstruction_consistency",
]
RANGES = {"ddad": (1.5, 200.0), "nuscenes": (1.0, 80.0)}
DEPTH_FLOAT32, LOSS_FLOAT32, GRADIENT_FLOAT32 = 1e-4, 1e-5, 1e-4


class Golden(GoldenArrays):
    unseen: ClassVar[dict[str, set[str]]] = {}


@pytest.fixture
def golden_dir(request: pytest.FixtureRequest) -> Path:
    directory = request.config.getoption("--golden-dir")
    assert directory.is_dir(), f"--golden-dir {directory} is no directory"
    return directory


# --- a, b: the networks


def define_weights(network: nn.Module) -> None:
    """Fill a network as the golden README defines its weights: by key."""
    network.load_state_dict({key: weight(key, value) for key, value in network.state_dict().items()})


@pytest.mark.parametrize("kind", ["depth_net", "pose_net"])
@pytest.mark.parametrize("encoder", ["resnet18", "resnet34"])
def test_networks_have_the_keys_and_shapes_of_the_released_checkpoints(golden_dir, kind, encoder):
    network = DepthNet(encoder) if kind == "depth_net" else PoseNet(encoder)
    listed = (golden_dir / f"state_dict_{kind}_{encoder}.txt").read_text().splitlines()
    ours = [f"module.{key}\t{list(value.shape)}" for key, value in network.state_dict().items()]
    assert sorted(ours) == sorted(listed)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("mode", ["eval", "train"])
@pytest.mark.parametrize("encoder", ["resnet18", "resnet34"])
def test_a_depth_network(golden_dir, encoder, mode, dtype):
    golden = Golden(golden_dir / f"a_depth_net_{encoder}.npz")
    tolerance = FLOAT64 if dtype == torch.float64 else DEPTH_FLOAT32
    network = DepthNet(encoder).to(dtype)
    define_weights(network)
    network.train(mode == "train")
    features = network.depth_encoder(golden.tensor("in_image", dtype))
    disparity = network.depth_decoder(features)
    assert_equal_each(disparity, golden[f"out_disp_{mode}"], tolerance)
    for name, (nearest, farthest) in RANGES.items():
        depth = disparity_to_depth(disparity, golden.tensor("in_K", dtype)[:, 0, 0], nearest, farthest)
        assert_equal_each(depth, golden[f"out_depth_{mode}_{name}"], tolerance)
    for level, feature in enumerate(features):
        if encoder == "resnet18" and mode == "eval":
            assert_equal(feature, golden[f"out_feat{level}_eval"], 1e-6)  # stored as float32
        else:
            assert_equal(feature.mean(dim=(2, 3)), golden[f"out_feat{level}_mean_{mode}"], tolerance)
    if mode == "train":
        statistics = network.depth_encoder.encoder.bn1
        assert_equal(statistics.running_mean, golden["out_bn1_running_mean_after_train_fwd"], tolerance)
        assert_equal(statistics.running_var, golden["out_bn1_running_var_after_train_fwd"], tolerance)


@pytest.mark.parametrize("mode", ["eval", "train"])
@pytest.mark.parametrize("encoder", ["resnet18", "resnet34"])
def test_b_pose_network(golden_dir, encoder, mode):
    golden = Golden(golden_dir / f"b_pose_net_{encoder}.npz")
    network = PoseNet(encoder).double()
    define_weights(network)
    network.train(mode == "train")
    frames = {frame: golden.tensor(f"in_front_{frame}").unsqueeze(1) for frame in ("m1", "0", "p1")}
    for context, earlier, later in (("m1", "m1", "0"), ("p1", "0", "p1")):
        axis_angle, translation = network(frames[earlier], frames[later])
        assert_equal(axis_angle, golden[f"out_axisangle_{context}_{mode}"])
        assert_equal(translation, golden[f"out_translation_{context}_{mode}"])
        motion = motion_to_context(axis_angle, translation, backward=context == "m1")
        assert_equal(motion, golden[f"out_cam_T_cam_0_{context}_{mode}"])


# --- c: view synthesis


def inputs_of_views(golden: Golden) -> dict[str, Tensor]:
    named = {name: golden.tensor(f"in_{name}") for name in ("color_0", "color_p1", "mask", "disp", "extrinsics")}
    named["K"] = golden.tensor("in_K")[..., :3, :3]
    named["inv_K"] = golden.tensor("in_inv_K")[..., :3, :3]
    named["depth"] = disparity_to_depth(named["disp"], named["K"][..., 0, 0], *RANGES["ddad"])
    return named


def test_c_depth_of_the_views(golden_dir):
    golden = Golden(golden_dir / "c_view_warps.npz")
    assert_equal_each(inputs_of_views(golden)["depth"], golden["out_depth"])


def check_warp(
    golden: Golden, suffix: str, reference: int, source: int, frame: str, source_T_reference: Tensor
) -> None:
    """Compare one rendered view: pose, sampling positions, image, mask, aligned image and statistics."""
    at = inputs_of_views(golden)
    warp = warp_views(
        back_project(at["depth"], at["inv_K"])[:, reference],
        at[frame][:, source],
        at["mask"][:, source],
        source_T_reference,
        at["K"][:, source],
        in_front_only=False,
    )
    target, target_mask = at["color_0"][:, reference], at["mask"][:, reference]
    aligned = align_intensity(warp.images, warp.masks, target, target_mask, masked_deviation=False)
    assert_equal(warp.images, golden[f"out_img_{suffix}"])
    assert_masks_equal(warp.masks, golden[f"out_mask_{suffix}"])
    assert_equal(aligned, golden[f"out_aligned_{suffix}"])
    if suffix.startswith("temporal"):
        return
    assert_equal(source_T_reference, golden[f"out_T_{suffix}"])
    assert_equal_each(warp.grid, golden[f"out_pix_{suffix}"])
    both = (warp.masks * target_mask) > 0
    for name, images in (("ref", target), ("warp", warp.images)):
        mean, deviation = overlap_statistics(images, both, masked_deviation=False)
        assert_equal(mean, golden[f"out_mean_{name}_{suffix}"])
        assert_equal(deviation, golden[f"out_std_{name}_{suffix}"])


@pytest.mark.parametrize(("reference", "source"), [(0, 1), (1, 0), (1, 3), (5, 4)])
def test_c_spatial_and_spatio_temporal_warps(golden_dir, reference, source):
    golden = Golden(golden_dir / "c_view_warps.npz")
    pair = relative_poses(golden.tensor("in_extrinsics"), torch.tensor([reference]), torch.tensor([source]))[:, 0]
    own_motion = golden.tensor("in_T_ref")
    check_warp(golden, f"spatial_ref{reference}_src{source}", reference, source, "color_0", pair)
    check_warp(golden, f"spatiotemporal_ref{reference}_src{source}", reference, source, "color_p1", pair @ own_motion)


@pytest.mark.parametrize("camera", [0, 4])
def test_c_temporal_warps(golden_dir, camera):
    golden = Golden(golden_dir / "c_view_warps.npz")
    check_warp(golden, f"temporal_cam{camera}", camera, camera, "color_p1", golden.tensor("in_T_ref"))


@pytest.mark.parametrize(("reference", "source"), [(0, 1), (1, 0), (1, 3), (5, 4)])
def test_c_dense_depth_consistency_construction(golden_dir, reference, source):
    golden = Golden(golden_dir / "c_view_warps.npz")
    suffix = f"ref{reference}_src{source}"
    at = inputs_of_views(golden)
    source_T_reference = golden.tensor(f"out_T_spatial_{suffix}")
    points = back_project(at["depth"], at["inv_K"])
    source_z = transform(rigid_inverse(source_T_reference), points[:, source])[:, 2:].reshape(1, 1, 32, 56)
    assert_equal(source_z, golden[f"out_src_depth_in_ref_frame_{suffix}"])
    assert_equal(
        sample(source_z, golden.tensor(f"out_pix_spatial_{suffix}")), golden[f"out_ddcl_warped_depth_{suffix}"]
    )
    assert_masks_equal(golden.tensor(f"out_mask_spatial_{suffix}"), golden[f"out_ddcl_warped_mask_{suffix}"])


# --- d: loss terms and the complete step


def test_d_loss_terms(golden_dir):
    golden = Golden(golden_dir / "d_loss_terms.npz")
    prediction = golden.tensor("in_pred").requires_grad_()
    target, mask = golden.tensor("in_target"), golden.tensor("in_mask")
    photometric = photometric_error(prediction, target)
    assert_equal(ssim_distance(prediction.detach(), target), golden["out_ssim_loss"])
    assert_equal(photometric, golden["out_photometric"])
    identity = golden.tensor("in_identity_loss")
    assert_masks_equal(auto_mask(photometric, identity), golden["out_auto_mask"])
    # The release pools the samples of a batch; one tall image pools the same pixels.
    pooled = masked_mean(photometric.flatten(0, 2).unsqueeze(0), mask.flatten(0, 2).unsqueeze(0))
    assert_equal(pooled, golden["out_masked_photometric"])
    pooled.backward()
    assert_equal(prediction.grad, golden["out_grad_masked_photometric_wrt_pred"])
    assert_equal(masked_mean(photometric, torch.zeros_like(mask)).mean(), golden["out_masked_zero_mask"])


def test_d_smoothness(golden_dir):
    golden = Golden(golden_dir / "d_loss_terms.npz")
    disparity = golden.tensor("in_disp").requires_grad_()
    loss = smoothness(disparity, golden.tensor("in_target")).mean()
    assert_equal(loss, golden["out_smooth_loss"])
    loss.backward()
    assert_equal(disparity.grad, golden["out_grad_smooth_wrt_disp"])


@dataclass
class Step:
    """One complete step of the published program: its inputs, ours for its `samples`."""

    golden: Golden
    batch: RigBatch
    network_disparity: Tensor
    vectors: dict[str, Tensor]
    noise: Tensor
    config: ObjectiveConfig
    depth_range: tuple[float, float]
    flips: Tensor

    def predict(self) -> Prediction:
        motions = torch.stack([self.motion("m1", backward=True), self.motion("p1", backward=False)], dim=1)
        motions = mirror_motion(motions, self.flips)
        disparity = mirror(self.network_disparity, self.flips)
        depth = disparity_to_depth(disparity, self.batch.intrinsics[..., 0, 0], *self.depth_range)
        return Prediction(disparity, depth, distribute_anchor_motion(motions, self.batch.base_T_camera, 0))

    def motion(self, context: str, backward: bool) -> Tensor:
        axis_angle, translation = self.vectors[f"axisangle_{context}"], self.vectors[f"translation_{context}"]
        return motion_to_context(axis_angle, translation, backward)


def load_step(path: Path, dtype: torch.dtype = torch.float64, samples: slice = slice(None)) -> Step:
    golden = Golden(path)

    def tensor(name: str) -> Tensor:
        return golden.tensor(f"in_{name}", dtype)[samples]

    vectors = {
        f"{kind}_{f}": tensor(f"{kind}_{f}")[:, 0, 0] for kind in ("axisangle", "translation") for f in ("m1", "p1")
    }
    nuscenes, noise = "nuscenes" in path.name, golden.tensor("in_identity_noise", dtype)
    batch = RigBatch(
        frames=torch.stack([tensor("color_0"), tensor("color_m1"), tensor("color_p1")], dim=1),
        masks=tensor("mask"),
        intrinsics=tensor("K")[..., :3, :3],
        base_T_camera=tensor("extrinsics"),
        targets=PAIRS[:, 0],
        sources=PAIRS[:, 1],
        camera_names=CAMERAS,
    )
    flips = torch.full((len(batch.frames),), "flipped" in path.name)
    return Step(
        golden=golden,
        batch=batch,
        network_disparity=mirror(tensor("disp"), flips).requires_grad_(),
        vectors={name: vector.requires_grad_() for name, vector in vectors.items()},
        noise=noise.permute(1, 2, 0, 3, 4).unsqueeze(3)[samples],
        config=ObjectiveConfig(reconstruction_consistency=0.05 if nuscenes else 0.2),
        depth_range=RANGES["nuscenes" if nuscenes else "ddad"],
        flips=flips,
    )


def check_losses_and_gradients(step: Step, expected: Golden, loss_tolerance: float, gradient_tolerance: float) -> None:
    value = evaluate_objective(step.batch, step.predict(), step.config, step.noise)
    columns = torch.stack([value.terms[name][0] for name in LOSS_COLUMNS], dim=-1)
    assert_equal_each(columns, expected["out_per_camera_losses"][:, :6], loss_tolerance)
    assert_equal_each(value.loss, expected["out_total_loss"], loss_tolerance)
    assert_equal_each(value.loss, expected["out_per_camera_losses"][:, 6].mean(), loss_tolerance)
    value.loss.backward()
    check_gradients(step, expected, gradient_tolerance)


def check_gradients(step: Step, expected: Golden, gradient_tolerance: float) -> None:
    assert_equal(step.network_disparity.grad, expected["out_grad_total_wrt_net_disp"], gradient_tolerance)
    for name, vector in step.vectors.items():
        assert_equal(vector.grad, expected[f"out_grad_{name}"], gradient_tolerance)


@pytest.mark.parametrize("name", ["d_full_b1_ddad", "d_full_b1_nuscenes", "f_full_b1_ddad_flipped"])
def test_d_and_f_losses_and_gradients_of_a_complete_step(golden_dir, name):
    step = load_step(golden_dir / f"{name}.npz")
    check_losses_and_gradients(step, step.golden, FLOAT64, FLOAT64)


def test_d_losses_and_gradients_in_float32(golden_dir):
    step = load_step(golden_dir / "d_full_b1_ddad.npz", torch.float32)
    expected = Golden(golden_dir / "d_full_b1_ddad_float32.npz")
    check_losses_and_gradients(step, expected, LOSS_FLOAT32, GRADIENT_FLOAT32)


def check_motions_and_depth(step: Step) -> None:
    prediction = step.predict()
    for index, frame in enumerate(("m1", "1")):
        assert_equal(prediction.motions[:, index], step.golden[f"out_cam_T_cam_0_{frame}"])
    assert_equal_each(prediction.depth, step.golden["out_depth_0"])


def test_d_every_view_and_mask_of_a_complete_step(golden_dir):
    step = load_step(golden_dir / "d_full_b1_ddad.npz")
    check_motions_and_depth(step)
    prediction = step.predict()
    views = synthesise_views(step.batch, prediction, step.config)
    for index, frame in enumerate(("m1", "1")):
        assert_equal(views.temporal[:, index], step.golden[f"out_color_{frame}_0"])
        assert_masks_equal(views.temporal_masks[:, index], step.golden[f"out_color_mask_{frame}_0"])
    for index, frame in enumerate(("0", "m1", "1")):
        assert_equal(views.overlap.images[:, index], step.golden[f"out_overlap_{frame}_0"])
        assert_masks_equal(views.overlap.masks[:, index], step.golden[f"out_overlap_mask_{frame}_0"])
    assert_equal(views.overlap.depth, step.golden["out_overlap_depth_0_0"])
    errors = masked_errors(step.batch, prediction, views, step.config, step.noise)
    assert_masks_equal(errors["temporal"][1], step.golden["out_auto_mask_times_ref_mask"])


def test_d_the_release_constructs_no_depth_for_the_context_frames(golden_dir):
    golden = Golden(golden_dir / "d_full_b1_ddad.npz")
    assert not golden["out_overlap_depth_m1_0"].any()
    assert not golden["out_overlap_depth_1_0"].any()


def losses_coupled_as_in_the_release(step: Step) -> Tensor:
    """Pool the masked means over the batch, as the release does: per camera [6, 6]."""
    prediction = step.predict()
    views = synthesise_views(step.batch, prediction, step.config)
    errors = masked_errors(step.batch, prediction, views, step.config, step.noise)
    columns = {name: pooled_masked_mean(error, mask) for name, (error, mask) in errors.items()}
    columns["reconstruction_consistency"] = columns["reconstruction_consistency"].mean(dim=0)
    columns["smoothness"] = smoothness(prediction.disparity, step.batch.images).mean(dim=0)
    return torch.stack([columns[name] for name in LOSS_COLUMNS], dim=-1)


def check_coupled_gradients(step: Step) -> None:
    weights = torch.tensor([getattr(step.config, name, 1.0) for name in LOSS_COLUMNS], dtype=torch.float64)
    total = (losses_coupled_as_in_the_release(step) * weights).sum(dim=-1).mean()
    assert_equal_each(total, step.golden["out_total_loss"])
    total.backward()
    check_gradients(step, step.golden, FLOAT64)


def pooled_masked_mean(error: Tensor, mask: Tensor) -> Tensor:
    over = (0, -3, -2, -1)
    return (error * mask).sum(over) / (mask.sum(over) + 1e-8)


def test_d_a_batch_is_the_mean_of_its_samples_where_the_release_pools_them(golden_dir):
    path = golden_dir / "d_full_b2_ddad.npz"
    both = load_step(path)
    value = evaluate_objective(both.batch, both.predict(), both.config, both.noise)
    for index in (0, 1):
        assert_equal_each(value.per_sample[index], both.golden[f"out_total_loss_sample{index}_alone"])
        columns = torch.stack([value.terms[name][index] for name in LOSS_COLUMNS], dim=-1)
        assert_equal_each(columns, both.golden[f"out_per_camera_losses_sample{index}_alone"][:, :6])
    assert_equal_each(value.loss, value.per_sample.detach().mean().numpy())
    assert_equal_each(losses_coupled_as_in_the_release(both), both.golden["out_per_camera_losses"][:, :6])
    check_coupled_gradients(both)
    assert abs(value.loss.item() / float(both.golden["out_total_loss"]) - 1) > 1e-4


def test_d_a_sample_without_overlap_does_not_change_the_others(golden_dir):
    plain = load_step(golden_dir / "d_full_b2_ddad.npz")
    masked = load_step(golden_dir / "d_full_b2_ddad_alignskip.npz")
    assert not masked.batch.masks[1, 3].any()
    value = evaluate_objective(masked.batch, masked.predict(), masked.config, masked.noise)
    assert_equal_each(value.per_sample[0], plain.golden["out_total_loss_sample0_alone"])


def test_d_skipping_the_alignment_of_the_whole_batch_gives_the_released_value(golden_dir, monkeypatch):
    def align_all_or_none(warped, warp_mask, target, target_mask, masked_deviation, **whole: Any):
        aligned = align_intensity(warped, warp_mask, target, target_mask, masked_deviation, **whole)
        overlaps = ((warp_mask * target_mask) > 0).any(dim=-1, keepdim=True).any(dim=-2, keepdim=True)
        return torch.where(overlaps.all(dim=0), aligned, warped)

    step = load_step(golden_dir / "d_full_b2_ddad_alignskip.npz")
    monkeypatch.setattr(objective, "align_intensity", align_all_or_none)
    assert_equal_each(losses_coupled_as_in_the_release(step), step.golden["out_per_camera_losses"][:, :6])
    check_coupled_gradients(step)


# --- e, f: poses and mirroring


def test_e_vectors_to_matrices(golden_dir):
    golden = Golden(golden_dir / "e_vec_to_matrix.npz")
    vectors = golden.tensor("in_axisangle")[:, 0], golden.tensor("in_translation")[:, 0]
    assert_equal(motion_to_context(*vectors, backward=False), golden["out_T"])
    assert_equal(motion_to_context(*vectors, backward=True), golden["out_T_inverted"])


def test_e_pose_distribution(golden_dir):
    golden = Golden(golden_dir / "e_pose_distribution.npz")
    base_T_camera = golden.tensor("in_extrinsics")
    frames = {"0": torch.eye(4, dtype=torch.float64).expand_as(base_T_camera)}
    for context in ("m1", "p1"):
        vectors = (golden.tensor(f"in_{kind}_{context}")[:, 0, 0] for kind in ("axisangle", "translation"))
        front = motion_to_context(*vectors, backward=context == "m1")
        assert_equal(front, golden[f"out_front_T_{context}"])
        frames[context.removeprefix("p")] = distribute_anchor_motion(front.unsqueeze(1), base_T_camera, 0)[:, 0]
        assert_equal(frames[context.removeprefix("p")], golden[f"out_cam_T_{context}"])
    across = relative_poses(base_T_camera, PAIRS[:, 0], PAIRS[:, 1])
    for frame, motions in frames.items():
        for index, (reference, source) in enumerate(PAIRS.tolist()):
            name = f"out_rel_T_frame{frame}_ref{reference}_src{source}"
            assert_equal(across[:, index] @ motions[:, reference], golden[name])


def test_f_mirrored_poses_for_a_batch_with_one_coin_per_sample(golden_dir):
    golden = Golden(golden_dir / "f_hflip_pose.npz")
    assert "ambiguous" in str(golden["batch2_error"])  # the release knows one coin per batch only
    for flips in ([False, False], [False, True], [True, False], [True, True]):
        for context in ("m1", "p1"):
            vectors = (golden.tensor(f"in_{kind}_{context}")[:, 0, 0] for kind in ("axisangle", "translation"))
            ours = mirror_motion(motion_to_context(*vectors, backward=context == "m1"), torch.tensor(flips))
            for index, flip in enumerate(flips):
                assert_equal(ours[index], golden[f"out_sample{index}_flip{int(flip)}_front_T_{context}"])


def test_f_mirrored_disparity(golden_dir):
    golden = Golden(golden_dir / "f_hflip_disp.npz")
    disparity = golden.tensor("in_net_output").unsqueeze(0)
    for flip in (0, 1):
        assert_equal(mirror(disparity, torch.tensor([bool(flip)])), golden[f"out_disp_flip{flip}"])


def test_f_motions_and_depth_of_a_flipped_step(golden_dir):
    check_motions_and_depth(load_step(golden_dir / "f_full_b1_ddad_flipped.npz"))


# --- g: evaluation


@pytest.mark.parametrize(
    ("dtype", "name", "tolerance"), [(torch.float64, "f64", FLOAT64), (torch.float32, "f32", 1e-5)]
)
@pytest.mark.parametrize("dataset", ["ddad", "nuscenes"])
def test_g_metrics_per_image_and_pooled(golden_dir, dataset, dtype, name, tolerance):
    golden = Golden(golden_dir / "g_metrics.npz")
    scorer = SurroundScorer("golden", CAMERAS, ScoreSettings(max_depth=RANGES[dataset][1]))
    sets = zip(golden.tensor("in_pred_depth", dtype), golden.tensor("in_gt_depth", dtype), strict=True)
    for index, images in enumerate(sets):
        scorer.add(index, [depth_samples(p, t) for p, t in zip(*(i[:, 0].numpy() for i in images), strict=True)])
    scores = scorer.scores()
    for scaling in ("metric", "median"):
        per_image, pooled = (scores.summary(protocol, scaling) for protocol in ("image", "pool"))
        expected = golden[f"out_{scaling}_perframe_mean_{dataset}_{name}"]
        assert_equal_each(metric_row(per_image.mean[ALL]), expected, tolerance)
        assert_equal_each(metric_row(pooled.mean[ALL]), golden[f"out_{scaling}_{dataset}_{name}"], tolerance)
        if scaling == "metric":
            per_camera = torch.stack([metric_row(score[ALL]) for score in pooled.cameras.values()])
            assert_equal_each(per_camera, golden[f"out_metric_percam_{dataset}_{name}"], tolerance)


def depth_samples(prediction: NDArray[np.floating], truth_image: NDArray[np.floating]) -> DepthSamples:
    truth = SparseDepth.from_image(truth_image)
    return DepthSamples(sample_prediction(prediction, truth), truth.depth, np.zeros(len(truth), dtype=bool))


def metric_row(score: Score) -> Tensor:
    return torch.tensor([score.metrics[name] for name in METRIC_NAMES], dtype=torch.float64)


def test_g_flip_fusion(golden_dir):
    golden = Golden(golden_dir / "g_post_process.npz")
    fused = fuse_flipped(golden.tensor("in_depth"), golden.tensor("in_depth_from_flipped_image_flipped_back"))
    assert_equal_each(fused, golden["out_depth"])


# --- h: preparation of inputs


def test_h_intrinsics_scale_with_the_image_without_a_half_pixel_shift(golden_dir):
    golden = Golden(golden_dir / "h_preprocess.npz")
    (height, width), (height0, width0) = golden["resize_shape"], golden["in_image"].shape[:2]
    scale = torch.tensor([[width / width0], [height / height0], [1.0]])
    assert_equal(scale * golden.tensor("in_K"), golden["out_K"], 1e-6)


def test_h_resized_image_and_mask(golden_dir):
    """The release resizes with Pillow's LANCZOS; area averaging, which is ours, differs from it only at edges."""
    cv2 = pytest.importorskip("cv2")
    golden = Golden(golden_dir / "h_preprocess.npz")
    height, width = golden["resize_shape"]
    for name, image in (("out_image", golden["in_image"]), ("out_mask", golden["in_mask"])):
        area = cv2.resize(image, (int(width), int(height)), interpolation=cv2.INTER_AREA).astype(float)
        difference = np.abs(area - golden[name])
        assert difference.mean() < 0.05 * 255
        assert np.corrcoef(area.ravel(), golden[name].ravel())[0, 1] > 0.97
    assert len(np.unique(golden["out_mask"])) > 2  # soft, not binarised
    rgb = golden["out_image"].transpose(2, 0, 1) / 255
    assert_equal(torch.tensor(rgb), golden["out_tensor_rgb"], 1e-6)


def test_h_ground_truth_at_network_resolution(golden_dir):
    golden = Golden(golden_dir / "h_preprocess.npz")
    smaller = downsample_ground_truth(golden["in_depth"], *golden["resize_shape"].tolist())
    assert np.array_equal(smaller, golden["out_depth"][..., 0])
    assert np.array_equal(smaller, golden["out_tensor_depth"][0])


@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize("frame", ["", "_context"])
def test_h_color_jitter_up_to_the_8_bit_steps_of_the_release(golden_dir, seed, frame):
    """The release rounds to 8 bits after every change and to 8-bit HSV for the hue; ours stays in floats."""
    golden = Golden(golden_dir / "h_preprocess.npz")
    changes = parse_changes(golden[f"jitter_ops_train_seed{seed}"])
    ours = apply_changes(image_of_frame(golden, frame), changes).permute(1, 2, 0) * 255
    difference = (ours - golden.tensor(f"out_jitter{frame}_train_seed{seed}")).abs()
    assert float(difference.mean()) < 2
    assert float(difference.max()) < 10


@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize("frame", ["", "_context"])
def test_h_evaluation_drops_the_hsv_round_trip(golden_dir, seed, frame):
    golden = Golden(golden_dir / "h_preprocess.npz")
    image = image_of_frame(golden, frame)
    torch.testing.assert_close(apply_changes(image, parse_changes(golden[f"jitter_ops_eval_seed{seed}"])), image)
    round_trip = (golden.tensor(f"out_jitter{frame}_eval_seed{seed}") - image.permute(1, 2, 0) * 255).abs()
    assert 0.5 < float(round_trip.max()) < 4.5


def image_of_frame(golden: Golden, frame: str) -> Tensor:
    """Return the target frame, or the context frame, for which the golden uses the mirrored image: [3, H, W]."""
    image = torch.tensor(golden["out_image"]).permute(2, 0, 1) / 255.0
    return image.flip(-1) if frame else image


def parse_changes(operations: NDArray[np.generic]) -> list[tuple[str, float]]:
    pairs = (operation.removeprefix("adjust_").split(":") for operation in operations.tolist())
    return [(name, float(amount)) for name, amount in pairs]


def test_z_no_array_was_left_out(golden_dir, request):
    """The last test of the file: between them, the tests above have looked at every output of every file."""
    selected = request.config.getoption("keyword") or any("::" in argument for argument in request.config.args)
    if selected:
        pytest.skip("only meaningful after the whole file")
    assert {path.name for path in golden_dir.glob("*.npz")} == set(Golden.unseen)
    assert {name: left for name, left in Golden.unseen.items() if left} == {}
