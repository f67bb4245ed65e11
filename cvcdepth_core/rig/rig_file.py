# SPDX-License-Identifier: Apache-2.0
"""The rig file: a layout in YAML, which may leave calibrations and transforms to the recording or to live topics.

`RigLayout.complete` joins it with those to a `Rig`, in which nothing is missing.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cvcdepth_core.errors import RigError, TransformError, first_validation_message
from cvcdepth_core.files import load_yaml, write_atomically
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.poses import Pose, pose_from_quaternion, quaternion_from_rotation
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_core.rig.view import Aspect, View

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
        """Return the pose as a 4x4 matrix; errors call it `name`."""
        return pose_from_quaternion(self.translation, self.rotation, name)

    @classmethod
    def from_matrix(cls, pose: Pose) -> "PoseEntry":
        """Return the entry of a 4x4 pose."""
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
    view: View | None = None
    """The pinhole view that is taken from its lens; without it, the one that P says. Of cameras with the same
    `image_topic`, which are views of one lens, each has its own."""

    @property
    def stamp_offset_ns(self) -> int:
        """`stamp_offset` in nanoseconds: a stamp minus this is the time of the exposure."""
        return round(self.stamp_offset * 10**9)

    @property
    def is_turned(self) -> bool:
        """Whether it looks another way than its lens, and hence has a frame of its own."""
        return self.view is not None and self.view.yaw != 0.0


class RigLayout(BaseModel):
    """The content of a rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    base_frame: str = "base_link"
    """The vehicle's frame (REP 105): x forward, y left, z up."""
    anchor: str | None = None
    """The camera whose stamp a set carries and whose motion the pose network estimates; without it, the first."""
    aspect: Aspect = "crop"
    """How pictures come into a network of another shape, by more than 10 %: rows that are too many are cut off (crop),
    borders are left empty (pad), or pixels become wider or narrower than high (stretch)."""
    ground_height: float | None = Field(default=None, ge=-20, le=20, allow_inf_nan=False)
    """Metres of the ground in the base frame, below the vehicle as it stands; 0 where the base frame lies on the ground
    (REP 105's base_footprint), negative where it is higher. Networks that are told their rig need it; where it is not
    stated, it is looked for in recordings, and else taken for 0."""
    cameras: tuple[CameraEntry, ...]
    """The cameras, in the order in which every array of a set holds them."""

    @model_validator(mode="after")
    def _check(self) -> "RigLayout":
        names = self.names
        if not names:
            raise ValueError("cameras: a rig needs at least one camera, found none")
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"two cameras are called {', '.join(repeated)}")
        for topic, sharing in self.views_by_image.items():
            _check_views(topic, [camera for camera in self.cameras if camera.name in sharing])
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
    def ground_z(self) -> float:
        """`ground_height`, 0 where it is not stated."""
        return 0.0 if self.ground_height is None else self.ground_height

    @property
    def anchor_camera(self) -> str:
        """The anchor's name: the one given, or the first camera's."""
        return self.anchor or self.names[0]

    @property
    def views_by_image(self) -> dict[str, list[str]]:
        """The names of the cameras of each image topic: one, or several views of one lens."""
        found: dict[str, list[str]] = {}
        for camera in self.cameras:
            found.setdefault(camera.image_topic, []).append(camera.name)
        return found

    def complete(
        self, calibrations: Mapping[str, Calibration] | None = None, base_T_cameras: Mapping[str, Pose] | None = None
    ) -> "Rig":
        """Join the file with what the recording or the live topics say; what the file says has precedence.

        Both arguments are keyed by camera name. RigError names the first camera that lacks a calibration or transform.
        """
        return Rig(
            cameras=tuple(
                _camera(
                    entry,
                    _calibration_of(entry, calibrations or {}),
                    _pose_of(entry, base_T_cameras or {}, self.base_frame),
                    self.aspect,
                    lens=entry.image_topic if len(self.views_by_image[entry.image_topic]) > 1 else "",
                )
                for entry in self.cameras
            ),
            base_frame=self.base_frame,
            anchor=self.anchor_camera,
            given_neighbours={c.name: c.neighbours for c in self.cameras if c.neighbours is not None},
            ground_height=self.ground_height,
        )


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


def _check_views(topic: str, cameras: Sequence[CameraEntry]) -> None:
    """Raise ValueError where cameras of one image topic are not different views of one lens."""
    names = " and ".join(camera.name for camera in cameras)
    if len(cameras) > 1 and any(camera.view is None for camera in cameras):
        raise ValueError(f"image_topic: {topic} is that of {names}; views of one lens have a view each")
    if len({camera.view for camera in cameras}) < len(cameras):
        raise ValueError(f"view: those of {names}, of one image_topic, are the same")
    for field in ("camera_info_topic", "frame_id", "stamp_offset", "rectified", "calibration", "base_T_camera"):
        if any(getattr(camera, field) != getattr(cameras[0], field) for camera in cameras):
            raise ValueError(f"{field}: differs between {names}, which are views of one lens")


def _camera(entry: CameraEntry, calibration: Calibration, base_T_camera: Pose, aspect: Aspect, lens: str) -> Camera:
    rectified = entry.rectified
    if entry.view is not None:
        calibration, base_T_camera = entry.view.seen_from(calibration, base_T_camera, rectified)
        rectified = False
    return Camera(entry.name, calibration, base_T_camera, rectified, entry.mask, entry.mask_polygons, aspect, lens)


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
