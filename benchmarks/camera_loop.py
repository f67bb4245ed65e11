# SPDX-License-Identifier: Apache-2.0
"""The training step as one writes it at first: samples, cameras, frames and neighbours one after the other.

The baseline of training_step.py. Networks, terms and their weights are the trainer's; what differs is that every view
is computed on its own. Without batch statistics the loss is that of `evaluate_objective`; the term of the pose
consistency, a few numbers a camera, is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from cvcdepth_core.networks import disparity_to_depth
from cvcdepth_core.rendering.photometric import masked_mean, photometric_error
from cvcdepth_core.rendering.projection import back_project, rigid_inverse, transform
from cvcdepth_core.rendering.view_synthesis import align_intensity, sample, warp_views
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.losses import auto_mask, smoothness
from cvcdepth_core.training.model import SurroundModel, rig_images
from cvcdepth_core.training.objective import ObjectiveConfig, Prediction


def predict_one_by_one(model: SurroundModel, batch: RigBatch) -> Prediction:
    """Return what the model says when it sees one camera at a time."""
    rig = rig_images(batch, batch.images)
    one_by_one = [model.depth_net(rig.of_cameras([camera])) for camera in range(batch.cameras)]
    disparity = torch.cat(one_by_one, dim=1).to(batch.frames.dtype)
    focal_lengths = batch.intrinsics[..., 0, 0]
    depth = disparity_to_depth(disparity, focal_lengths, model.min_depth, model.max_depth, model.focal_scale)
    no_flip = torch.zeros(len(batch.frames), dtype=torch.bool, device=batch.frames.device)
    vectors = model._motion_vectors(batch, batch.frames, no_flip)
    return Prediction(disparity, depth, model._motions(batch, vectors, no_flip))


def loss_one_by_one(batch: RigBatch, prediction: Prediction, config: ObjectiveConfig, noise: Tensor) -> Tensor:
    """Return the published objective's loss; `noise` [B, F, N, 1, H, W] as for `evaluate_objective`."""
    samples, cameras = batch.frames.shape[0], batch.cameras
    views = [_CameraView(batch, prediction, sample, camera) for sample in range(samples) for camera in range(cameras)]
    return torch.stack([view.loss(config, noise[view.sample, :, view.camera]) for view in views]).mean()


@dataclass(frozen=True)
class _CameraView:
    """One camera of one sample; its tensors have a leading dimension of 1."""

    batch: RigBatch
    prediction: Prediction
    sample: int
    camera: int

    def loss(self, config: ObjectiveConfig, noise: Tensor) -> Tensor:
        """Return the weighted terms of this camera."""
        target, mask, contexts = self._image(0), self._mask(self.camera), range(1, self.batch.frames.shape[1])
        own = [self._rendered(self.camera, frame)[0] for frame in contexts]
        reprojection = _least(photometric_error(image, target) for image in own)
        identity = _least(
            photometric_error(self._image(frame), target) + 1e-5 * noise[None, frame - 1] for frame in contexts
        )
        moved = auto_mask(reprojection, identity.detach()) * mask
        overlaps = [self._overlap(frame) for frame in (0, *contexts)]
        spatial, spatial_mask, depth = overlaps[0][0], overlaps[0][1] * mask, overlaps[0][2]
        masks = [mask * seen * moved for _, seen, _ in overlaps[1:]]
        errors = [photometric_error(image, target) for image, _, _ in overlaps[1:]]
        consistency = [
            masked_mean(photometric_error(image, spatial), seen * spatial_mask)
            for (image, _, _), seen in zip(overlaps[1:], masks, strict=True)
        ]
        depth_error = (depth - self._of_camera(self.prediction.depth, self.camera)).abs()
        terms = (
            masked_mean(reprojection, moved),
            config.spatial * masked_mean(photometric_error(spatial, target), spatial_mask),
            config.spatio_temporal * masked_mean(_least(errors), _greatest(masks)),
            config.depth_consistency * masked_mean(depth_error, mask * spatial_mask * (depth > 0)),
            config.reconstruction_consistency * torch.stack(consistency).mean(dim=0),
            config.smoothness * smoothness(self._of_camera(self.prediction.disparity, self.camera), target),
        )
        return torch.stack(terms).sum()

    def _overlap(self, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return image, mask and depth that the neighbours show of this camera's view."""
        neighbours = self.batch.sources[self.batch.targets == self.camera].tolist()
        images, masks, depths = zip(*(self._rendered(neighbour, frame) for neighbour in neighbours), strict=True)
        return sum(images), sum(masks), sum(depths)  # type: ignore[return-value]

    def _rendered(self, source: int, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return this camera's view as the source shows it at the frame, and the source's depth brought to it."""
        poses, batch = self.batch.base_T_camera[self.sample], self.batch
        source_T_target = (rigid_inverse(poses[source]) @ poses[self.camera])[None]
        motion = torch.eye(4).to(poses) if frame == 0 else self.prediction.motions[self.sample, frame - 1, self.camera]
        warp = warp_views(
            points=self._points(self.camera),
            images=self._image(frame, source),
            masks=self._mask(source),
            source_T_target=source_T_target @ motion,
            intrinsics=self._of_camera(batch.intrinsics, source),
            in_front_only=False,
        )
        aligned = align_intensity(warp.images, warp.masks, self._image(0), self._mask(self.camera), False)
        if frame or source == self.camera:
            return aligned, warp.masks, warp.masks
        z = transform(rigid_inverse(source_T_target), self._points(source))[:, 2:].reshape(warp.masks.shape)
        return aligned, warp.masks, sample(z, warp.grid)

    def _points(self, camera: int) -> Tensor:
        inverse = self._of_camera(self.batch.inverse_intrinsics, camera)
        return back_project(self._of_camera(self.prediction.depth, camera), inverse)

    def _image(self, frame: int, camera: int | None = None) -> Tensor:
        return self.batch.frames[self.sample, frame, self.camera if camera is None else camera, None]

    def _mask(self, camera: int) -> Tensor:
        return self._of_camera(self.batch.masks, camera)

    def _of_camera(self, values: Tensor, camera: int) -> Tensor:
        return values[self.sample, camera, None]


def _least(maps: Iterator[Tensor] | list[Tensor]) -> Tensor:
    return torch.stack(list(maps)).amin(dim=0)


def _greatest(maps: list[Tensor]) -> Tensor:
    return torch.stack(maps).amax(dim=0)
