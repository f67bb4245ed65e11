# SPDX-License-Identifier: Apache-2.0
"""Depth metrics and the evaluation protocol (method section 9; Eigen et al., 2014)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.errors import ConfigError, ImageError
from cvcdepth_core.geometry import back_project, project, transform
from cvcdepth_core.pose_distribution import relative_poses

METRIC_NAMES = ("abs_rel", "sq_rel", "rmse", "rmse_log", "delta_1", "delta_2", "delta_3")

RELEASED_POOL = 4
"""The released program computes its metrics over the pixels of this many consecutive images."""

_NEAREST_OVERLAP = 1.0


def depth_errors(prediction: Tensor, ground_truth: Tensor) -> Tensor:
    """Return the seven numbers of `METRIC_NAMES` for positive depths [M] in metres; NaN for M = 0."""
    ratio = torch.maximum(prediction / ground_truth, ground_truth / prediction)
    difference = prediction - ground_truth
    return torch.stack(
        [
            (difference.abs() / ground_truth).mean(),
            (difference.square() / ground_truth).mean(),
            difference.square().mean().sqrt(),
            (prediction.log() - ground_truth.log()).square().mean().sqrt(),
            *((ratio < 1.25**power).to(ratio.dtype).mean() for power in (1, 2, 3)),
        ]
    )


@dataclass
class DepthEvaluation:
    """Collects the errors of one rig's images, set by set, camera by camera.

    A camera's errors are the mean over its pools of `pool` consecutive images: 1 is the field's protocol, 4 that of the
    published numbers (an incomplete last pool is left out). Give `scale_by_median` for scale-free numbers.
    """

    max_depth: float
    """Ground truth at or beyond this many metres is left out; predictions are clamped to it."""
    scale_by_median: bool = False
    """Multiply each pool's prediction by the ratio of the medians, ground truth to prediction."""
    pool: int = 1
    """Consecutive images of a camera whose pixels form one measurement."""
    _errors: list[Tensor] = field(default_factory=list, init=False, repr=False)
    _waiting: list[list[tuple[Tensor, Tensor]]] = field(default_factory=list, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.max_depth <= 0 or self.pool < 1:
            raise ConfigError(f"evaluation: max_depth is {self.max_depth} and pool {self.pool}, both must be positive")

    def add(self, prediction: Tensor, ground_truth: Tensor, region: Tensor | None = None) -> None:
        """Take in one set: `prediction` [N, 1, h, w] and `ground_truth` [N, 1, H, W] in metres, 0 where unknown.

        `region` [N, 1, H, W] (bool) restricts the evaluation. Raises ImageError for a prediction that is NaN where the
        ground truth is known, and when the camera counts differ.
        """
        if len(prediction) != len(ground_truth):
            raise ImageError(f"evaluation: {len(prediction)} predicted cameras, ground truth for {len(ground_truth)}")
        resized = F.interpolate(prediction, ground_truth.shape[-2:], mode="bilinear", align_corners=False)
        valid = (ground_truth > 0) & (ground_truth < self.max_depth)
        valid = valid if region is None else valid & region
        if bool(resized[valid].isnan().any()):
            raise ImageError("evaluation: the prediction is NaN where ground truth is known; give a region without it")
        self._waiting.append([(r[v], g[v]) for r, g, v in zip(resized, ground_truth, valid, strict=True)])
        if len(self._waiting) == self.pool:
            self._errors.append(torch.stack([self._measure(images) for images in zip(*self._waiting, strict=True)]))
            self._waiting.clear()

    def per_camera(self) -> Tensor:
        """Return [N, 7], each camera's mean over its pools; NaN for a camera without any ground truth."""
        if not self._errors:
            raise ImageError(f"evaluation: no complete pool of {self.pool} images")
        return torch.stack(self._errors).nanmean(dim=0)

    def mean(self) -> Tensor:
        """Return the seven numbers of `METRIC_NAMES`, the mean over the cameras that have ground truth."""
        return self.per_camera().nanmean(dim=0)

    def _measure(self, images: tuple[tuple[Tensor, Tensor], ...]) -> Tensor:
        prediction = torch.cat([image[0] for image in images]).clamp(0, self.max_depth)
        ground_truth = torch.cat([image[1] for image in images])
        if self.scale_by_median and len(ground_truth):
            scale = ground_truth.median() / prediction.median()
            prediction = (prediction * scale).clamp(0, self.max_depth)
        return depth_errors(prediction, ground_truth)


def overlap_region(
    ground_truth: Tensor, intrinsics: Tensor, base_T_camera: Tensor, targets: Tensor, sources: Tensor
) -> Tensor:
    """Return where `ground_truth` [B, N, 1, H, W] (metres, 0 unknown) is also seen by a neighbour: bool, same shape.

    A point counts when it lies inside the neighbour's image with z > 1 m. `intrinsics` [B, N, 3, 3] are those of H x W,
    `base_T_camera` [B, N, 4, 4] in metres, `targets` and `sources` [P] the index pairs (camera, neighbour).
    """
    height, width = ground_truth.shape[-2:]
    points = back_project(ground_truth, torch.linalg.inv(intrinsics))[:, targets]
    in_source = transform(relative_poses(base_T_camera, targets, sources), points)
    pixels, z = project(in_source, intrinsics[:, sources])
    u, v = pixels.unbind(-2)
    seen = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1) & (z.squeeze(-2) > _NEAREST_OVERLAP)
    count = torch.zeros_like(ground_truth).index_add(1, targets, seen.view(*seen.shape[:2], 1, height, width).to(z))
    return (count > 0) & (ground_truth > 0)


def fuse_flipped(depth: Tensor, depth_of_flipped: Tensor) -> Tensor:
    """Fuse `depth` [..., H, W] with that of the mirrored image, mirrored back ("pp"; Godard et al., 2017).

    Each pass is trusted alone at one border, where it looked past occlusions; between them the mean counts.
    """
    u = torch.linspace(0, 1, depth.shape[-1], dtype=depth.dtype, device=depth.device)
    left = 1 - (20 * (u - 0.05)).clamp(0, 1)
    right = left.flip(-1)
    return right * depth + left * depth_of_flipped + (1 - left - right) * (depth + depth_of_flipped) / 2


def downsample_ground_truth(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Move the points of a sparse depth image [H, W] (metres, 0 unknown) to the pixels of [height, width].

    The published numbers are computed at network resolution: pixel (u, v) goes to (floor(u width / W), floor(v height /
    H)), and of several points the last in reading order stays.
    """
    rows, columns = np.nonzero(depth)
    smaller = np.zeros((height, width), dtype=depth.dtype)
    smaller[rows * height // depth.shape[0], columns * width // depth.shape[1]] = depth[rows, columns]
    return smaller
