# SPDX-License-Identifier: Apache-2.0
"""The rig: which cameras there are, how they are calibrated, and which of them see the same space.

A `RigLayout` is what a YAML file holds. It may leave calibrations and transforms to the recording or to live topics;
`RigLayout.complete` joins the parts to a `Rig`, in which nothing is missing.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cvcdepth_core.calibration import Calibration, first_validation_message
from cvcdepth_core.errors import RigError
from cvcdepth_core.poses import Pose, check_rigid, pose_from_quaternion, quaternion_from_rotation

MIN_NEIGHBOUR_OVERLAP_DEG = 2.0
"""Cameras whose images share a narrower strip than this are no neighbours: its pixels are too few to learn from."""

_OVERLAP_GRID = (72, 128)


class PoseEntry(BaseModel):
    """A rigid pose as ROS writes it."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    translation: tuple[float, float, float]
    """x, y, z in metres."""
    rotation: tuple[float, float, float, float]
    """Unit quaternion x, y, z, w."""

    @classmethod
    def from_matrix(cls, pose: Pose) -> "PoseEntry":
        """Take over a 4x4 matrix."""
        x, y, z = pose[:3, 3].tolist()
        qx, qy, qz, qw = quaternion_from_rotation(pose[:3, :3]).tolist()
        return cls(translation=(x, y, z), rotation=(qx, qy, qz, qw))


class CameraEntry(BaseModel):
    """One camera of a rig file. What is left out comes from the recording or from live topics."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    name: str = Field(min_length=1)
    """The camera's name, unique in the rig; output topics carry it."""
    image_topic: str
    """Topic of its images (`sensor_msgs/Image` or `CompressedImage`)."""
    camera_info_topic: str
    """Topic of its `sensor_msgs/CameraInfo`."""
    frame_id: str | None = None
    """Its optical frame (REP 103: z forward, x right, y down); without it, the frame that CameraInfo names."""
    rectified: bool = False
    """Whether the topic carries rectified images (`image_rect`): then P describes them and D is not used."""
    stamp_offset: float = 0.0
    """Seconds by which its stamps are later than the anchor's for simultaneous exposures."""
    mask: Path | None = None
    """PNG of the image's size, 0 where the vehicle itself is in view, 255 elsewhere; relative to the rig file."""
    calibration: Calibration | None = None
    """Intrinsics and distortion; without them, those of CameraInfo."""
    base_T_camera: PoseEntry | None = None
    """Pose of the optical frame in the base frame; without it, that of `/tf_static`."""
    neighbours: tuple[str, ...] | None = None
    """Cameras that see some of the same space; without it, computed from the fields of view."""


class RigLayout(BaseModel):
    """The content of a rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    base_frame: str = "base_link"
    """The vehicle's frame (REP 105): x forward, y left, z up."""
    anchor: str | None = None
    """The camera whose stamp a set carries and whose motion the pose network estimates; without it, the first."""
    cameras: tuple[CameraEntry, ...]
    """The cameras, in the order in which every array of a set holds them."""

    @model_validator(mode="after")
    def _check(self) -> "RigLayout":
        names = self.names
        if len(names) < 2:
            raise ValueError(f"a surround rig needs at least two cameras, found {len(names)}: {', '.join(names)}")
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"two cameras are called {', '.join(repeated)}")
        if self.anchor is not None and self.anchor not in names:
            raise ValueError(f"anchor: no camera is called {self.anchor}; there are {', '.join(names)}")
        for camera in self.cameras:
            unknown = set(camera.neighbours or ()) - (set(names) - {camera.name})
            if unknown:
                raise ValueError(f"camera {camera.name}: neighbours: no other camera is called {', '.join(unknown)}")
        return self

    @property
    def names(self) -> list[str]:
        """The cameras' names, in order."""
        return [camera.name for camera in self.cameras]

    @property
    def anchor_camera(self) -> str:
        """The anchor's name: the one given, or the first camera's."""
        return self.anchor or self.names[0]

    def complete(
        self, calibrations: Mapping[str, Calibration] | None = None, base_T_cameras: Mapping[str, Pose] | None = None
    ) -> "Rig":
        """Join the file with what the recording or the live topics say; what the file says has precedence.

        Both arguments are keyed by camera name. RigError names the first camera that lacks a calibration or transform.
        """
        return Rig(
            cameras=tuple(_complete_camera(entry, calibrations or {}, base_T_cameras or {}) for entry in self.cameras),
            base_frame=self.base_frame,
            anchor=self.anchor_camera,
            given_neighbours={c.name: c.neighbours for c in self.cameras if c.neighbours is not None},
        )


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera with everything known: see CameraEntry for the fields."""

    name: str
    calibration: Calibration
    base_T_camera: Pose
    rectified: bool = False
    mask: Path | None = None

    def __post_init__(self) -> None:
        check_rigid(self.base_T_camera, f"camera {self.name}: base_T_camera")


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

    @property
    def names(self) -> list[str]:
        """The cameras' names, in order."""
        return [camera.name for camera in self.cameras]

    @cached_property
    def overlaps(self) -> tuple[Overlap, ...]:
        """Every ordered pair of cameras with any overlap, in the rig's order."""
        pairs = [(a, b) for a in self.cameras for b in self.cameras if a is not b]
        found = (Overlap(a.name, b.name, overlap_angle(a, b)) for a, b in pairs)
        return tuple(overlap for overlap in found if overlap.angle > 0)

    @cached_property
    def neighbours(self) -> dict[str, list[str]]:
        """For each camera the cameras that share its view: those the rig file gives, else those that overlap enough."""
        wide = [o for o in self.overlaps if o.angle >= MIN_NEIGHBOUR_OVERLAP_DEG]
        computed = {name: [o.neighbour for o in wide if o.camera == name] for name in self.names}
        return {name: list(self.given_neighbours.get(name, computed[name])) for name in self.names}

    @property
    def neighbour_indices(self) -> list[tuple[int, int]]:
        """(camera, neighbour) index pairs in the rig's order."""
        index = {name: i for i, name in enumerate(self.names)}
        return [(index[name], index[other]) for name in self.names for other in self.neighbours[name]]


def overlap_angle(camera: Camera, neighbour: Camera) -> float:
    """Return the width, in degrees, of the strip of `camera`'s rectified image whose directions `neighbour` sees too.

    Directions are those of far points: the distance between the cameras is left out.
    """
    rays = _image_rays(camera)
    neighbour_R_camera = neighbour.base_T_camera[:3, :3].T @ camera.base_T_camera[:3, :3]
    x, y, z = neighbour_R_camera @ rays
    width, height = neighbour.calibration.image_size
    K = neighbour.calibration.rectified_intrinsics
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = K[0, 0] * x / z + K[0, 1] * y / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    seen = (z > 0) & (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    if not seen.any():
        return 0.0
    azimuth = np.degrees(np.arctan2(rays[0, seen], rays[2, seen]))
    return float(np.ptp(azimuth))


def _image_rays(camera: Camera) -> NDArray[np.float64]:
    """Rays [3, n] (z = 1) through a coarse grid over the rectified image, its outer edges included."""
    width, height = camera.calibration.image_size
    u, v = np.meshgrid(
        np.linspace(-0.5, width - 0.5, _OVERLAP_GRID[1]), np.linspace(-0.5, height - 0.5, _OVERLAP_GRID[0])
    )
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    rays: NDArray[np.float64] = np.linalg.inv(camera.calibration.rectified_intrinsics) @ pixels
    return rays


def order_around_vehicle(base_T_cameras: Mapping[str, Pose]) -> list[str]:
    """Return the cameras' names counter-clockwise seen from above, beginning with the one that looks most forward."""
    axes = {name: pose[:2, 2] for name, pose in base_T_cameras.items()}
    yaw = {name: math.atan2(axis[1], axis[0]) for name, axis in axes.items()}
    front = min(yaw, key=lambda name: abs(yaw[name]))
    return sorted(yaw, key=lambda name: (yaw[name] - yaw[front]) % (2 * math.pi))


def load_rig_layout(path: Path) -> RigLayout:
    """Read a rig file. RigError names the file, the field and the value that is wrong."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise RigError(f"rig file {path}: cannot be read: {reason}") from error
    try:
        layout = RigLayout.model_validate(content)
    except ValidationError as error:
        raise RigError(f"rig file {path}: {first_validation_message(error)}") from error
    return _with_masks_beside(path, layout)


def save_rig_layout(path: Path, layout: RigLayout, comment: str = "") -> None:
    """Write a rig file, `comment` first; a mask's path is written as it stands."""
    header = "".join(f"# {line}\n" for line in comment.splitlines())
    content = layout.model_dump(mode="json", exclude_defaults=True)
    path.write_text(header + yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding="utf-8")


def _complete_camera(
    entry: CameraEntry, calibrations: Mapping[str, Calibration], base_T_cameras: Mapping[str, Pose]
) -> Camera:
    calibration = entry.calibration or calibrations.get(entry.name)
    if calibration is None:
        raise RigError(f"camera {entry.name}: no calibration in the rig file nor on {entry.camera_info_topic}")
    if entry.base_T_camera is not None:
        pose = entry.base_T_camera
        base_T_camera = pose_from_quaternion(pose.translation, pose.rotation, f"camera {entry.name}: base_T_camera")
    elif entry.name in base_T_cameras:
        base_T_camera = base_T_cameras[entry.name]
    else:
        raise RigError(f"camera {entry.name}: no transform to its frame {entry.frame_id or '(unknown)'}")
    return Camera(entry.name, calibration, base_T_camera, entry.rectified, entry.mask)


def _with_masks_beside(path: Path, layout: RigLayout) -> RigLayout:
    """Resolve mask paths, which a rig file gives relative to itself."""
    cameras = tuple(
        camera.model_copy(update={"mask": path.parent / camera.mask}) if camera.mask else camera
        for camera in layout.cameras
    )
    return layout.model_copy(update={"cameras": cameras})
