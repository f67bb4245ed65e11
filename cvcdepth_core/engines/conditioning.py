# SPDX-License-Identifier: Apache-2.0
"""What a network is told of its rig, made once for each calibration and kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from torch import Tensor

from cvcdepth_core.networks import ConditionedNetwork, RigImages

_KEPT = 32  # cameras; a rig that changes for ever does not fill the memory

Made = tuple[Tensor, ...]
"""[M, ...] each, of M cameras."""


Whole = TypeVar("Whole")


class KeptForWholeRig(Generic[Whole]):
    """What is made of a rig's calibration, masks and absent cameras together, of the one that was asked for last."""

    def __init__(self, make: Callable[[RigImages], Whole]) -> None:
        self._make = make
        self._kept: tuple[RigImages, Whole] | None = None

    @torch.inference_mode()
    def __call__(self, rig: RigImages) -> Whole:
        """Return what is made of the rig."""
        if self._kept is None or not _differ_by_pictures_alone(self._kept[0], rig):
            self._kept = RigImages(rig.images[:, :, :1].clone(), *(part.clone() for part in rig[1:])), self._make(rig)
        return self._kept[1]


def _differ_by_pictures_alone(one: RigImages, other: RigImages) -> bool:
    same_size = one.images.shape[-2:] == other.images.shape[-2:]
    return same_size and all(torch.equal(*parts) for parts in zip(one[1:], other[1:], strict=True))


class KeptForRig:
    """What is made of calibrations, of the cameras that were asked for last; of each on its own, to the last bit."""

    def __init__(self, make: Callable[[RigImages], Made]) -> None:
        self._make = make
        self._kept: dict[bytes, Made] = {}

    @torch.inference_mode()
    def __call__(self, rig: RigImages) -> Made:
        """Return what is made of each of a rig's B * N cameras, joined."""
        samples, cameras = rig.images.shape[:2]
        each = [rig.of_cameras([camera]) for camera in range(cameras)]
        alone = [RigImages(*(part[b : b + 1] for part in one)) for b in range(samples) for one in each]
        return tuple(torch.cat(parts) for parts in zip(*map(self._of_camera, alone), strict=True))

    def _of_camera(self, rig: RigImages) -> Made:
        size = torch.tensor(rig.images.shape[-2:])
        key = b"".join(part.cpu().numpy().tobytes() for part in (size, rig.intrinsics, rig.base_T_camera))
        found = self._kept.pop(key, None) or self._make(rig)
        self._kept[key] = found  # at the end: the first is the one that was not asked for longest
        if len(self._kept) > _KEPT:
            del self._kept[next(iter(self._kept))]
        return found


def conditioning_of(network: ConditionedNetwork) -> Callable[[RigImages], Made]:
    """Return what makes the conditioning [M, C, H, W]."""
    return lambda rig: (network.conditioning(rig).flatten(0, 1),)
