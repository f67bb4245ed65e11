# SPDX-License-Identifier: Apache-2.0
"""Whether a rig tells where the ground is: what networks need that are told their rig."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.pinhole import rays_through
from cvcdepth_core.rig.rig import Camera, Rig

LEAST_HEIGHT, GREATEST_HEIGHT = 0.2, 6.0
"""Metres of a camera above the ground between which networks are trained, with room on both sides."""


def is_on_ground(base_frame: str) -> bool:
    """Say whether a frame lies on the ground by its name, as REP 105 has it."""
    return base_frame.rpartition("/")[2] == "base_footprint"


def unstated_ground(base_frame: str, why_not_found: str = "") -> str:
    """Return one line that tells that nobody says where the ground is, with the remedy."""
    reason = f" and was not found ({why_not_found})" if why_not_found else ""
    return (
        f"the height of the ground in {base_frame} is not stated{reason}: taken for 0 m, and depth is as wrong as that "
        "is; `cvcdepth rig BAG` looks for it in a recording, or state it in the rig file: ground_height: -0.4"
    )


def refuse_unlikely_ground(rig: Rig) -> None:
    """Raise RigError, with camera, values and remedy, where a rig cannot be right about the ground.

    Cameras in or below it or far above it, upside down, or none of which sees it: depth would have another scale.
    """
    for camera, pose in zip(rig.cameras, rig.poses_above_ground, strict=True):
        height = float(pose[2, 3])
        if not LEAST_HEIGHT <= height <= GREATEST_HEIGHT:
            found = "not stated, so taken for 0" if rig.ground_height is None else f"found {rig.ground_height:g}"
            raise RigError(
                f"camera {camera.name}: {height:.2f} m above the ground, which this network is told, expected "
                f"{LEAST_HEIGHT:g} to {GREATEST_HEIGHT:g}; write into the rig file how high the ground lies in "
                f"{rig.base_frame}, as ground_height: -0.4 ({found})"
            )
        if pose[2, 1] > 0:
            raise RigError(
                f"camera {camera.name}: is mounted upside down by its transform, and this network knows upright "
                "pictures only; correct the transform, or turn the picture and its calibration in the driver"
            )
    if not any(_sees_ground(camera) for camera in rig.cameras):
        names = ", ".join(rig.names)
        raise RigError(f"cameras {names}: none looks below the horizon by its transform, so none sees the ground")


def heights_above_ground(rig: Rig) -> dict[str, float]:
    """Return each camera's height above the ground, metres."""
    return dict(zip(rig.names, rig.poses_above_ground[:, 2, 3].tolist(), strict=True))


def _sees_ground(camera: Camera) -> bool:
    width, height = camera.calibration.image_size
    corners: Sequence[tuple[int, int]] = [(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)]
    rays: NDArray[np.float64] = rays_through(np.array(corners, np.float64), camera.calibration.rectified_intrinsics)
    return bool((rays @ camera.base_T_camera[2, :3] < 0).any())
