# SPDX-License-Identifier: Apache-2.0
"""The pictures of a whole rig: rectifiers, masks of the vehicle's own body, and the tensor that the network takes."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError, RigError
from cvcdepth_core.images.decoding import Picture, Reduction
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_core.rig.rig import Camera, Rig


class SurroundPreprocessor:
    """The rectifiers of a whole rig.

    `intrinsics` [N, 3, 3] float64 belong to the network's pictures. `valid`, bool [N, H, W], is False outside the raw
    picture and where the vehicle itself is in view.
    """

    def __init__(self, rig: Rig, height: int, width: int, known: "SurroundPreprocessor | None" = None) -> None:
        """Build the maps of every camera; those of `known` are reused for an unchanged calibration and mask."""
        keys = {camera.name: _view_key(camera, height, width) for camera in rig.cameras}
        shared = known._views if known is not None else {}
        self._views: dict[tuple[Any, ...], _View] = {
            keys[camera.name]: shared.get(keys[camera.name]) or _view(camera, height, width) for camera in rig.cameras
        }
        views = {name: self._views[key] for name, key in keys.items()}
        self.rectifiers = {name: view.rectifier for name, view in views.items()}
        """By the cameras' names, in the rig's order."""
        self.intrinsics = np.stack([rectifier.intrinsics for rectifier in self.rectifiers.values()])
        self.valid: NDArray[np.bool_] = np.stack([view.valid for view in views.values()])

    def rectify(self, index: int, picture: Picture, reduced: Reduction = 1) -> Picture:
        """Rectify and resize one camera's picture, by its index in the rig."""
        name = list(self.rectifiers)[index]
        return self.rectifiers[name](picture, name, reduced)


class _View(NamedTuple):
    rectifier: Rectifier
    valid: NDArray[np.bool_]


def _view(camera: Camera, height: int, width: int) -> _View:
    rectifier = Rectifier(camera.calibration, height, width, camera.rectified, camera.aspect)
    return _View(rectifier, rectifier.visible & (self_occlusion_mask(camera, rectifier) > 0.5))


def _view_key(camera: Camera, height: int, width: int) -> tuple[Any, ...]:
    """Return everything that the maps depend on: all of the camera but its pose."""
    return height, width, *(getattr(camera, f.name) for f in fields(camera) if f.name != "base_T_camera")


def self_occlusion_mask(camera: Camera, rectifier: Rectifier) -> NDArray[np.float32]:
    """Return the camera's mask at the network's size, float32 [H, W] in [0, 1], 1 = valid, with soft edges (method, 2).

    Without mask file and polygons everything is valid. RigError names a file that cannot be read or has another size.
    """
    if camera.mask is None and not camera.mask_polygons:
        return np.ones((rectifier.height, rectifier.width), dtype=np.float32)
    try:
        return rectifier(_raw_mask(camera), camera.name).astype(np.float32) / 255.0
    except ImageError as error:
        raise RigError(f"mask {camera.mask}: {error}") from error


def _raw_mask(camera: Camera) -> NDArray[np.uint8]:
    """Return the mask file's content with the polygons drawn in, 0 on the vehicle and 255 elsewhere."""
    width, height = camera.calibration.image_size
    mask = np.full((height, width), 255, np.uint8) if camera.mask is None else _read_mask(camera.mask, camera.name)
    for polygon in camera.mask_polygons:
        cv2.fillPoly(mask, [np.round(polygon).astype(np.int32)], 0)
    return mask


def _read_mask(path: Path, camera: str) -> NDArray[np.uint8]:
    try:
        mask = cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error) as error:
        raise RigError(f"camera {camera}: mask {path} cannot be read: {error}") from error
    if mask is None:
        raise RigError(f"camera {camera}: mask {path} is not an image")
    found: NDArray[np.uint8] = mask
    return found


def to_tensor(pictures: Sequence[Picture], device: torch.device | str = "cpu") -> torch.Tensor:
    """Stack RGB pictures [H, W, 3] into the network's input: float32 [N, 3, H, W] in [0, 1]."""
    stacked = torch.from_numpy(np.stack(pictures)).to(device)
    return stacked.permute(0, 3, 1, 2).to(torch.float32).contiguous() / 255.0
