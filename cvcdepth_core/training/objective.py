# SPDX-License-Identifier: Apache-2.0
"""The training objective of method sections 5 and 6: the terms over a rig, for any number of samples and cameras.

Every sample and camera is reduced on its own, so the loss of a batch is the mean of its samples' losses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from cvcdepth_core.rendering.photometric import TargetStatistics, photometric_error, weighted_mean
from cvcdepth_core.rendering.projection import Reprojection, back_project, rigid_inverse, transform
from cvcdepth_core.rendering.strips import Strips, divide_into_strips, seen_columns
from cvcdepth_core.rendering.view_synthesis import (
    BlackBeyond,
    KnownView,
    Warp,
    align_intensity,
    sample,
    splat_depth,
    warp_by_depth,
)
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.losses import auto_mask, motion_error, pose_consistency, smoothness
from cvcdepth_core.training.motion import motions_seen_from_anchor, relative_poses
from cvcdepth_core.training.novel_views import NovelViews, consistency_of_views, smoothness_of_views
from cvcdepth_core.training.truth_losses import LogErrors, sky_error

_IDENTITY_NOISE = 1e-5
_OVER_VIEW = (-3, -2, -1)


class ObjectiveConfig(BaseModel):
    """Weights and variants of the objective; a weight of 0 leaves the term out."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    temporal: float = Field(default=1.0, ge=0)
    """Weight of the photometric error of views rendered from the camera's own pictures at the context moments."""
    smoothness: float = Field(default=0.1, ge=0)
    """Weight of the edge-aware smoothness of the disparity."""
    spatial: float = Field(default=0.03, ge=0)
    """Weight of the photometric error of views rendered from the neighbouring cameras."""
    spatio_temporal: float = Field(default=0.1, ge=0)
    """Weight of the photometric error of views rendered from the neighbouring cameras at the context moments."""
    depth_consistency: float = Field(default=0.001, ge=0)
    """Weight, per metre, of the difference to the neighbours' depth (DDCL or DCL); see `depth_difference`."""
    reconstruction_consistency: float = Field(default=0.2, ge=0)
    """Weight of the difference between spatial and spatio-temporal reconstructions (MVRCL)."""
    pose_consistency: float = Field(default=0.0, ge=0)
    """Weight of the agreement of the cameras' own motions (FSM baseline: 0.1); only with one pose per camera."""
    synthesis_consistency: float = Field(default=0.0, ge=0)
    """Weight of the difference between depth at turned cameras and the cameras' own; only with `network: vfdepth`."""
    synthesis_smoothness: float = Field(default=0.0, ge=0)
    """Weight of the smoothness of disparity at turned cameras."""
    recorded_motion: float = Field(default=1.0, ge=0)
    """Weight of the pose network's difference to the recorded motion, see `losses.motion_error`; there is no such term
    where none is recorded, or `recordings.motion` does not take it."""
    truth: float = Field(default=1.0, ge=0)
    """Where depth is known (batches with truth): weight of the error of log depth; 0 leaves out all terms of truth."""
    truth_shape: float = Field(default=0.3, ge=0)
    """Weight of the deviation of that error over the picture, which no scale changes."""
    truth_outlines: float = Field(default=0.35, ge=0)
    """Weight of the error of the steps from pixel to pixel, near and far."""
    truth_sky: float = Field(default=0.15, ge=0)
    """Weight of the sky: that depth is far there, and that the network says so if it can."""
    truth_uncertainty: float = Field(default=0.05, ge=0)
    """Weight of how well the network foretells its own error, if it does."""
    leave_out_sky: bool = False
    """Compare no pictures and no depth where the network says that there is the sky, and smooth nothing across its
    outline: without parallax nothing holds it where it is. Of networks that tell the sky; truth has to teach it."""
    depth_warping: Literal["ddcl", "dcl"] = "ddcl"
    """How the neighbour's depth comes to the camera: dense backward warping (DDCL) or sparse splatting (DCL)."""
    depth_difference: Literal["metres", "share"] = "metres"
    """How two depths of the same place are compared: by their difference in metres, as published, which is smaller the
    nearer everything is, or by its share of their sum, |a - b| / (a + b), which no scale makes smaller by itself."""
    corrected: bool = False
    """Depart from the published method: refuse points behind a camera, take the deviation for the intensity alignment
    over the overlap only, average instead of add where two neighbours see the same pixel, binarise masks, and leave
    what they mask out of the smoothness; of novel views, take the range that the lens gives."""

    @property
    def synthesises(self) -> bool:
        """Whether a term needs the views of turned cameras."""
        return max(self.synthesis_consistency, self.synthesis_smoothness) > 0


@dataclass(frozen=True)
class Prediction:
    """Output of the networks for a `RigBatch`, mirrored back if they saw it mirrored."""

    disparity: Tensor
    """[B, N, 1, H, W] in (0, 1)."""
    depth: Tensor
    """[B, N, 1, H, W] metres."""
    motions: Tensor
    """[B, F, N, 4, 4] pose `context_T_target` of each camera for each context frame."""
    sky: Tensor | None = None
    """[B, N, 1, H, W] logit of the sky, of networks that tell it."""
    log_uncertainty: Tensor | None = None
    """[B, N, 1, H, W] logarithm of the expected error of log depth, of networks that tell it."""
    novel: NovelViews | None = None
    """What turned cameras would see, where it was asked for."""

    def first_sample(self) -> Prediction:
        """Return the output for the first sample, without its gradient."""
        disparity, depth, motions = (part[:1].detach() for part in (self.disparity, self.depth, self.motions))
        return Prediction(disparity, depth, motions, None if self.sky is None else self.sky[:1].detach())


@dataclass(frozen=True)
class OverlapPart:
    """Strips of the cameras' views rendered from their neighbours' images: S strips of w columns."""

    strips: Strips
    images: Tensor
    """[B, 1 + F, S, 3, H, w], intensity aligned; frame 0 is spatial, the others spatio-temporal."""
    masks: Tensor
    """[B, 1 + F, S, 1, H, w], how much of each pixel a neighbour saw."""
    depth: Tensor | None
    """[B, S, 1, H, w] the neighbours' depth, of dense warping."""


@dataclass(frozen=True)
class Overlap:
    """Views of every camera rendered from its neighbours' images, in parts: what no neighbour sees is left out."""

    parts: Sequence[OverlapPart]
    splatted: Tensor | None
    """[B, N, 1, H, W] the neighbours' depth, of sparse splatting."""

    @property
    def images(self) -> Tensor:
        """[B, 1 + F, N, 3, H, W] the whole views."""
        return torch.stack([part.strips.paste(part.images) for part in self.parts]).sum(dim=0)

    @property
    def masks(self) -> Tensor:
        """[B, 1 + F, N, 1, H, W] their masks."""
        return torch.stack([part.strips.paste(part.masks) for part in self.parts]).sum(dim=0)

    @property
    def spatial_masks(self) -> Tensor:
        """[B, N, 1, H, W] those of frame 0."""
        return torch.stack([part.strips.paste(part.masks[:, 0]) for part in self.parts]).sum(dim=0)

    @property
    def depth(self) -> Tensor | None:
        """[B, N, 1, H, W] the neighbours' depth as metres along this camera's axis, 0 where unknown."""
        warped = [part.strips.paste(part.depth) for part in self.parts if part.depth is not None]
        return torch.stack(warped).sum(dim=0) if warped else self.splatted


@dataclass(frozen=True)
class Views:
    """All views that are rendered for one step."""

    temporal: Tensor
    """[B, F, N, 3, H, W] each camera rendered from its own context frames, intensity aligned."""
    temporal_masks: Tensor
    """[B, F, N, 1, H, W]."""
    overlap: Overlap


class MaskedError(NamedTuple):
    """A term's error map and mask [..., N, 1, H, W], or the strips [..., S, 1, H, w] of them that are not zero."""

    error: Tensor
    mask: Tensor
    strips: Strips | None = None

    def sums(self) -> Tensor:
        """Return the weighted sum and the sum of weights of each camera, [2, ..., N]."""
        sums = torch.stack([(self.error * self.mask).sum(_OVER_VIEW), self.mask.sum(_OVER_VIEW)])
        return sums if self.strips is None else self.strips.sum_of_cameras(sums)

    def whole(self) -> Tensor:
        """Return error map and mask of whole images, [2, ..., N, 1, H, W]."""
        both = torch.stack([self.error, self.mask])
        return both if self.strips is None else self.strips.paste(both)


@dataclass(frozen=True)
class ObjectiveValue:
    """The loss and its parts."""

    per_sample: Tensor
    """[B] weighted total of each sample, the mean over its cameras."""
    terms: Mapping[str, Tensor]
    """[B, N] unweighted value of each term, by the names of `ObjectiveConfig`."""

    @property
    def loss(self) -> Tensor:
        """The scalar to minimise: the mean over samples."""
        return self.per_sample.mean()


def evaluate_objective(
    batch: RigBatch, prediction: Prediction, config: ObjectiveConfig, identity_noise: Tensor | None = None
) -> ObjectiveValue:
    """Return the training loss of `prediction` for `batch`.

    `identity_noise` [B, F, N, 1, H, W] ~ N(0, 1) breaks ties in the auto-mask; it is drawn when not given. Runs in the
    precision of its inputs, outside autocast: projections need more than half precision.
    """
    with torch.autocast(batch.frames.device.type, enabled=False):
        terms = _self_supervised_terms(batch, prediction, config, identity_noise) if len(batch.contexts[0]) else {}
        if batch.truth is not None and config.truth > 0:
            terms |= _truth_terms(batch.truth, prediction, batch.truth_is_sparse)
        if prediction.novel is not None:
            terms |= _novel_terms(batch, prediction.depth, prediction.novel, config)
        return ObjectiveValue(per_sample=_weighted_total(terms, config).mean(dim=1), terms=terms)


def _self_supervised_terms(
    batch: RigBatch, prediction: Prediction, config: ObjectiveConfig, identity_noise: Tensor | None
) -> dict[str, Tensor]:
    batch = batch.at_exposures(prediction.motions[:, :, batch.anchor])
    if config.corrected:
        batch = _with_binary_masks(batch)
    views = synthesise_views(batch, prediction, config)
    batch = _compared(batch, prediction, config)
    errors = _masked_errors(batch, prediction, views, config, identity_noise)
    terms = {name: weighted_mean(*_added_up(part.sums() for part in parts)) for name, parts in errors.items()}
    if "reconstruction_consistency" in terms:
        terms["reconstruction_consistency"] = terms["reconstruction_consistency"].mean(dim=1)
    if config.smoothness > 0:
        leaves_out_sky = config.leave_out_sky and prediction.sky is not None
        shown = batch.masks if config.corrected or leaves_out_sky else None
        terms["smoothness"] = smoothness(prediction.disparity, batch.images, shown)
    if config.pose_consistency > 0:
        seen = motions_seen_from_anchor(prediction.motions, batch.base_T_camera, batch.anchor)
        terms["pose_consistency"] = pose_consistency(seen, batch.anchor)
    if batch.recorded_motions is not None and config.recorded_motion > 0:
        terms["recorded_motion"] = motion_error(prediction.motions, batch.recorded_motions).mean(dim=1)
    return terms


def _novel_terms(batch: RigBatch, depth: Tensor, novel: NovelViews, config: ObjectiveConfig) -> dict[str, Tensor]:
    terms = {}
    if config.synthesis_consistency > 0:
        terms["synthesis_consistency"] = consistency_of_views(batch, depth, novel, config.corrected)
    if config.synthesis_smoothness > 0:
        terms["synthesis_smoothness"] = smoothness_of_views(novel.disparity)
    return terms


def _truth_terms(truth: Tensor, prediction: Prediction, is_sparse: bool) -> dict[str, Tensor]:
    """Return the terms of truth; sparse truth tells neither outlines nor the sky."""
    errors = LogErrors.of(prediction.depth, truth)
    terms = {"truth": errors.mean(), "truth_shape": errors.deviation()}
    if not is_sparse:
        terms["truth_outlines"] = errors.of_steps()
        terms["truth_sky"] = sky_error(prediction.depth, prediction.sky, truth)
    if prediction.log_uncertainty is not None:
        terms["truth_uncertainty"] = errors.surprise(prediction.log_uncertainty)
    return terms


def _weighted_total(terms: Mapping[str, Tensor], config: ObjectiveConfig) -> Tensor:
    weights = config.model_dump(include=set(terms))
    return torch.stack([weights[name] * term for name, term in terms.items()]).sum(dim=0)


def _with_binary_masks(batch: RigBatch) -> RigBatch:
    binary = batch.to()
    binary.masks = (batch.masks >= 0.5).to(batch.masks)
    return binary


def _compared(batch: RigBatch, prediction: Prediction, config: ObjectiveConfig) -> RigBatch:
    """Return the batch with masks of the target's pixels that are compared.

    Views are rendered before: what depth projects into the neighbour's sky is wrong, and has to be seen.
    """
    if not config.leave_out_sky or prediction.sky is None:
        return batch
    compared = batch.to()
    compared.masks = batch.masks * (prediction.sky.detach() < 0).to(batch.masks)
    return compared


def synthesise_views(batch: RigBatch, prediction: Prediction, config: ObjectiveConfig) -> Views:
    """Render every view that the terms of `config` compare: all samples, frames and cameras in two warps."""
    batch = batch.at_exposures(prediction.motions[:, :, batch.anchor])
    prediction = _with_recorded_motions(batch, prediction)
    intrinsics, inverse = batch.intrinsics, batch.inverse_intrinsics
    targets = KnownView.from_images(batch.images)
    temporal = warp_by_depth(
        depth=prediction.depth[:, None],
        images=batch.contexts,
        masks=batch.masks[:, None].expand_as(batch.contexts[:, :, :, :1]),
        source_of_target=Reprojection.from_cameras(inverse[:, None], prediction.motions, intrinsics[:, None]),
        in_front_only=config.corrected,
    )
    return Views(
        temporal=align_intensity(
            temporal.images,
            temporal.masks,
            batch.images[:, None],
            batch.masks[:, None],
            config.corrected,
            whole_target=targets.at((slice(None), None)),
        ),
        temporal_masks=temporal.masks,
        overlap=_synthesise_overlap(batch, prediction, targets, config),
    )


def _with_recorded_motions(batch: RigBatch, prediction: Prediction) -> Prediction:
    return prediction if batch.recorded_motions is None else replace(prediction, motions=batch.recorded_motions)


def _source_T_target(batch: RigBatch, prediction: Prediction) -> Tensor:  # noqa: N802
    """Return where each pair's target is seen from its neighbour at all moments, [B, 1 + F, P, 4, 4].

    By predicted motion, neighbours lie to each other at a context moment as at the target's: velocity is constant.
    """
    if batch.recorded_poses is not None:
        at_target = batch.recorded_poses[:, :1, batch.targets]
        return rigid_inverse(batch.recorded_poses[:, :, batch.sources]) @ at_target
    source_T_target = relative_poses(batch.base_T_camera, batch.targets, batch.sources)
    standstill = torch.eye(4).to(prediction.motions).expand_as(prediction.motions[:, :1])
    frame_T_target = torch.cat([standstill, prediction.motions], dim=1)[:, :, batch.targets]
    return source_T_target[:, None] @ frame_T_target


def _synthesise_overlap(
    batch: RigBatch, prediction: Prediction, whole_targets: KnownView, config: ObjectiveConfig
) -> Overlap:
    if not len(batch.targets):
        return Overlap([], None)
    source_T_target = _source_T_target(batch, prediction)
    source_of_target = Reprojection.from_cameras(
        batch.inverse_intrinsics[:, None, batch.targets],
        source_T_target,
        batch.intrinsics[:, None, batch.sources],
    )
    seen = seen_columns(prediction.depth, batch.targets, source_of_target)
    groups = divide_into_strips(seen, batch.targets.tolist(), batch.cameras, prediction.depth.shape[-1])
    target_T_source = rigid_inverse(source_T_target[:, 0]) if config.depth_consistency > 0 else None
    parts = []
    for strips in groups:
        pairs = list(strips.pairs)
        warp = _warp_neighbours(
            batch, prediction, source_of_target.at((slice(None), slice(None), pairs)), strips, config
        )
        views = _aligned(batch, whole_targets, strips, warp, config)
        depth = None
        if target_T_source is not None and config.depth_warping == "ddcl":
            depth = _warped_depth(batch, prediction, target_T_source[:, pairs], strips, warp, config)
        parts.append(OverlapPart(strips, *views, depth))
    splatted = None
    if target_T_source is not None and config.depth_warping == "dcl":
        splatted = _splatted_depth(batch, prediction, target_T_source)
    return Overlap(parts, splatted)


def _warp_neighbours(
    batch: RigBatch, prediction: Prediction, source_of_target: Reprojection, strips: Strips, config: ObjectiveConfig
) -> Warp:
    """Render each pair of the strips from its source at every frame, [B, 1 + F, P, ...]."""
    sources = batch.sources[list(strips.pairs)]
    images = batch.frames[:, :, sources]
    return warp_by_depth(
        depth=strips.of_pairs(strips.cut(prediction.depth))[:, None],
        images=images,
        masks=batch.masks[:, None, sources].expand_as(images[:, :, :, :1]),
        source_of_target=source_of_target.from_column(strips.first_of_pairs(images)),
        in_front_only=config.corrected,
    )


def _aligned(
    batch: RigBatch, whole_targets: KnownView, strips: Strips, warp: Warp, config: ObjectiveConfig
) -> tuple[Tensor, Tensor]:
    """Return what the neighbours show in the strips, with the brightness of the target, and how much of each pixel."""
    targets = batch.targets[list(strips.pairs)]
    aligned = align_intensity(
        warp.images,
        warp.masks,
        strips.of_pairs(strips.cut(batch.images))[:, None],
        strips.of_pairs(strips.cut(batch.masks))[:, None],
        config.corrected,
        whole_warped=BlackBeyond(strips.share),
        whole_target=whole_targets.at((slice(None), None, targets)),
    )
    images, masks = strips.sum_of_pairs(aligned), strips.sum_of_pairs(warp.masks)
    return (images / masks.clamp(min=1), masks.clamp(max=1)) if config.corrected else (images, masks)


def _warped_depth(
    batch: RigBatch,
    prediction: Prediction,
    target_T_source: Tensor,
    strips: Strips,
    warp: Warp,
    config: ObjectiveConfig,
) -> Tensor:
    """Bring the neighbours' depth to the strips [B, S, 1, H, w]: z in this camera's frame, 0 where unknown."""
    pairs = list(strips.pairs)
    targets, sources = batch.targets[pairs], batch.sources[pairs]
    target_of_source = Reprojection.from_cameras(
        batch.inverse_intrinsics[:, sources], target_T_source, batch.intrinsics[:, targets]
    )
    warped = sample(target_of_source.z(prediction.depth[:, sources]), warp.grid[:, 0])
    if not config.corrected:
        return strips.sum_of_pairs(warped)
    count = strips.sum_of_pairs(warp.masks[:, 0])
    return strips.sum_of_pairs(warped * warp.masks[:, 0]) / count.clamp(min=1)


def _splatted_depth(batch: RigBatch, prediction: Prediction, target_T_source: Tensor) -> Tensor:
    """Bring the neighbours' points to each camera [B, N, 1, H, W]: z in this camera's frame, 0 in the holes."""
    targets, sources = batch.targets, batch.sources
    in_target = transform(target_T_source, back_project(prediction.depth, batch.inverse_intrinsics)[:, sources])
    return splat_depth(in_target, batch.masks[:, sources], batch.intrinsics[:, targets], targets, batch.cameras)


def masked_errors(
    batch: RigBatch, prediction: Prediction, views: Views, config: ObjectiveConfig, identity_noise: Tensor | None = None
) -> dict[str, tuple[Tensor, Tensor]]:
    """Return the error map and mask of every term that is a masked mean, [B, N, 1, H, W] each.

    Those of `reconstruction_consistency` are [B, F, N, 1, H, W]: the frames are averaged after the masked mean. Where
    no neighbour can be seen, the error of a term of the overlap is zero.
    """
    errors = _masked_errors(_compared(batch, prediction, config), prediction, views, config, identity_noise)
    wholes = {name: _added_up(part.whole() for part in parts) for name, parts in errors.items()}
    return {name: (error, mask) for name, (error, mask) in wholes.items()}


def _added_up(parts: Iterable[Tensor]) -> Tensor:
    return torch.stack(list(parts)).sum(dim=0)


def _masked_errors(
    batch: RigBatch, prediction: Prediction, views: Views, config: ObjectiveConfig, identity_noise: Tensor | None
) -> dict[str, list[MaskedError]]:
    """Return the parts of each term."""
    target, overlap = batch.images[:, None], views.overlap
    statistics = TargetStatistics.from_images(target)
    reprojection = photometric_error(views.temporal, target, statistics).amin(dim=1)
    auto_masks = auto_mask(reprojection, _identity_error(batch, statistics, identity_noise)) * batch.masks
    errors = {"temporal": [MaskedError(reprojection, auto_masks)]}
    for part in overlap.parts:
        for name, error in _overlap_errors(batch, part, auto_masks, statistics, config).items():
            errors.setdefault(name, []).append(error)
    depth = overlap.depth
    if depth is not None:
        mask = batch.masks * _depth_mask(depth, batch.masks * overlap.spatial_masks, config)
        errors["depth_consistency"] = [MaskedError(_depth_difference(depth, prediction.depth, config), mask)]
    return errors


def _overlap_errors(
    batch: RigBatch, part: OverlapPart, auto_masks: Tensor, of_targets: TargetStatistics, config: ObjectiveConfig
) -> dict[str, MaskedError]:
    """Return those of the photometric terms of the overlap.

    `of_targets` are those of the whole images. What they see beyond a strip counts for its outermost columns alone,
    where masks are zero.
    """
    strips = part.strips
    target, own_masks = strips.cut(batch.images)[:, None], strips.cut(batch.masks)
    statistics = TargetStatistics(*(strips.cut(whole) for whole in of_targets))
    frames = [1, part.images.shape[1] - 1]
    spatial, spatio_temporal = part.images.split(frames, dim=1)  # type: ignore[no-untyped-call]
    spatial_mask = own_masks * part.masks[:, 0]
    st_masks = own_masks[:, None] * part.masks[:, 1:] * strips.cut(auto_masks)[:, None]
    errors = {}
    if config.spatial > 0:
        errors["spatial"] = MaskedError(photometric_error(spatial, target, statistics).squeeze(1), spatial_mask, strips)
    if config.spatio_temporal > 0:
        least = photometric_error(spatio_temporal, target, statistics).amin(dim=1)
        errors["spatio_temporal"] = MaskedError(least, st_masks.amax(dim=1), strips)
    if config.reconstruction_consistency > 0:
        difference = photometric_error(spatio_temporal, spatial)
        errors["reconstruction_consistency"] = MaskedError(difference, st_masks * spatial_mask[:, None], strips)
    return errors


def _depth_difference(neighbours_depth: Tensor, depth: Tensor, config: ObjectiveConfig) -> Tensor:
    difference = (neighbours_depth - depth).abs()
    return (
        difference if config.depth_difference == "metres" else difference / (neighbours_depth + depth).clamp(min=1e-3)
    )


def _depth_mask(neighbours_depth: Tensor, spatial_mask: Tensor, config: ObjectiveConfig) -> Tensor:
    known = (neighbours_depth > 0).to(spatial_mask)
    return known if config.depth_warping == "dcl" else spatial_mask * known


@torch.no_grad()
def _identity_error(batch: RigBatch, of_targets: TargetStatistics, noise: Tensor | None) -> Tensor:
    """Return the least error [B, N, 1, H, W] of taking a context frame for the target as it is."""
    error = photometric_error(batch.contexts, batch.images[:, None], of_targets)
    noise = torch.randn_like(error) if noise is None else noise
    return (error + _IDENTITY_NOISE * noise).amin(dim=1)
