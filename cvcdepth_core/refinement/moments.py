# SPDX-License-Identifier: Apache-2.0
"""A surround set with its depth, and where and when each picture was taken: what refinement works on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.errors import ImageError
from cvcdepth_core.rig.pinhole import scale_intrinsics
from cvcdepth_core.rig.poses import Pose

MIDDLE_GREY = 128.0


@dataclass(frozen=True, eq=False)
class SurroundMoment:
    """One surround set; every array holds the cameras in the rig's order."""

    depth: NDArray[np.float32]
    """[N, H, W] metres along each camera's optical axis, NaN where unknown."""
    pictures: NDArray[np.uint8]
    """[N, H, W, 3] RGB, pixel by pixel what `depth` describes."""
    present: NDArray[np.bool_]
    """[N] which cameras gave a picture."""
    intrinsics: NDArray[np.float64]
    """[N, 3, 3] of the pictures, pixel centres at the integers."""
    valid: NDArray[np.bool_]
    """[N, H, W] False where the vehicle itself is in view, and outside of the lens."""
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4] metres."""
    times_ns: NDArray[np.int64]
    """[N] when each picture was exposed; an absent camera's means nothing."""
    world_T_base: NDArray[np.float64] | None
    """[N, 4, 4] the vehicle's pose at each exposure; None where its motion is not known."""

    def __post_init__(self) -> None:
        cameras, height, width = self.depth.shape
        expected = {
            "pictures": (cameras, height, width, 3),
            "present": (cameras,),
            "intrinsics": (cameras, 3, 3),
            "valid": (cameras, height, width),
            "base_T_camera": (cameras, 4, 4),
            "times_ns": (cameras,),
            "world_T_base": (cameras, 4, 4),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ImageError(
                    f"surround set: {name} is {list(value.shape)}, but depth is {list(self.depth.shape)}: "
                    f"{list(shape)} is expected"
                )

    @property
    def camera_poses(self) -> NDArray[np.float64]:
        """world_T_camera [N, 4, 4] at each exposure; in the base frame where the motion is not known."""
        return self.base_T_camera if self.world_T_base is None else self.world_T_base @ self.base_T_camera

    def with_depth(self, depth: NDArray[np.float32]) -> SurroundMoment:
        """Return the same set with other depth [N, H, W]."""
        return replace(self, depth=depth)

    @property
    def time_ns(self) -> int:
        """When the last of the pictures was exposed; 0 without any."""
        return int(self.times_ns[self.present].max(initial=0))


class View(NamedTuple):
    """One camera's picture and where it was taken."""

    grey: Tensor
    """[h + 2, w + 2] grey levels, NaN where there is no picture and all around the border."""
    intrinsics: NDArray[np.float64]
    """[3, 3] pixels, without the border."""
    world_T_camera: Pose


@dataclass(frozen=True, eq=False)
class GridSet:
    """A surround set reduced to the grid that is matched on."""

    grey: Tensor
    """[N, h + 2, w + 2] grey levels around 0, NaN where there is no picture and all around the border."""
    depth: Tensor
    """[N, h, w] metres, NaN where unknown."""
    intrinsics: NDArray[np.float64]
    """[N, 3, 3] pixels of the grid, without the border."""
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4]."""
    world_T_camera: NDArray[np.float64]
    """[N, 4, 4]; the same as `base_T_camera` where the vehicle's motion is not known."""
    placed: bool
    """Whether the vehicle's motion is known."""
    reduction: int
    """Picture pixels per pixel of the grid, along each axis."""

    @property
    def inner(self) -> Tensor:
        """The grey levels [N, h, w] without the border."""
        return self.grey[:, 1:-1, 1:-1]

    def view(self, camera: int) -> View:
        """Return one camera's picture."""
        return View(self.grey[camera], self.intrinsics[camera], self.world_T_camera[camera])


def reduction_for(width: int, height: int, max_width: int) -> int:
    """Return by which power of two pictures are reduced until they are at most `max_width` wide, if they divide."""
    reduction = 1
    while width // reduction > max_width and width % (2 * reduction) == height % (2 * reduction) == 0:
        reduction *= 2
    return reduction


def to_grid(moment: SurroundMoment, max_width: int, device: torch.device | str = "cpu") -> GridSet:
    """Reduce pictures and depth to a grid of at most `max_width` columns."""
    _, height, width = moment.depth.shape
    reduction = reduction_for(width, height, max_width)
    grey = torch.from_numpy(np.stack([cv2.cvtColor(p, cv2.COLOR_RGB2GRAY) for p in moment.pictures])).to(device)
    shown = torch.from_numpy(moment.valid & moment.present[:, None, None]).to(device)
    levels = torch.where(shown, grey.float() - MIDDLE_GREY, torch.nan)
    scale = (1 / reduction, 1 / reduction)
    return GridSet(
        grey=F.pad(reduced(levels, reduction), (1, 1, 1, 1), value=torch.nan),
        depth=reduced_depth(torch.from_numpy(moment.depth).to(device), reduction),
        intrinsics=np.stack([scale_intrinsics(K, scale) for K in moment.intrinsics]),
        base_T_camera=moment.base_T_camera,
        world_T_camera=moment.camera_poses,
        placed=moment.world_T_base is not None,
        reduction=reduction,
    )


def reduced(images: Tensor, reduction: int) -> Tensor:
    """Average `images` [N, H, W] over squares of `reduction` pixels, a power of two; NaN where any of them is.

    What does not fill a square at the right or lower border is left out.
    """
    while reduction > 1:
        rows = images[:, :-1:2] + images[:, 1::2]
        images = (rows[:, :, :-1:2] + rows[:, :, 1::2]) / 4
        reduction //= 2
    return images


def reduced_depth(depth: Tensor, reduction: int) -> Tensor:
    """Average inverse depth, which is linear on planes, of `depth` [N, H, W] over what is known of each square."""
    if reduction == 1:
        return depth
    known = ~torch.isnan(depth)
    share = reduced(known.float(), reduction)
    nearness = reduced(torch.where(known, depth.reciprocal(), 0.0), reduction)
    return torch.where(share > 0, share / nearness, torch.nan)


def enlarged(images: Tensor, reduction: int) -> Tensor:
    """Interpolate `images` [N, h, w] to `reduction` times as many rows and columns."""
    if reduction == 1:
        return images
    return F.interpolate(images.unsqueeze(1), scale_factor=reduction, mode="bilinear").squeeze(1)
