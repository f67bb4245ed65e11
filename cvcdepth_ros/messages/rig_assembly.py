# SPDX-License-Identifier: Apache-2.0
"""Complete a rig file with what a recording or a live system says: CameraInfo and static transforms."""

from collections.abc import Collection
from typing import Any, TypeVar

from cvcdepth_core.errors import RigError, TransformError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.rig.rig import Camera, Rig, order_around_vehicle
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout
from cvcdepth_core.rig.wide_lenses import wide_lenses, with_views
from cvcdepth_ros.messages.calibration_changes import describe_change
from cvcdepth_ros.messages.camera_info import is_uncalibrated, read_camera_info
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.transforms import TransformTree

T = TypeVar("T")

_MOST_CHANGES = 100  # a lens that zooms or focuses changes for ever
_LATE = "the first ones cannot be used (drivers send zeros until they have read their file), the later ones are"


class RigAssembler:
    """Collects calibrations until a layout's cameras are complete."""

    def __init__(self, layout: RigLayout, transforms: TransformTree | None = None) -> None:
        """Use `transforms`, the tree to which whoever receives static transforms adds them."""
        self.layout = layout
        self.transforms = TransformTree() if transforms is None else transforms
        self.frames_on_tf: list[str] = []
        """Sensor frames whose fixed poses a recording told on `/tf`, not `/tf_static`."""
        self.about_transforms = ""
        """On which topics a recording has transforms, where these are not the usual ones."""
        self.changes: list[tuple[int, str]] = []
        """When (stamp, ns) a CameraInfo was not what the camera's former ones were, and what changed. Not all."""
        self._calibrations: dict[str, Calibration] = {}
        self._frame_ids: dict[str, str] = {}
        self._refused: dict[str, str] = {}
        self._stamps: dict[str, int] = {}
        self._notes: dict[str, tuple[str, ...]] = {}
        self._late: set[str] = set()

    @property
    def notes(self) -> list[str]:
        """What is not said as it should be, of CameraInfos and transforms, and how it is understood, a line each."""
        of_cameras = [(camera, note) for camera, notes in self._notes.items() for note in notes]
        told = [f"camera {camera}: camera_info: {note}" for camera, note in of_cameras]
        return [*told, *([self.about_transforms] if self.about_transforms else [])]

    def add_camera_info(self, camera: str, message: Any) -> bool:
        """Take over a camera's CameraInfo; return whether it says anything new that the rig file leaves open.

        An impossible one is not raised but remembered as the camera's problem, and replaces what was known before:
        a camera that calls itself uncalibrated must not be used with yesterday's numbers. But where it was not
        calibrated yet, before what is known, that says nothing: drivers send zeros until they have read their file.
        """
        entry = self._entry(camera)
        if is_uncalibrated(message) and stamp_ns(message) < self._stamps.get(camera, 0):
            return False
        is_renamed = entry.frame_id is None and self._frame_ids.get(camera) != message.header.frame_id
        self._frame_ids[camera] = message.header.frame_id
        is_recalibrated = entry.calibration is None and self._add_calibration(camera, message)
        return is_renamed or is_recalibrated

    def add_camera_info_on(self, topic: str, message: Any) -> bool:
        """Add a CameraInfo to every camera of that topic; return whether it changes anything."""
        cameras = [camera.name for camera in self.layout.cameras if camera.camera_info_topic == topic]
        return True in [self.add_camera_info(camera, message) for camera in cameras]

    def _add_calibration(self, camera: str, message: Any) -> bool:
        try:
            calibration, notes = read_camera_info(message, camera)
        except RigError as error:
            self._calibrations.pop(camera, None)
            self._notes.pop(camera, None)
            is_new = self._refused.get(camera) != str(error)
            self._refused[camera] = str(error)
            return is_new
        refused = self._refused.pop(camera, None)
        if refused and camera not in self._stamps:
            self._late.add(camera)
        self._notes[camera] = (*((_LATE,) if camera in self._late else ()), *notes)
        self._stamps.setdefault(camera, stamp_ns(message))
        known = self._calibrations.get(camera)
        self._calibrations[camera] = calibration
        change = describe_change(known, calibration) if known is not None else None
        if change and len(self.changes) < _MOST_CHANGES:
            self.changes.append((stamp_ns(message), f"camera {camera}: its calibration changes: {change}"))
        return known != calibration

    def frame_id(self, camera: str) -> str | None:
        """Return the camera's optical frame: the rig file's, else CameraInfo's, None while neither is known.

        Of a view that is a lens's, whichever way the view looks.
        """
        return self._entry(camera).frame_id or self._frame_ids.get(camera)

    def view_frame_id(self, camera: str) -> str | None:
        """Return the frame of what is computed for the camera: its own where its view is turned, else `frame_id`."""
        return f"{camera}_optical_frame" if self._entry(camera).is_turned else self.frame_id(camera)

    def view_poses(self) -> dict[str, Pose]:
        """Return the poses of the turned views' frames, as far as they are known: nobody else publishes them."""
        turned = [entry.name for entry in self.layout.cameras if entry.is_turned]
        complete = [name for name in turned if self._problem(name) is None]
        cameras = self.rig(complete).cameras if complete else ()
        return {f"{camera.name}_optical_frame": camera.base_T_camera for camera in cameras}

    def split_wide_lenses(self) -> None:
        """Put two or three views in the place of each camera whose lens one picture cannot show, see `wide_lenses`.

        Those of which a view is chosen already stay as they are, and those without a calibration.
        """
        known = {name: found for name in self.layout.names if (found := self.calibration(name)) is not None}
        wide = wide_lenses(self.layout, known)
        former, self.layout = self.layout, with_views(self.layout, wide)
        views, former_views = self.layout.views_by_image, former.views_by_image
        for topic, (name, *_) in former_views.items():
            if name in wide:
                self._take_over(name, views[topic])

    def problems(self) -> dict[str, str]:
        """Say for each camera that is not complete what it lacks; empty when the rig can be built."""
        found = ((name, self._problem(name)) for name in self.layout.names)
        return {name: problem for name, problem in found if problem is not None}

    def calibration(self, camera: str) -> Calibration | None:
        """Return the camera's calibration: the rig file's, else CameraInfo's, None while neither is known."""
        return self._entry(camera).calibration or self._calibrations.get(camera)

    def calibration_problem(self, camera: str) -> str | None:
        """Say why the camera has no calibration; None when it has one."""
        if self.calibration(camera) is not None:
            return None
        waiting = f"camera {camera}: waiting for camera_info on {self._entry(camera).camera_info_topic}"
        return self._refused.get(camera, waiting)

    def refusal(self, camera: str) -> str | None:
        """Say why the camera's last CameraInfo cannot be used; None when it can, or the rig file's is used."""
        return None if self._entry(camera).calibration else self._refused.get(camera)

    def transform_problem(self, camera: str) -> str | None:
        """Say why the camera's pose in the base frame is not known; None when it is."""
        if self.frame_id(camera) is None:
            topic = self._entry(camera).camera_info_topic
            return f"camera {camera}: no frame_id in the rig file, waiting for {topic}"
        try:
            self.pose(camera)
        except TransformError as error:
            return f"camera {camera}: {error}{self.about_transforms and f'; {self.about_transforms}'}"
        return None

    def pose(self, camera: str) -> Pose:
        """Return the camera's pose in the base frame: the rig file's, else the transforms'; TransformError for none."""
        entry = self._entry(camera)
        if entry.base_T_camera is not None:
            return entry.base_T_camera.matrix(f"camera {camera}: base_T_camera")
        return self.transforms.lookup(self.layout.base_frame, self.frame_id(camera) or "")

    def rig(self, cameras: Collection[str] | None = None) -> Rig:
        """Build the rig, of these cameras only where they are given.

        RigError or TransformError names the first camera that lacks something.
        """
        layout = self.layout if cameras is None else self._layout_of(cameras)
        for name, problem in self.problems().items():
            if name in layout.names:
                raise RigError(problem)
        return layout.complete(self._calibrations, {name: self.pose(name) for name in layout.names})

    def order_around_vehicle(self) -> None:
        """Put the layout's cameras in their order around the vehicle; errors as for `rig`."""
        cameras = tuple(self._entry(camera.name) for camera in self._around_vehicle())
        self.layout = self.layout.model_copy(update={"cameras": cameras})

    def completed_layout(self) -> RigLayout:
        """Return the layout with everything that was collected filled in, its cameras ordered around the vehicle."""
        cameras = tuple(
            self._entry(camera.name).model_copy(
                update={
                    "frame_id": self.frame_id(camera.name),
                    # The lens's, of which a view is taken, not the view's.
                    "calibration": self.calibration(camera.name),
                    "base_T_camera": PoseEntry.from_matrix(self.pose(camera.name)),
                }
            )
            for camera in self._around_vehicle()
        )
        return self.layout.model_copy(update={"cameras": cameras})

    def _around_vehicle(self) -> list[Camera]:
        cameras = {camera.name: camera for camera in self.rig().cameras}
        order = order_around_vehicle({name: camera.base_T_camera for name, camera in cameras.items()})
        return [cameras[name] for name in order]

    def _take_over(self, camera: str, views: Collection[str]) -> None:
        """Let what is known of a camera hold for the views of its lens."""
        _share(self._calibrations, camera, views)
        _share(self._frame_ids, camera, views)
        _share(self._refused, camera, views)
        _share(self._stamps, camera, views)
        _share(self._notes, camera, views)
        if camera in self._late:
            self._late |= {*views}

    def _layout_of(self, names: Collection[str]) -> RigLayout:
        """Leave the other cameras out; the first camera stands in for the anchor."""
        entries = tuple(entry for entry in self.layout.cameras if entry.name in names)
        anchor = self.layout.anchor if self.layout.anchor in names else None
        return self.layout.model_copy(update={"cameras": entries, "anchor": anchor})

    def _entry(self, camera: str) -> CameraEntry:
        return next(entry for entry in self.layout.cameras if entry.name == camera)

    def _problem(self, camera: str) -> str | None:
        return self.calibration_problem(camera) or self.transform_problem(camera)


def _share(known: dict[str, T], camera: str, views: Collection[str]) -> None:
    """Give what is known of a camera to the views of its lens."""
    if camera in known:
        known.update(dict.fromkeys(views, known.pop(camera)))
