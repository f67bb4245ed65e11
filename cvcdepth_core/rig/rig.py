# SPDX-License-Identifier: Apache-2.0
"""The rig: which cameras there are, how they are calibrated, and which of them see the same space.

A `RigLayout` is what a YAML file holds. It may leave calibrations and transforms to the recording or to live topics;
`RigLayout.complete` joins the parts to a `Rig`, in which nothing is missing.
"""

import math
import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cvcdepth_core.errors import RigError, TransformError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.rig.calibration import Calibration, first_validation_message
from cvcdepth_core.rig.poses import Pose, check_rigid, pose_from_quaternion, quaternion_from_rotation
from cvcdepth_core.yaml_text import load_yaml

MIN_NEIGHBOUR_OVERLAP_DEG = 2.0
"""Cameras whose images share a narrower strip than this are no neighbours: its pixels are too few to learn from."""

# What a ROS topic takes between two slashes, since output topics carry the camera's name.
_TOPIC_PART = r"^[A-Za-z][A-Za-z0-9_]*$"


class PoseEntry(BaseModel):
    """A rigid pose as ROS writes it."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    translation: tuple[float, float, float]
    """x, y, z in metres."""
    rotation: tuple[float, float, float, float]
    """Unit quaternion x, y, z, w."""

    @model_validator(mode="after")
    def _check(self) -> "PoseEntry":
        try:
            self.matrix("pose")
        except TransformError as error:
            raise ValueError(error) from error
        return self

    def matrix(self, name: str) -> Pose:
        """Return it as a 4x4 matrix; `name` is what errors call it."""
        return pose_from_quaternion(self.translation, self.rotation, name)

    @classmethod
    def from_matrix(cls, pose: Pose) -> "PoseEntry":
        """Take over a 4x4 matrix."""
        x, y, z = pose[:3, 3].tolist()
        qx, qy, qz, qw = quaternion_from_rotation(pose[:3, :3]).tolist()
        return cls(translation=(x, y, z), rotation=(qx, qy, qz, qw))


class CameraEntry(BaseModel):
    """One camera of a rig file. What is left out comes from the recording or from live topics."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    name: str = Field(pattern=_TOPIC_PART)
    """The camera's name, unique in the rig; output topics carry it, hence letters, digits and underscores only."""
    image_topic: str = Field(min_length=1)
    """Topic of its images (`sensor_msgs/Image` or `CompressedImage`)."""
    camera_info_topic: str = Field(min_length=1)
    """Topic of its `sensor_msgs/CameraInfo`."""
    frame_id: str | None = None
    """Its optical frame (REP 103: z forward, x right, y down); without it, the frame that CameraInfo names."""
    rectified: bool = False
    """Whether the topic carries rectified images (`image_rect`): then P describes them and D is not used."""
    stamp_offset: float = Field(default=0.0, allow_inf_nan=False)
    """Seconds by which its stamps are later than the anchor's for simultaneous exposures."""
    mask: Path | None = None
    """PNG of the image's size, 0 where the vehicle itself is in view, 255 elsewhere; relative to the rig file."""
    mask_polygons: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Outlines of the vehicle itself, each of (x, y) in pixels of the raw image; they add to `mask`."""
    calibration: Calibration | None = None
    """Intrinsics and distortion; without them, those of CameraInfo."""
    base_T_camera: PoseEntry | None = None
    """Pose of the optical frame in the base frame; without it, that of `/tf_static`."""
    neighbours: tuple[str, ...] | None = None
    """Cameras that see some of the same space; without it, computed from the fields of view."""

    @property
    def stamp_offset_ns(self) -> int:
        """`stamp_offset` as stamps are counted: subtracted from one, it gives the time of the exposure."""
        return round(self.stamp_offset * 10**9)


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
        for topic, count in Counter(camera.image_topic for camera in self.cameras).items():
            if count > 1:
                sharing = [camera.name for camera in self.cameras if camera.image_topic == topic]
                raise ValueError(f"image_topic: {topic} is that of {' and '.join(sharing)}")
        if self.anchor is not None and self.anchor not in names:
            raise ValueError(f"anchor: no camera is called {self.anchor}; there are {', '.join(names)}")
        for camera in self.cameras:
            others = set(names) - {camera.name}
            given = camera.neighbours or ()
            unknown = [neighbour for neighbour in given if neighbour not in others]
            if unknown:
                raise ValueError(f"camera {camera.name}: neighbours: no other camera is called {', '.join(unknown)}")
            if len(set(given)) < len(given):
                raise ValueError(f"camera {camera.name}: neighbours: {', '.join(given)} names one twice")
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
            cameras=tuple(
                Camera(
                    entry.name,
                    _calibration_of(entry, calibrations or {}),
                    _pose_of(entry, base_T_cameras or {}, self.base_frame),
                    entry.rectified,
                    entry.mask,
                    entry.mask_polygons,
                )
                for entry in self.cameras
            ),
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
    mask_polygons: tuple[tuple[tuple[float, float], ...], ...] = ()

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

    def only(self, names: Collection[str]) -> "Rig":
        """Return the rig of these of its cameras; the first of them stands in for an anchor that is left out."""
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
        """For each camera the others here that share its view: as the rig file says, else those that overlap enough.

        Computed neighbours are mutual: a strip that is wide enough in one of two cameras makes both neighbours.
        """
        wide = {frozenset((o.camera, o.neighbour)) for o in self.overlaps if o.angle >= MIN_NEIGHBOUR_OVERLAP_DEG}
        computed = {name: [other for other in self.names if frozenset((name, other)) in wide] for name in self.names}
        chosen = {name: self.given_neighbours.get(name, computed[name]) for name in self.names}
        return {name: [other for other in others if other in chosen] for name, others in chosen.items()}

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
    """Rays [4, 3] (z = 1) through the rectified image's outer corners, in order around it."""
    width, height = camera.calibration.image_size
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
    corners = np.array([[left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]])
    rays: NDArray[np.float64] = corners @ np.linalg.inv(camera.calibration.rectified_intrinsics).T
    return rays


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


def load_rig_layout(path: Path) -> RigLayout:
    """Read a rig file. RigError names the file, the field and the value that is wrong."""
    try:
        content = load_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise RigError(f"rig file {path}: cannot be read: {reason}") from error
    try:
        layout = RigLayout.model_validate(content)
    except ValidationError as error:
        raise RigError(f"rig file {path}: {first_validation_message(error)}") from error
    return _with_masks(layout, lambda mask: path.parent / mask)


def save_rig_layout(path: Path, layout: RigLayout, comment: str = "") -> None:
    """Write a rig file, `comment` first, masks relative to it; `load_rig_layout` gives the same layout back.

    Raises OutputError, naming the file, where the disk does not take it.
    """
    header = "".join(f"# {line}\n" for line in comment.splitlines())
    relative = _with_masks(layout, lambda mask: Path(os.path.relpath(mask, path.parent)))
    content = relative.model_dump(mode="json", exclude_defaults=True)
    write_atomically(path, (header + yaml.safe_dump(content, sort_keys=False, default_flow_style=None)).encode())


def _calibration_of(entry: CameraEntry, calibrations: Mapping[str, Calibration]) -> Calibration:
    calibration = entry.calibration or calibrations.get(entry.name)
    if calibration is None:
        raise RigError(f"camera {entry.name}: no calibration in the rig file nor on {entry.camera_info_topic}")
    return calibration


def _pose_of(entry: CameraEntry, base_T_cameras: Mapping[str, Pose], base_frame: str) -> Pose:
    if entry.base_T_camera is not None:
        return entry.base_T_camera.matrix(f"camera {entry.name}: base_T_camera")
    if entry.name not in base_T_cameras:
        frame = entry.frame_id or "its optical frame"
        raise TransformError(f"camera {entry.name}: no transform from {frame} to {base_frame}")
    return base_T_cameras[entry.name]


def _with_masks(layout: RigLayout, move: Callable[[Path], Path]) -> RigLayout:
    cameras = tuple(
        camera.model_copy(update={"mask": move(camera.mask)}) if camera.mask else camera for camera in layout.cameras
    )
    return layout.model_copy(update={"cameras": cameras})
