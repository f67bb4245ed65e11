# SPDX-License-Identifier: Apache-2.0
"""The seam between a rig and its depth network: what every depth network takes and declares."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from cvcdepth_core.images.surround import to_tensor
from cvcdepth_core.surround_depth import SurroundPictures


class RigImages(NamedTuple):
    """B surround sets of one rig's N cameras as a depth network takes them.

    A camera that is dead is `present = False`, never a missing row: its calibration still says where it looks.
    """

    images: Tensor
    """[B, N, 3, H, W] in [0, 1]; black where the camera is absent."""
    intrinsics: Tensor
    """[B, N, 3, 3] in pixels of H x W, pixel centres at the integers."""
    base_T_camera: Tensor
    """[B, N, 4, 4] camera (optical frame) to vehicle, metres; z = 0 is the ground (`Rig.poses_above_ground`)."""
    present: Tensor
    """[B, N] bool."""
    masks: Tensor
    """[B, N, 1, H, W] in [0, 1], 1 = the picture shows the scene, 0 = the vehicle itself or nothing."""

    @classmethod
    def from_pictures(
        cls, surround: SurroundPictures, cameras: Any = slice(None), device: torch.device | str = "cpu"
    ) -> RigImages:
        """Return the `cameras` (an index into N) of one set, B = 1, float32 on `device`."""
        return cls(
            to_tensor(surround.pictures[cameras], device)[None],
            _float32(surround.intrinsics[cameras], device),
            _float32(surround.base_T_camera[cameras], device),
            torch.from_numpy(surround.present[cameras]).to(device)[None],
            _float32(surround.valid[cameras, None], device),
        )

    def of_cameras(self, cameras: Sequence[int]) -> RigImages:
        """Return these cameras alone, as if there were no others."""
        return RigImages(*(part[:, list(cameras)] for part in self))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> RigImages:
        """Return them on `device`, with floating-point tensors of `dtype`."""
        return RigImages(*(part.to(device, dtype if part.is_floating_point() else None) for part in self))


class DepthOutputs(NamedTuple):
    """All that a network says of each pixel, [B, N, 1, H, W] each; None is what it does not say."""

    disparity: Tensor
    """In (0, 1)."""
    sky: Tensor | None = None
    """Logit of the sky."""
    log_uncertainty: Tensor | None = None
    """Natural logarithm of the error of log depth that is to be expected."""

    def map(self, change: Callable[[Tensor], Tensor]) -> DepthOutputs:
        """Return what `change` makes of each."""
        sky, log_uncertainty = (None if part is None else change(part) for part in self[1:])
        return DepthOutputs(change(self.disparity), sky, log_uncertainty)


class DepthNetwork(nn.Module, ABC):
    """A network that gives depth for all cameras of a rig; a checkpoint's `network` names its class.

    A module, not only something with this `forward`: engines copy it, move it, and change its precision.
    """

    independent: ClassVar[bool]
    """Whether a camera's depth depends on no other camera's image or presence: then cameras may be left out and run in
    chunks, and one that nobody wants need not be computed."""
    engines: ClassVar[tuple[str, ...]]
    """The backends that can run it, the one that `auto` takes first where it is installed at the front."""
    mirror_offset: ClassVar[int] = 0
    """Pixels by which a mirrored picture's principal point has to lie left of the place that mirroring gives it, for
    networks that take a feature's place for that of the first of its pixels: see `mirror_rig`."""

    @abstractmethod
    def forward(self, rig: RigImages) -> Tensor:
        """Return the disparity [B, N, 1, H, W] in (0, 1); that of absent cameras means nothing."""

    def details(self, rig: RigImages) -> DepthOutputs:
        """Return the disparity and what the network says beside it."""
        return DepthOutputs(self(rig))


class ConditionedNetwork(DepthNetwork):
    """A network whose cameras are independent, and which sees of the rig nothing but an image made of its calibration.

    That image is the same for every set, so engines make it once and give it to the network beside the pictures.
    """

    @abstractmethod
    def conditioning(self, rig: RigImages) -> Tensor:
        """Return [B, N, C, H, W], made of `rig`'s calibration and of the size of its images."""

    @abstractmethod
    def outputs(self, images: Tensor, conditioning: Tensor) -> DepthOutputs:
        """Return all outputs [M, 1, H, W] of images [M, 3, H, W] and their conditioning [M, C, H, W]."""


def _float32(array: np.ndarray[Any, Any], device: torch.device | str) -> Tensor:
    return torch.from_numpy(array.astype(np.float32))[None].to(device)
