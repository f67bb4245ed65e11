# SPDX-License-Identifier: Apache-2.0
"""Equality with VFDepth's published program: every array family of golden_vfdepth/README.md, a to h, and x.

The program loops over cameras; ours takes all at once, and convolves before it samples. Values to 1e-9 and gradients
to 1e-8 of the greatest one. What we do differently on purpose is asserted to be what docs/networks.md says it is.
"""

from pathlib import Path
from typing import ClassVar, NamedTuple

import pytest
import torch
from golden_arrays import FLOAT64, GoldenArrays, assert_equal, assert_equal_each, assert_masks_equal, weight
from torch import Tensor, nn

from cvcdepth_core.networks import RigImages, disparity_to_depth
from cvcdepth_core.networks.pose import PoseDecoder
from cvcdepth_core.networks.vfdepth import (
    DEPTH_NAMES,
    POSE_NAMES,
    BirdsEyeView,
    FusedDepthNet,
    VolumePoseNet,
    VolumeViews,
    VoxelFusion,
    mean_voxels,
    renamed,
)
from cvcdepth_core.networks.volume import (
    Ring,
    VolumeSpec,
    VoxelViews,
    feature_size,
    fusion_geometry,
    interpolated,
    project_voxels,
    ray_geometry,
    ring_of,
    voxel_views,
)
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.losses import smoothness
from cvcdepth_core.training.model import SurroundModel
from cvcdepth_core.training.motion import distribute_anchor_motion, motion_to_context
from cvcdepth_core.training.novel_views import (
    NovelViews,
    NovelViewsConfig,
    consistency_of_views,
    novel_poses,
    smoothness_of_views,
    turns_of,
    warped_depth,
)
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
GRADIENT = 1e-8
CONTEXTS = ("m1", "p1")
FAMILIES = "abcdefghx"


class Golden(GoldenArrays):
    unseen: ClassVar[dict[str, set[str]]] = {}


def golden_directory(config: pytest.Config) -> Path:
    directory = config.getoption("--golden-vfdepth-dir")
    assert directory.is_dir(), f"--golden-vfdepth-dir {directory} is no directory"
    return directory


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test takes every file of the families in its name: test_a_..., test_fh_...; `path` is one of them."""
    if "path" not in metafunc.fixturenames:
        return
    families, directory = metafunc.function.__name__.split("_")[1], golden_directory(metafunc.config)
    files = sorted(path for family in families for path in directory.glob(f"{family}_*.npz"))
    own = [path for path in files if path.stem not in ("f_full_step_b2_more", "g_end_to_end_float32")]
    metafunc.parametrize("path", own, ids=[path.stem for path in own])


def rig_of(golden: Golden, images: Tensor | None = None) -> RigImages:
    masks, extrinsics = golden.tensor("in_mask_u8") / 255, golden.tensor("in_extrinsics")
    if images is None:
        images = masks.new_zeros(()).expand(*masks.shape[:2], 3, *masks.shape[-2:])
    present = torch.ones(masks.shape[:2], dtype=torch.bool)
    return RigImages(images, golden.tensor("in_K")[..., :3, :3], extrinsics, present, masks)


def volume_of(golden: Golden, image_channels: int, voxel_channels: int) -> VolumeSpec:
    nearest, farthest, steps = golden["cfg_depth_bins"].tolist()
    voxels = golden["cfg_voxel_size"].tolist()
    return VolumeSpec(
        voxels=voxels,
        voxel_size=golden["cfg_voxel_unit_size"].tolist(),
        first_voxel=golden["cfg_voxel_str_p"].tolist(),
        nearest=nearest,
        farthest=farthest,
        steps=int(steps),
        image_channels=image_channels,
        voxel_channels=voxel_channels,
        depth_unit=voxels[0],
        skips="cfg_use_skips" in golden and bool(golden["cfg_use_skips"]),
    )


def volume_of_network(golden: Golden) -> VolumeSpec:
    if "cfg_fusion_feat_in_dim" not in golden:
        return volume_of(golden, 256, 64)
    return volume_of(golden, int(golden["cfg_fusion_feat_in_dim"]), int(golden["cfg_voxel_pre_dim"]))


def by_rule(network: nn.Module, names: dict[str, str], seed: int, prefix: str = "") -> None:
    """Fill a network as the README defines its weights: by the program's keys."""
    released = renamed(network.state_dict(), {ours: theirs for theirs, ours in names.items()})
    state = {key: weight(key, like, seed, 1 if key.startswith("encoder.") else 2) for key, like in released.items()}
    network.load_state_dict(renamed(state, names))


def stored(golden: Golden, module: nn.Module, names: dict[str, str]) -> None:
    """Fill a module by the weights of the file; `names` are ours for theirs."""
    state = {ours + kind: golden.tensor(f"w_{theirs}.{kind}") for theirs, ours in names.items() for kind in KINDS}
    module.double().load_state_dict(state)


KINDS = ("weight", "bias")


# --- a, x: the volume


class Volume(NamedTuple):
    spec: VolumeSpec
    rig: RigImages
    ring: Ring
    features: Tensor
    fusion: VoxelFusion
    voxels: Tensor
    """[B, V, Q]."""
    views: VoxelViews


def filled_volume(golden: Golden) -> Volume:
    features = golden.tensor("in_feats").requires_grad_()
    spec = volume_of(golden, features.shape[2], golden["w_conv_non_overlap.0.weight"].shape[0])
    rig = rig_of(golden)
    ring = ring_of(rig.base_T_camera)
    if "in_slots" in golden:
        ring = ring._replace(slots=torch.tensor(golden["in_slots"]).expand_as(ring.slots))
    fusion = VoxelFusion(spec.image_channels, spec.voxel_channels)
    stored(golden, fusion, {"conv_overlap.0": "overlap.", "conv_non_overlap.0": "alone."})
    views = voxel_views(spec, rig)
    geometry = fusion_geometry(spec, views, ring, feature_size(rig.images))
    voxels = fusion(features.flatten(0, 1), geometry)
    return Volume(spec, rig, ring, features, fusion, voxels.unflatten(0, (len(features), -1)), views)


def sampled_rays(volume: Volume) -> Tensor:
    """[B, N, Q D, h, w] as the program has it, channel q D + k."""
    size = feature_size(volume.rig.images)
    rays = ray_geometry(volume.spec, volume.rig.intrinsics, volume.rig.base_T_camera, size)
    rows = rays.sum_of(volume.voxels.flatten(0, 1))
    whole = rows.view(*volume.rig.images.shape[:2], size[0] + 2, size[1] + 2, volume.spec.steps, -1)
    return whole[:, :, 1:-1, 1:-1].permute(0, 1, 5, 4, 2, 3).flatten(2, 3)


def test_a_where_each_camera_sees_each_voxel(path):
    golden = Golden(path)
    volume = filled_volume(golden)
    pixels, depth = project_voxels(volume.spec, volume.rig)
    height, width = feature_size(volume.rig.images)
    grid = 2 * (pixels / torch.tensor([width - 1, height - 1]) - 0.5)
    assert_equal_each(grid, golden["out_pix_coords"])
    assert_equal(depth, golden["out_local_z"])
    assert_masks_equal(volume.views.seen, golden["out_valid"])
    assert_equal(volume.views.seen.sum(dim=1), golden["out_count"], 0)
    features = golden.tensor("in_feats")
    warped = []
    for image, pixels, seen in zip(
        features.flatten(0, 1), *(part.flatten(0, 1) for part in volume.views[::2]), strict=True
    ):
        warped.append(interpolated(pixels, (width, height)).sum_of(image.flatten(1).mT).mT * seen)
    of_depth = volume.views.seen * volume.views.depth / volume.spec.depth_unit
    with_depth = torch.cat([torch.stack(warped).view(*features.shape[:3], -1), of_depth[:, :, None]], dim=2)
    assert_equal(with_depth, golden["out_warped"])


def test_a_slots_are_the_published_ones(path):
    published = [0, 1, 1, 0, 0, 1]
    golden = Golden(path)
    slots = ring_of(golden.tensor("in_extrinsics")).slots
    assert slots.tolist() == [published[: slots.shape[1]]] * len(slots)


def test_a_voxels_and_what_rays_read_of_them(path):
    golden = Golden(path)
    volume = filled_volume(golden)
    assert_equal(volume.voxels.mT, golden["out_voxel"])
    count = torch.tensor(golden["out_count"])[:, None]
    assert_equal(volume.voxels.mT * (count == 1), golden["out_voxel_non_overlap"])
    assert_equal(volume.voxels.mT * (count == 2), golden["out_voxel_overlap"])
    assert (count == 3).any() or "3cams" in path.stem
    assert_equal(sampled_rays(volume), golden["out_sampled"])


def test_a_views_of_the_volume_and_gradients(path):
    golden = Golden(path)
    volume = filled_volume(golden)
    size = feature_size(volume.rig.images)
    views = VolumeViews(volume.spec.voxel_channels, volume.spec.steps, golden["w_reduce_dim.3.weight"].shape[0])
    stored(golden, views, {"reduce_dim.0": "reduce.", "reduce_dim.3": "second.conv."})
    rays = ray_geometry(volume.spec, volume.rig.intrinsics, volume.rig.base_T_camera, size)
    maps = views(volume.voxels.flatten(0, 1), rays, size)
    assert_equal(maps, golden["out_proj_feat"])
    (maps * golden.tensor("in_cotangent")).sum().backward()
    assert_equal(volume.features.grad, golden["out_grad_feats"], GRADIENT)
    assert_equal(volume.fusion.alone.weight.grad, golden["out_grad_w_non_overlap"], GRADIENT)
    assert_equal(volume.fusion.overlap.weight.grad, golden["out_grad_w_overlap"], GRADIENT)


def test_x_any_rig_with_its_slots(path):
    golden = Golden(path)
    volume = filled_volume(golden)
    assert_equal(volume.views.seen.sum(dim=1), golden["out_count"], 0)
    assert_equal(volume.voxels.mT, golden["out_voxel"])
    assert_equal(sampled_rays(volume), golden["out_sampled"])
    (volume.voxels.mT * golden.tensor("in_cotangent_voxel")).sum().backward()
    assert_equal(volume.features.grad, golden["out_grad_feats"], GRADIENT)


# --- b, d: pose from a volume


def test_b_the_pose_volume_and_what_is_decoded_from_above(path):
    golden = Golden(path)
    features = golden.tensor("in_feats").requires_grad_()
    volume = volume_of(golden, features.shape[2], 1)
    voxels = mean_voxels(volume, features.flatten(0, 1), rig_of(golden))
    assert_equal(voxels.unflatten(0, (len(features), -1)).mT, golden["out_voxel"])
    above = BirdsEyeView(features.shape[2] + 1, volume.voxels, golden["out_bev"].shape[1])
    stored(golden, above, {f"fusion_net.reduce_dim.{i}": f"reduce.{i // 3}.conv." for i in (0, 3)})
    seen = above(voxels)
    assert_equal(seen, golden["out_bev"])
    decoder = PoseDecoder(seen.shape[1], stride=2)
    decoder.load_state_dict(
        {key: weight(key, like.double(), 0, 2).float() for key, like in decoder.state_dict().items()}
    )
    vector = decoder.double()(seen)
    parts = {"axisangle": vector[:, :3], "translation": vector[:, 3:]}
    assert_equal(parts["axisangle"], golden["out_axisangle"])
    assert_equal(parts["translation"], golden["out_translation_unclamped"])
    sum((part * golden.tensor(f"in_cotangent_{name}")).sum() for name, part in parts.items()).backward()
    assert_equal(features.grad, golden["out_grad_feats"], GRADIENT)


@pytest.mark.parametrize("mode", ["eval", "train"])
def test_d_the_pose_network(path, mode):
    golden = Golden(path)
    network = VolumePoseNet("resnet18", volume_of_network(golden)).double()
    by_rule(network, POSE_NAMES, int(golden["cfg_weight_seed"]))
    network.train(mode == "train")
    target, before, after = (golden.tensor("in_images_u8") / 255).unbind(1)
    rig, above = rig_of(golden), []
    network.birds_eye.register_forward_hook(lambda *call: above.append(call[-1].mean(dim=(-2, -1))))
    motions = []
    with torch.no_grad():
        for context, (earlier, later) in zip(CONTEXTS, ((before, target), (target, after)), strict=True):
            axis_angle, translation = network(rig._replace(images=earlier), later)
            assert_equal(axis_angle, golden[f"out_axisangle_{context}_{mode}"])
            assert_equal(translation, golden[f"out_translation_{context}_{mode}"])
            motions.append(motion_to_context(axis_angle, translation, backward=context == "m1"))
    if mode == "eval":
        for context, mean in zip(CONTEXTS, above, strict=True):
            assert_equal(mean, golden[f"out_bev_mean_{context}"])
        distributed = distribute_anchor_motion(torch.stack(motions, dim=1), rig.base_T_camera, 0)
        assert_equal(distributed, golden["out_cam_T_cam"])


# --- c: the depth network


def depth_network(golden: Golden, dtype: torch.dtype = torch.float64) -> FusedDepthNet:
    network = FusedDepthNet("resnet18", volume_of_network(golden)).to(dtype)
    by_rule(network, DEPTH_NAMES, int(golden["cfg_weight_seed"]))
    return network


@torch.no_grad()
def test_c_the_depth_network(path):
    golden = Golden(path)
    network = depth_network(golden).eval()
    rig = rig_of(golden, golden.tensor("in_images_u8") / 255)
    found: dict[str, Tensor] = {}
    for name in ("aggregation", "fusion", "views"):
        network.get_submodule(name).register_forward_hook(lambda *call, name=name: found.update({name: call[-1]}))
    turns = turns_of(NovelViewsConfig(radians=True), golden.tensor("in_aug_rand"))
    novel_rig = novel_poses(rig.base_T_camera, turns)
    assert_equal(novel_rig, golden["out_extrinsics_aug"])
    disparity, novel = network.with_novel_views(rig, novel_rig)
    assert_equal(disparity, golden["out_disp_eval"])
    assert_equal(novel, golden["out_disp_aug_eval"])
    fx, scale = rig.intrinsics[..., 0, 0], float(golden["cfg_focal_length_scale"])
    depth = disparity_to_depth(disparity, fx, *golden["cfg_min_max_depth"].tolist(), scale)
    assert_equal(depth, golden["out_depth_eval"])
    check_inner_maps(golden, found["aggregation"], found["fusion"], found["views"].unflatten(0, (2, -1)))
    assert_equal(network.train()(rig), golden["out_disp_train"])


def check_inner_maps(golden: Golden, features: Tensor, voxels: Tensor, maps: Tensor) -> None:
    over_image = (-2, -1)
    assert_equal(features.mean(over_image), golden["out_feats_agg_mean"])
    assert_equal(voxels.mean(0), golden["out_voxel_mean"])
    assert_equal(voxels.std(0, correction=0), golden["out_voxel_std"])
    own, novel = maps
    assert_equal(own.mean(over_image), golden["out_proj_feat_mean"])
    assert_equal(novel.mean(over_image), golden["out_proj_feat_aug_mean"])
    if "out_feats_agg" in golden:
        assert_equal(features, golden["out_feats_agg"])
        assert_equal(voxels.mT, golden["out_voxel"])
        assert_equal(own[[0, 3]], golden["out_proj_feat_cams_0_3"])


@pytest.mark.parametrize("encoder", ["resnet18", "resnet34"])
@pytest.mark.parametrize("kind", ["depth_net", "pose_net"])
def test_networks_have_the_names_and_shapes_of_the_released_checkpoints(request, kind, encoder):
    listed = golden_directory(request.config) / f"state_dict_{kind}_{encoder}.txt"
    if kind == "pose_net" and encoder == "resnet34":
        assert not listed.exists()  # its program refuses it
        return
    made, names = (FusedDepthNet, DEPTH_NAMES) if kind == "depth_net" else (VolumePoseNet, POSE_NAMES)
    with torch.device("meta"):
        network = made(encoder, VolumeSpec())
    released = renamed(network.state_dict(), {ours: theirs for theirs, ours in names.items()})
    dtypes = {torch.float32: "float32", torch.int64: "int64"}
    ours = [f"{key} {list(value.shape)} {dtypes[value.dtype]}" for key, value in released.items()]
    assert sorted(ours) == sorted(listed.read_text().splitlines())


# --- e: depth synthesis as a loss


def batch_of(
    golden: Golden, frames: Tensor, dtype: torch.dtype = torch.float64, samples: slice = slice(None)
) -> RigBatch:
    return RigBatch(
        frames=frames[samples],
        masks=(golden.tensor("in_mask_u8") / 255).to(dtype)[samples],
        intrinsics=golden.tensor("in_K", dtype)[samples, :, :3, :3],
        base_T_camera=golden.tensor("in_extrinsics", dtype)[samples],
        targets=PAIRS[:, 0],
        sources=PAIRS[:, 1],
        camera_names=CAMERAS,
    )


def per_camera(pairs: Tensor) -> Tensor:
    """[B, P, ...] of pairs with a neighbour, then with itself: [B, N, 3, ...]."""
    neighbours, own = pairs[:, : len(PAIRS)], pairs[:, len(PAIRS) :]
    return torch.cat([neighbours.unflatten(1, (-1, 2)), own[:, :, None]], dim=2)


def test_e_depth_synthesis(path):
    golden = Golden(path)
    depth, novel_depth, novel_disparity = (
        golden.tensor(f"in_{name}").requires_grad_() for name in ("depth", "depth_aug", "disp_aug")
    )
    batch = batch_of(golden, depth.new_zeros(1, 2, 6, 3, *depth.shape[-2:]))
    degrees = "degrees" in path.stem
    turns = turns_of(NovelViewsConfig(radians=not degrees), golden.tensor("in_aug_rand"))
    assert_equal(
        2 * turns_of(NovelViewsConfig(radians=not degrees), torch.ones(3).double()), golden["cfg_aug_angle_radians"]
    )
    assert_equal(novel_poses(batch.base_T_camera, turns), golden["in_extrinsics_aug"])
    limits = golden["cfg_min_max_depth"].tolist()
    novel = NovelViews(novel_disparity, novel_depth, golden.tensor("in_extrinsics_aug"), tuple(limits), 300.0)
    warp, _ = warped_depth(batch, depth, novel, corrected=False)
    assert_equal(per_camera(warp.images), golden["out_warped_depth"], 1e-6)  # stored as float32
    assert_equal(per_camera(warp.images.sum((-3, -2, -1))), golden["out_warped_depth_sum"])
    different = (per_camera(warp.masks) - golden.tensor("out_warped_mask")).abs() > 1e-6
    assert int(different.sum()) <= 2
    consistency = consistency_of_views(batch, depth, novel, corrected=False)
    assert_equal(consistency, golden["out_consistency_per_camera"])
    smooth = smoothness_of_views(novel_disparity)
    assert_equal(smooth, golden["out_smoothness_per_camera"])
    (consistency.mean() + smooth.mean()).backward()
    assert_equal(depth.grad, golden["out_grad_depth"], GRADIENT)
    assert_equal(novel_depth.grad, golden["out_grad_depth_aug"], GRADIENT)
    assert_equal(novel_disparity.grad, golden["out_grad_disp_aug_smoothness"], GRADIENT)


# --- f, h: complete steps, without and with the techniques of the paper that this project is named after

TERMS = {
    "reproj_loss": "temporal",
    "smooth": "smoothness",
    "spatio_loss": "spatial",
    "spatio_tempo_loss": "spatio_temporal",
    "depth_con_loss": "synthesis_consistency",
    "depth_sm_loss": "synthesis_smoothness",
    "spatial_depth_consistency_loss": "depth_consistency",
    "sp_tp_recon_con_loss": "reconstruction_consistency",
}
"""Our names of the program's columns."""


class Step(NamedTuple):
    batch: RigBatch
    prediction: Prediction
    config: ObjectiveConfig
    noise: Tensor
    leaves: dict[str, Tensor]
    """What gradients are compared of."""


def terms_of(golden: Golden) -> list[str]:
    return [TERMS[column] for column in golden["loss_columns"].tolist()[:-1]]


def objective_of(golden: Golden) -> ObjectiveConfig:
    weights = dict(zip(terms_of(golden), golden["cfg_weights"].tolist(), strict=True))
    assert weights.pop("temporal") == 1
    others = dict.fromkeys(["depth_consistency", "reconstruction_consistency"], 0.0)
    return ObjectiveConfig(**others | weights)


def noise_of(golden: Golden, dtype: torch.dtype = torch.float64) -> Tensor:
    return golden.tensor("in_identity_noise", dtype).permute(1, 2, 0, 3, 4).unsqueeze(3)


def load_step(golden: Golden, noise: Tensor, samples: slice = slice(None)) -> Step:
    batch = batch_of(golden, golden.tensor("in_images_u8") / 255, samples=samples)
    limits = tuple(golden["cfg_min_max_depth"].tolist())

    def depth(disparity: Tensor) -> Tensor:
        return disparity_to_depth(disparity, batch.intrinsics[..., 0, 0], *limits)

    leaves = {
        name: golden.tensor(f"in_{name}")[samples].requires_grad_()
        for name in ("disp", "disp_aug")
        if f"in_{name}" in golden
    }
    novel = None
    if "disp_aug" in leaves:
        novel_rig = golden.tensor("in_extrinsics_aug")[samples]
        novel = NovelViews(leaves["disp_aug"], depth(leaves["disp_aug"]), novel_rig, limits, 300.0)
    motions = golden.tensor("out_cam_T_cam")[samples]
    prediction = Prediction(leaves["disp"], depth(leaves["disp"]), motions, novel=novel)
    return Step(batch, prediction, objective_of(golden), noise[samples], leaves)


def check_step(golden: Golden, step: Step) -> None:
    value = evaluate_objective(step.batch, step.prediction, step.config, step.noise)
    columns = torch.stack([value.terms[name][0] for name in terms_of(golden)], dim=-1)
    assert_equal_each(columns, golden["out_per_camera_losses"][:, :-1])
    assert_equal_each(value.loss, golden["out_total_loss"])
    assert_equal_each(value.loss, golden["out_per_camera_losses"][:, -1].mean())
    value.loss.backward()
    for name, leaf in step.leaves.items():
        assert_equal(leaf.grad, golden[f"out_grad_{name}"], GRADIENT)


def test_fh_losses_and_gradients_of_a_complete_step(path):
    if path.stem == "f_full_step_b2":
        check_two_samples(path)
        return
    golden = Golden(path)
    vectors = golden.tensor("in_axisangle"), golden.tensor("in_translation")
    motions = [motion_to_context(*(part[:, i] for part in vectors), backward=i == 0) for i in (0, 1)]
    distributed = distribute_anchor_motion(torch.stack(motions, dim=1), golden.tensor("in_extrinsics"), 0)
    assert_equal(distributed, golden["out_cam_T_cam"])
    check_step(golden, load_step(golden, noise_of(golden)))


def check_two_samples(path: Path) -> None:
    """The program pools the samples of a batch; ours is the mean of what it gives for each alone."""
    golden, more = Golden(path), Golden(path.with_name("f_full_step_b2_more.npz"))
    both = load_step(golden, noise_of(more))
    value = evaluate_objective(both.batch, both.prediction, both.config, both.noise)
    for sample in (0, 1):
        assert_equal_each(value.per_sample[sample], golden["out_single_total_loss"][sample])
        columns = torch.stack([value.terms[name][sample] for name in terms_of(golden)], dim=-1)
        assert_equal_each(columns, golden["out_single_per_camera_losses"][sample, :, :-1])
    value.per_sample.sum().backward()
    for name, leaf in both.leaves.items():
        assert_equal(leaf.grad, more[f"out_single_grad_{name}"], 1e-6)  # stored as float32
    assert abs(value.loss.item() / float(golden["out_total_loss"]) - 1) > 1e-6
    check_pooled_samples(golden, more)


def check_pooled_samples(golden: Golden, more: Golden) -> None:
    """Samples that are pooled give the program's numbers."""
    step = load_step(golden, noise_of(more))
    pooled = pooled_losses(step)
    columns = torch.stack([pooled[name] for name in terms_of(golden)], dim=-1)
    assert_equal_each(columns, golden["out_per_camera_losses"][:, :-1])
    total = (columns * torch.tensor(golden["cfg_weights"])).sum(dim=-1)
    assert_equal_each(total, golden["out_per_camera_losses"][:, -1])
    assert_equal_each(total.mean(), golden["out_total_loss"])
    total.mean().backward()
    for name, leaf in step.leaves.items():
        assert_equal(leaf.grad, more[f"out_grad_{name}"], 1e-6)  # stored as float32


def pooled_losses(step: Step) -> dict[str, Tensor]:
    """Per camera [N], as the program reduces them."""
    novel = step.prediction.novel
    views = synthesise_views(step.batch, step.prediction, step.config)
    errors = masked_errors(step.batch, step.prediction, views, step.config, step.noise)
    over = (0, -3, -2, -1)
    losses = {name: (error * mask).sum(over) / (mask.sum(over) + 1e-8) for name, (error, mask) in errors.items()}
    losses["smoothness"] = smoothness(step.prediction.disparity, step.batch.images).mean(dim=0)
    losses["synthesis_smoothness"] = smoothness_of_views(novel.disparity).mean(dim=0)
    warp, (targets, _) = warped_depth(step.batch, step.prediction.depth, novel, corrected=False)
    own = novel.depth[:, targets]
    error = ((own - warp.images).abs() / (own + warp.images + 1e-8)).clamp(0, 1)
    sums = torch.stack([error * warp.masks, warp.masks]).sum((1, -3, -2, -1))
    total, count = sums.new_zeros(2, 6).index_add(-1, targets, sums)
    return losses | {"synthesis_consistency": total / (count + 1e-8)}


# --- g: from images to the gradient of every parameter


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_g_end_to_end(path, dtype):
    golden, exact = Golden(path), dtype == torch.float64
    expected = golden if exact else Golden(path.with_name("g_end_to_end_float32.npz"))
    model, prediction, batch = whole_prediction(golden, dtype)
    assert_equal(prediction.motions, expected["out_cam_T_cam"], FLOAT64 if exact else 1e-5)
    apart = (prediction.disparity.detach() - torch.tensor(expected["out_disp"])).abs()
    assert float(apart.max()) < (FLOAT64 if exact else 1e-5)
    value = evaluate_objective(batch, prediction, objective_of(golden), noise_of(golden, dtype))
    tolerance = FLOAT64 if exact else 1e-5
    columns = torch.stack([value.terms[name][0] for name in terms_of(expected if exact else golden)], dim=-1)
    assert_equal(columns, expected["out_per_camera_losses"][:, :-1], tolerance)
    assert_equal(value.loss, expected["out_total_loss"], tolerance)
    assert_equal(value.loss, expected["out_per_camera_losses"][:, -1].mean(), tolerance)
    value.loss.backward()
    check_parameter_gradients(model, expected, GRADIENT if exact else 1e-2)
    if exact:
        assert prediction.novel is not None
        assert_equal(prediction.novel.disparity, golden["out_disp_aug"], 1e-6)  # stored as float32


def whole_prediction(golden: Golden, dtype: torch.dtype) -> tuple[SurroundModel, Prediction, RigBatch]:
    volume = volume_of_network(golden)
    depth_net, pose_net = FusedDepthNet("resnet18", volume), VolumePoseNet("resnet18", volume)
    least, greatest = golden["cfg_min_max_depth"].tolist()
    scale = float(golden["cfg_focal_length_scale"])
    model = SurroundModel(
        depth_net, pose_net, min_depth=least, max_depth=greatest, focal_scale=scale, pose_method="volume"
    ).to(dtype)
    by_rule(depth_net, DEPTH_NAMES, int(golden["cfg_weight_seed"]))
    by_rule(pose_net, POSE_NAMES, int(golden["cfg_weight_seed"]))
    frames, seen = ((golden.tensor(f"in_{name}_u8") / 255).to(dtype) for name in ("images", "jittered"))
    batch, none = batch_of(golden, frames, dtype), torch.zeros(1, dtype=torch.bool)
    turns = turns_of(NovelViewsConfig(), golden.tensor("in_aug_rand")).to(dtype)
    assert_equal(
        novel_poses(batch.base_T_camera, turns),
        golden["in_extrinsics_aug"],
        1e-6 if dtype == torch.float32 else FLOAT64,
    )
    return model, model(batch, seen, none, none, turns), batch


def check_parameter_gradients(model: SurroundModel, expected: Golden, tolerance: float) -> None:
    gradients = {name: parameter.grad for name, parameter in model.named_parameters()}
    theirs = {
        f"{part}.{key}": gradient
        for part, names in (("depth_net", DEPTH_NAMES), ("pose_net", POSE_NAMES))
        for key, gradient in renamed(
            {name.removeprefix(f"{part}."): found for name, found in gradients.items() if name.startswith(part)},
            {ours: released for released, ours in names.items()},
        ).items()
    }
    names = expected["param_names"].tolist()
    assert sorted(names) == sorted(theirs)
    norms = torch.stack([theirs[name].norm() for name in names]).double()
    golden_norms = torch.tensor(expected["out_param_grad_norm"])
    worst = ((norms - golden_norms).abs() / golden_norms.clamp(min=1e-12 * float(golden_norms.max()))).max()
    assert float(worst) < tolerance
    sums = torch.stack([theirs[name].double().sum() for name in names])
    apart = (sums - torch.tensor(expected["out_param_grad_sum"])).abs()
    sizes = torch.tensor([theirs[name].numel() for name in names]).sqrt()
    assert float((apart / (golden_norms * sizes)).max()) < tolerance


def test_z_no_array_was_left_out(request):
    """The last test of the file: between them, the tests above have looked at every output of every file."""
    selected = request.config.getoption("keyword") or any("::" in argument for argument in request.config.args)
    if selected:
        pytest.skip("only meaningful after the whole file")
    files = {path.name for path in golden_directory(request.config).glob("*.npz")}
    assert {name[0] for name in files} == set(FAMILIES)
    assert files == set(Golden.unseen)
    assert {name: left for name, left in Golden.unseen.items() if left} == {}
