# SPDX-License-Identifier: Apache-2.0
"""The complete rig: its cameras, their calibrations and poses, and which of them see the same space."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.pinhole import PinholeView, rays_through
from cvcdepth_core.rig.poses import Pose, check_rigid
from cvcdepth_core.rig.view import Aspect, PicturePart, network_part

MIN_NEIGHBOUR_OVERLAP_DEG = 2.0
"""Cameras whose images share a narrower strip than this are no neighbours: its pixels are too few to learn from."""


@dataclass(frozen=True, eq=False)
class Camera:
    """One complete camera; the fields are described in `rig_file.CameraEntry` and `rig_file.RigLayout`.

    A view of a rig file is applied: R and P of the calibration, and the pose, are those of the view.
    """

    name: str
    calibration: Calibration
    base_T_camera: Pose
    rectified: bool = False
    mask: Path | None = None
    mask_polygons: tuple[tuple[tuple[float, float], ...], ...] = ()
    aspect: Aspect = "crop"
    lens: str = ""
    """What those cameras have in common that are views of one lens; empty for a camera with a lens of its own."""

    def __post_init__(self) -> None:
        check_rigid(self.base_T_camera, f"camera {self.name}: base_T_camera")

    @property
    def rectified_view(self) -> PinholeView:
        """The rectified picture at its full size, seen from the camera's place in the base frame."""
        width, height = self.calibration.image_size
        return PinholeView(self.calibration.rectified_intrinsics, self.base_T_camera, height, width)

    def network_part(self, height: int, width: int) -> PicturePart:
        """Return which part of the rectified picture a network's picture of that size shows."""
        return network_part(self.calibration, height, width, self.aspect)


@dataclass(frozen=True)
class Overlap:
    """Two cameras that see some of the same directions; `angle` is the width of that strip in the first, in degrees."""

    camera: str
    neighbour: str
    angle: float


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras around one vehicle, complete: every camera has a calibration and a pose in the base frame."""

    cameras: tuple[Camera, ...]
    base_frame: str
    anchor: str
    given_neighbours: Mapping[str, tuple[str, ...]]
    ground_height: float | None = None
    """Metres of the ground in the base frame: negative where the base frame lies above it; None where nobody says."""

    @property
    def ground_z(self) -> float:
        """`ground_height`; where nobody says it, 0, as for the `base_footprint` of REP 105."""
        return 0.0 if self.ground_height is None else self.ground_height

    @property
    def poses_above_ground(self) -> NDArray[np.float64]:
        """Each camera's pose [N, 4, 4] in the frame below the base frame, turned alike, whose z = 0 is the ground."""
        poses = np.stack([camera.base_T_camera for camera in self.cameras])
        poses[:, 2, 3] -= self.ground_z
        return poses

    @property
    def names(self) -> list[str]:
        """The cameras' names, in order."""
        return [camera.name for camera in self.cameras]

    def only(self, names: Collection[str]) -> "Rig":
        """Return the rig with only these of its cameras; without the anchor, the first of them becomes the anchor."""
        cameras = tuple(camera for camera in self.cameras if camera.name in names)
        anchor = self.anchor if self.anchor in names else cameras[0].name
        return replace(self, cameras=cameras, anchor=anchor)

    @cached_property
    def overlaps(self) -> tuple[Overlap, ...]:
        """Every ordered pair of cameras with any overlap, in the rig's order."""
        pairs = [(a, b) for a in self.cameras for b in self.cameras if a is not b]
        found = (Overlap(a.name, b.name, overlap_angle(a, b)) for a, b in pairs)
        return tuple(overlap for overlap in found if overlap.angle > 0)

    @cached_property
    def neighbours(self) -> dict[str, list[str]]:
        """Names of the cameras that share each camera's view: as the rig file says, else those that overlap enough.

        Computed neighbours are mutual: a strip that is wide enough in one of two cameras makes both neighbours.
        """
        wide = {frozenset((o.camera, o.neighbour)) for o in self.overlaps if o.angle >= MIN_NEIGHBOUR_OVERLAP_DEG}
        computed = {name: [other for other in self.names if frozenset((name, other)) in wide] for name in self.names}
        chosen = {name: self.given_neighbours.get(name, computed[name]) for name in self.names}
        return {name: [other for other in others if other in chosen] for name, others in chosen.items()}

    @property
    def lenses(self) -> list[list[int]]:
        """The indices of the cameras of each lens: one, or those that are views of it."""
        found: dict[str | int, list[int]] = {}
        for index, camera in enumerate(self.cameras):
            found.setdefault(camera.lens or index, []).append(index)
        return list(found.values())

    @property
    def neighbour_indices(self) -> list[tuple[int, int]]:
        """(camera, neighbour) index pairs in the rig's order."""
        index = {name: i for i, name in enumerate(self.names)}
        return [(index[name], index[other]) for name in self.names for other in self.neighbours[name]]


def overlap_angle(camera: Camera, neighbour: Camera) -> float:
    """Return the width, in degrees, of the strip of `camera`'s rectified image whose directions `neighbour` sees too.

    Directions are those of far points: the distance between the cameras is left out. The width is measured along the
    image axis that is nearer to the horizontal, so that a camera mounted on its side counts like any other.
    """
    shared = _image_outline(camera)
    camera_R_neighbour = camera.base_T_camera[:3, :3].T @ neighbour.base_T_camera[:3, :3]
    for inward in (camera_R_neighbour @ _image_sides(neighbour).T).T:
        shared = _clip(shared, inward)
    if not len(shared):
        return 0.0
    up = camera.base_T_camera[2, :3]
    horizontal = 0 if abs(up[1]) >= abs(up[0]) else 1
    return float(np.ptp(np.degrees(np.arctan2(shared[:, horizontal], shared[:, 2]))))


def _image_outline(camera: Camera) -> NDArray[np.float64]:
    """Return the rays [4, 3] (z = 1) through the rectified image's outer corners, in order around it."""
    width, height = camera.calibration.image_size
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    return rays_through(corners, camera.calibration.rectified_intrinsics)


def _image_sides(camera: Camera) -> NDArray[np.float64]:
    """Return the inward normals [4, 3] of the planes through the optical centre and the image's sides."""
    corners = _image_outline(camera)
    return np.cross(corners, np.roll(corners, -1, axis=0))


def _clip(outline: NDArray[np.float64], inward: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cut a convex outline of rays [n, 3] (z = 1) at the plane with the normal `inward` (Sutherland-Hodgman 1974)."""
    heights = outline @ inward
    kept: list[NDArray[np.float64]] = []
    for i in range(len(outline)):
        j = (i + 1) % len(outline)
        if heights[i] >= 0:
            kept.append(outline[i])
        if heights[i] * heights[j] < 0:
            kept.append(outline[i] + (outline[j] - outline[i]) * heights[i] / (heights[i] - heights[j]))
    return np.array(kept).reshape(-1, 3)


def order_around_vehicle(base_T_cameras: Mapping[str, Pose]) -> list[str]:
    """Return the cameras' names counter-clockwise seen from above, beginning with the one that looks most forward."""
    axes = {name: pose[:2, 2] for name, pose in base_T_cameras.items()}
    yaw = {name: math.atan2(axis[1], axis[0]) for name, axis in axes.items()}
    front = min(yaw, key=lambda name: abs(yaw[name]))
    return sorted(yaw, key=lambda name: (yaw[name] - yaw[front]) % (2 * math.pi))
