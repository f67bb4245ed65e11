# SPDX-License-Identifier: Apache-2.0
"""What the objective works on: B samples of one rig's images and calibration, checked where they enter."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from cvcdepth_core.errors import ImageError, RigError, TransformError
from cvcdepth_core.rendering.projection import rigid_inverse
from cvcdepth_core.rig.poses import check_rigid
from cvcdepth_core.training.motion import poses_at_exposure


@dataclass
class RigBatch:
    """B samples of N cameras at a target moment and at F context moments, at network resolution.

    Raises ImageError or RigError, naming the sample, the camera and the values, when something cannot be right.
    """

    frames: Tensor
    """[B, 1 + F, N, 3, H, W] in [0, 1]: the target frame, then the context frames (-1, +1). Never augmented. Without
    context frames, F = 0, there is truth."""
    masks: Tensor
    """[B, N, 1, H, W] in [0, 1], 1 = not the vehicle itself; may be soft."""
    intrinsics: Tensor
    """[B, N, 3, 3] in pixels of H x W."""
    base_T_camera: Tensor
    """[B, N, 4, 4] camera to vehicle, metres."""
    targets: Tensor
    """[P] camera index of each (camera, neighbour) pair."""
    sources: Tensor
    """[P] neighbour index of each pair."""
    camera_names: Sequence[str]
    """N names, for messages."""
    anchor: int = 0
    """Index of the front camera, whose motion the pose network predicts."""
    exposure_delays: Tensor | None = None
    """[B, N] seconds from the anchor's exposure to each camera's; None where `base_T_camera` is of the exposures."""
    context_times: Tensor | None = None
    """[B, F] seconds from the target to each context frame, negative for one before; needed with `exposure_delays`."""
    recorded_poses: Tensor | None = None
    """[B, 1 + F, N, 4, 4] each camera's recorded pose at each of its exposures, target first, all in one frame, and
    `base_T_camera` that of the target; None where the losses take the pose network's motion."""
    truth: Tensor | None = None
    """[B, N, 1, H, W] metres along the optical axis; inf in the sky, NaN where it is not known."""
    truth_is_sparse: bool = False
    """Whether truth is of single points, as a LiDAR's: then it knows nothing of the sky, and points side by side may be
    of different surfaces where sensor and camera see past different edges."""

    def __post_init__(self) -> None:
        _check_shapes(self)
        _check_images(self)
        _check_calibration(self)
        _check_truth(self)
        _check_neighbours(self)
        _check_exposures(self)
        _check_recorded_poses(self)

    @property
    def images(self) -> Tensor:
        """The target frame [B, N, 3, H, W]."""
        return self.frames[:, 0]

    @property
    def contexts(self) -> Tensor:
        """The context frames [B, F, N, 3, H, W]."""
        return self.frames[:, 1:]

    @property
    def cameras(self) -> int:
        """N."""
        return self.frames.shape[2]

    @property
    def inverse_intrinsics(self) -> Tensor:
        """[B, N, 3, 3]."""
        inverse: Tensor = torch.linalg.inv_ex(self.intrinsics).inverse
        return inverse

    @property
    def recorded_motions(self) -> Tensor | None:
        """[B, F, N, 4, 4] the recorded `context_T_target` of each camera; None where `recorded_poses` is."""
        if self.recorded_poses is None:
            return None
        return rigid_inverse(self.recorded_poses[:, 1:]) @ self.recorded_poses[:, :1]

    def at_exposures(self, anchor_motion: Tensor) -> RigBatch:
        """Return the batch with every camera where it was when it fired, by the anchor camera's motion.

        `anchor_motion` [B, F, 4, 4] is `context_T_target`. The poses keep its gradient. Were it stopped, depth would
        follow a baseline of rig and predicted way, and the way's scale follow depth; where the way is opposite to the
        rig's baseline and more than half of it, that chase leads away from the true scale instead of to it.
        """
        if self.exposure_delays is None or self.context_times is None or self.recorded_poses is not None:
            return self
        moved = copy.copy(self)
        moved.base_T_camera = poses_at_exposure(
            self.base_T_camera,
            anchor_motion,
            self.anchor,
            self.exposure_delays,
            self.context_times,
        )
        moved.exposure_delays = None
        return moved

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> RigBatch:
        """Return the batch on `device` and with floating-point tensors of `dtype`, without checking it again."""
        moved = copy.copy(self)
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                setattr(moved, field.name, value.to(device, dtype if value.is_floating_point() else None))
        return moved

    def first_sample(self) -> RigBatch:
        """Return the batch's first sample as a batch of its own, without checking it again."""
        one = copy.copy(self)
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor) and field.name not in ("targets", "sources"):
                setattr(one, field.name, value[:1])
        return one


def _check_shapes(batch: RigBatch) -> None:
    if batch.frames.ndim != 6 or batch.frames.shape[3] != 3:
        raise ImageError(f"images: shape is {list(batch.frames.shape)}, expected [B, 1 + F, N, 3, H, W]")
    samples, _, cameras, _, height, width = batch.frames.shape
    if len(batch.camera_names) != cameras:
        raise RigError(f"images show {cameras} cameras, but there are {len(batch.camera_names)} camera names")
    names = ", ".join(batch.camera_names)
    if batch.masks.shape != (samples, cameras, 1, height, width):
        expected = [samples, cameras, 1, height, width]
        raise ImageError(f"masks of {names}: shape is {list(batch.masks.shape)}, expected {expected}")
    for name, value, size in (("intrinsics", batch.intrinsics, 3), ("base_T_camera", batch.base_T_camera, 4)):
        if value.shape != (samples, cameras, size, size):
            raise RigError(
                f"{name} of {names}: shape is {list(value.shape)}, expected {[samples, cameras, size, size]}"
            )
    if not 0 <= batch.anchor < cameras:
        raise RigError(f"anchor camera is index {batch.anchor}, expected 0 to {cameras - 1} ({names})")


def _check_images(batch: RigBatch) -> None:
    for what, values in (("image", batch.frames.transpose(1, 2)), ("mask", batch.masks)):
        least, greatest = values.aminmax()  # NaN wherever one value is
        if least >= 0 and greatest <= 1:
            continue
        in_range = (values >= 0) & (values <= 1)  # false for NaN
        wrong = ~in_range.flatten(2).all(dim=-1)
        for sample, camera in wrong.nonzero().tolist():
            pixels = values[sample, camera]
            count = int((~in_range[sample, camera]).sum())
            example = float(pixels[~in_range[sample, camera]][0])
            raise ImageError(
                f"sample {sample}, camera {batch.camera_names[camera]}: {what} has {count} values outside [0, 1], "
                f"the first is {example}"
            )


def _check_calibration(batch: RigBatch) -> None:
    for sample, cameras in enumerate(batch.intrinsics.detach().cpu().double()):
        for name, K, pose in zip(batch.camera_names, cameras, batch.base_T_camera[sample], strict=True):
            origin = f"sample {sample}, camera {name}"
            finite = bool(torch.isfinite(K).all())
            if not finite or K[0, 0] <= 0 or K[1, 1] <= 0 or K[2].tolist() != [0.0, 0.0, 1.0]:
                raise RigError(f"{origin}: intrinsics {K.tolist()} cannot be inverted or are no camera matrix")
            try:
                check_rigid(pose.detach().cpu().double().numpy(), origin)
            except TransformError as error:
                raise RigError(f"base_T_camera of {error}") from error


def _check_truth(batch: RigBatch) -> None:
    if batch.truth is None:
        if batch.contexts.shape[1] == 0:
            raise ImageError("a batch without context frames needs truth to learn from, found none")
        return
    if batch.truth.shape != batch.masks.shape:
        raise ImageError(f"truth: shape is {list(batch.truth.shape)}, expected {list(batch.masks.shape)}")
    wrong = (batch.truth <= 0).flatten(2).any(dim=-1)
    for sample, camera in wrong.nonzero().tolist():
        least = float(batch.truth[sample, camera].nan_to_num(nan=1.0).min())
        raise ImageError(f"sample {sample}, camera {batch.camera_names[camera]}: truth of {least} m, expected above 0")


def _check_neighbours(batch: RigBatch) -> None:
    names, cameras = batch.camera_names, batch.cameras
    if batch.targets.shape != batch.sources.shape or batch.targets.ndim != 1:
        shapes = f"{list(batch.targets.shape)} and {list(batch.sources.shape)}"
        raise RigError(f"neighbour pairs: shapes are {shapes}, expected two equal lists of camera indices")
    pairs = list(zip(batch.targets.tolist(), batch.sources.tolist(), strict=True))
    for target, source in pairs:
        if not (0 <= target < cameras and 0 <= source < cameras) or target == source:
            raise RigError(
                f"neighbour pair {(target, source)}: expected two different indices of the {cameras} cameras"
            )
    if len(set(pairs)) != len(pairs):
        raise RigError(f"neighbour pairs {pairs}: a pair occurs twice")
    if batch.contexts.shape[1] == 0:
        return  # learns from truth alone
    lonely = [names[camera] for camera in range(cameras) if camera not in {target for target, _ in pairs}]
    if lonely and batch.recorded_poses is None:
        raise RigError(f"camera {', '.join(lonely)}: no neighbour, so no overlap to learn its scale from")


def _check_exposures(batch: RigBatch) -> None:
    if batch.exposure_delays is None:
        return
    samples, frames, cameras = batch.frames.shape[:3]
    times = torch.zeros(0) if batch.context_times is None else batch.context_times
    for name, value, shape in (
        ("exposure_delays", batch.exposure_delays, [samples, cameras]),
        ("context_times", times, [samples, frames - 1]),
    ):
        if list(value.shape) != shape or not bool(torch.isfinite(value).all()):
            raise RigError(f"{name}: found {list(value.shape)} {value.tolist()}, expected finite seconds {shape}")
    if not bool(times.all()):
        raise RigError(f"context_times {times.tolist()}: a context frame is of the target's moment")


def _check_recorded_poses(batch: RigBatch) -> None:
    poses = batch.recorded_poses
    expected = [*batch.frames.shape[:3], 4, 4]
    if poses is None or (list(poses.shape) == expected and bool(torch.isfinite(poses).all())):
        return
    raise RigError(f"recorded_poses: shape is {list(poses.shape)}, expected finite poses {expected}")
