# SPDX-License-Identifier: Apache-2.0
"""The training objective of method sections 5 and 6: the terms over a rig, for any number of samples and cameras.

Every sample and camera is reduced on its own, so the loss of a batch is the mean of its samples' losses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from cvcdepth_core.rendering.photometric import masked_mean, photometric_error
from cvcdepth_core.rendering.projection import back_project, rigid_inverse, transform
from cvcdepth_core.rendering.view_synthesis import Warp, align_intensity, sample, splat_depth, sum_by_target, warp_views
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.losses import auto_mask, pose_consistency, smoothness
from cvcdepth_core.training.motion import motions_seen_from_anchor, relative_poses

_IDENTITY_NOISE = 1e-5


class ObjectiveConfig(BaseModel):
    """Weights and variants of the objective; a weight of 0 leaves the term out."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    smoothness: float = Field(default=0.1, ge=0)
    """Weight of the edge-aware smoothness of the disparity."""
    spatial: float = Field(default=0.03, ge=0)
    """Weight of the photometric error of views rendered from the neighbouring cameras."""
    spatio_temporal: float = Field(default=0.1, ge=0)
    """Weight of the photometric error of views rendered from the neighbouring cameras at the context moments."""
    depth_consistency: float = Field(default=0.001, ge=0)
    """Weight, per metre, of the difference to the neighbours' depth (DDCL or DCL)."""
    reconstruction_consistency: float = Field(default=0.2, ge=0)
    """Weight of the difference between spatial and spatio-temporal reconstructions (MVRCL)."""
    pose_consistency: float = Field(default=0.0, ge=0)
    """Weight of the agreement of the cameras' own motions (FSM baseline: 0.1); only with one pose per camera."""
    depth_warping: Literal["ddcl", "dcl"] = "ddcl"
    """How the neighbour's depth comes to the camera: dense backward warping (DDCL) or sparse splatting (DCL)."""
    corrected: bool = False
    """Depart from the published method: refuse points behind a camera, take the deviation for the intensity alignment
    over the overlap only, average instead of add where two neighbours see the same pixel, binarise masks."""


@dataclass(frozen=True)
class Prediction:
    """Output of the networks for a `RigBatch`, mirrored back if they saw it mirrored."""

    disparity: Tensor
    """[B, N, 1, H, W] in (0, 1)."""
    depth: Tensor
    """[B, N, 1, H, W] metres."""
    motions: Tensor
    """[B, F, N, 4, 4] pose `context_T_target` of each camera for each context frame."""

    def first_sample(self) -> Prediction:
        """Return the output for the first sample, without its gradient."""
        return Prediction(*(part[:1].detach() for part in (self.disparity, self.depth, self.motions)))


@dataclass(frozen=True)
class Overlap:
    """Views of every camera rendered from its neighbours' images."""

    images: Tensor
    """[B, 1 + F, N, 3, H, W], intensity aligned; frame 0 is spatial, the others spatio-temporal."""
    masks: Tensor
    """[B, 1 + F, N, 1, H, W], how much of each pixel a neighbour saw."""
    depth: Tensor | None
    """[B, N, 1, H, W] the neighbours' depth as metres along this camera's axis, 0 where unknown."""


@dataclass(frozen=True)
class Views:
    """All views that are rendered for one step."""

    temporal: Tensor
    """[B, F, N, 3, H, W] each camera rendered from its own context frames, intensity aligned."""
    temporal_masks: Tensor
    """[B, F, N, 1, H, W]."""
    overlap: Overlap


@dataclass(frozen=True)
class ObjectiveValue:
    """The loss and its parts."""

    per_sample: Tensor
    """[B] weighted total of each sample, the mean over its cameras."""
    terms: Mapping[str, Tensor]
    """[B, N] unweighted value of each term, by the names of `ObjectiveConfig`, and `temporal`."""

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
        batch = batch.at_exposures(prediction.motions[:, :, batch.anchor])
        if config.corrected:
            batch = _with_binary_masks(batch)
        views = synthesise_views(batch, prediction, config)
        errors = masked_errors(batch, prediction, views, config, identity_noise)
        terms = {name: masked_mean(error, mask) for name, (error, mask) in errors.items()}
        if "reconstruction_consistency" in terms:
            terms["reconstruction_consistency"] = terms["reconstruction_consistency"].mean(dim=1)
        if config.smoothness > 0:
            terms["smoothness"] = smoothness(prediction.disparity, batch.images)
        if config.pose_consistency > 0:
            seen = motions_seen_from_anchor(prediction.motions, batch.base_T_camera, batch.anchor)
            terms["pose_consistency"] = pose_consistency(seen, batch.anchor)
        return ObjectiveValue(per_sample=_weighted_total(terms, config).mean(dim=1), terms=terms)


def _weighted_total(terms: Mapping[str, Tensor], config: ObjectiveConfig) -> Tensor:
    weights = {"temporal": 1.0, **config.model_dump(include=set(terms))}
    return torch.stack([weights[name] * term for name, term in terms.items()]).sum(dim=0)


def _with_binary_masks(batch: RigBatch) -> RigBatch:
    binary = batch.to()
    binary.masks = (batch.masks >= 0.5).to(batch.masks)
    return binary


def synthesise_views(batch: RigBatch, prediction: Prediction, config: ObjectiveConfig) -> Views:
    """Render every view that the terms of `config` compare: all samples, frames and cameras in two warps."""
    batch = batch.at_exposures(prediction.motions[:, :, batch.anchor])
    points = back_project(prediction.depth, batch.inverse_intrinsics)
    temporal = warp_views(
        points=points[:, None],
        images=batch.contexts,
        masks=batch.masks[:, None].expand_as(batch.contexts[:, :, :, :1]),
        source_T_target=prediction.motions,
        intrinsics=batch.intrinsics[:, None],
        in_front_only=config.corrected,
    )
    return Views(
        temporal=align_intensity(
            temporal.images, temporal.masks, batch.images[:, None], batch.masks[:, None], config.corrected
        ),
        temporal_masks=temporal.masks,
        overlap=_synthesise_overlap(batch, prediction, points, config),
    )


def _synthesise_overlap(batch: RigBatch, prediction: Prediction, points: Tensor, config: ObjectiveConfig) -> Overlap:
    targets, sources = batch.targets, batch.sources
    source_T_target = relative_poses(batch.base_T_camera, targets, sources)
    warp = _warp_neighbours(batch, prediction, points, source_T_target, config)
    target_images, target_masks = batch.images[:, None, targets], batch.masks[:, None, targets]
    aligned = align_intensity(warp.images, warp.masks, target_images, target_masks, config.corrected)
    images = sum_by_target(aligned, targets, batch.cameras)
    masks = sum_by_target(warp.masks, targets, batch.cameras)
    depth = None
    if config.depth_consistency > 0:
        depth = _neighbours_depth(batch, points, source_T_target, warp, config)
    if config.corrected:
        images, masks = images / masks.clamp(min=1), masks.clamp(max=1)
    return Overlap(images, masks, depth)


def _warp_neighbours(
    batch: RigBatch, prediction: Prediction, points: Tensor, source_T_target: Tensor, config: ObjectiveConfig
) -> Warp:
    """Render each pair's target from its source at every frame, [B, 1 + F, P, ...]."""
    standstill = torch.eye(4).to(prediction.motions).expand_as(prediction.motions[:, :1])
    frame_T_target = torch.cat([standstill, prediction.motions], dim=1)[:, :, batch.targets]
    images = batch.frames[:, :, batch.sources]
    return warp_views(
        points=points[:, None, batch.targets],
        images=images,
        masks=batch.masks[:, None, batch.sources].expand_as(images[:, :, :, :1]),
        source_T_target=source_T_target[:, None] @ frame_T_target,
        intrinsics=batch.intrinsics[:, None, batch.sources],
        in_front_only=config.corrected,
    )


def _neighbours_depth(
    batch: RigBatch, points: Tensor, source_T_target: Tensor, warp: Warp, config: ObjectiveConfig
) -> Tensor:
    """Bring the neighbours' depth to each camera [B, N, 1, H, W]: z in this camera's frame, 0 where unknown."""
    targets, sources = batch.targets, batch.sources
    in_target = transform(rigid_inverse(source_T_target), points[:, sources])
    if config.depth_warping == "dcl":
        return splat_depth(in_target, batch.masks[:, sources], batch.intrinsics[:, targets], targets, batch.cameras)
    source_z = in_target[:, :, 2:].reshape(warp.masks[:, 0].shape)
    warped = sample(source_z, warp.grid[:, 0])
    if not config.corrected:
        return sum_by_target(warped, targets, batch.cameras)
    count = sum_by_target(warp.masks[:, 0], targets, batch.cameras)
    return sum_by_target(warped * warp.masks[:, 0], targets, batch.cameras) / count.clamp(min=1)


def masked_errors(
    batch: RigBatch, prediction: Prediction, views: Views, config: ObjectiveConfig, identity_noise: Tensor | None = None
) -> dict[str, tuple[Tensor, Tensor]]:
    """Return the error map and mask of every term that is a masked mean, [B, N, 1, H, W] each.

    Those of `reconstruction_consistency` are [B, F, N, 1, H, W]: the frames are averaged after the masked mean.
    """
    target, overlap = batch.images[:, None], views.overlap
    reprojection = photometric_error(views.temporal, target).amin(dim=1)
    auto_masks = auto_mask(reprojection, _identity_error(batch, identity_noise)) * batch.masks
    spatial_mask = batch.masks * overlap.masks[:, 0]
    st_masks = batch.masks[:, None] * overlap.masks[:, 1:] * auto_masks[:, None]
    spatial, spatio_temporal = overlap.images[:, :1], overlap.images[:, 1:]
    errors = {"temporal": (reprojection, auto_masks)}
    if config.spatial > 0:
        errors["spatial"] = (photometric_error(spatial, target).squeeze(1), spatial_mask)
    if config.spatio_temporal > 0:
        errors["spatio_temporal"] = (photometric_error(spatio_temporal, target).amin(dim=1), st_masks.amax(dim=1))
    if overlap.depth is not None:
        difference = (overlap.depth - prediction.depth).abs()
        errors["depth_consistency"] = (difference, batch.masks * _depth_mask(overlap.depth, spatial_mask, config))
    if config.reconstruction_consistency > 0:
        errors["reconstruction_consistency"] = (
            photometric_error(spatio_temporal, spatial),
            st_masks * spatial_mask[:, None],
        )
    return errors


def _depth_mask(neighbours_depth: Tensor, spatial_mask: Tensor, config: ObjectiveConfig) -> Tensor:
    known = (neighbours_depth > 0).to(spatial_mask)
    return known if config.depth_warping == "dcl" else spatial_mask * known


@torch.no_grad()
def _identity_error(batch: RigBatch, noise: Tensor | None) -> Tensor:
    """Return the least error [B, N, 1, H, W] of taking a context frame for the target as it is."""
    error = photometric_error(batch.contexts, batch.images[:, None])
    noise = torch.randn_like(error) if noise is None else noise
    return (error + _IDENTITY_NOISE * noise).amin(dim=1)
