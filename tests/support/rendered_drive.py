# SPDX-License-Identifier: Apache-2.0
"""Surround sets of a rendered drive with all that is true of them, for cameras without distortion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.rig.rig_file import CameraEntry, PoseEntry, RigLayout
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.worlds.drive import DriveSpec, SimulatedDrive

FAR = 200.0
"""Metres that stand for the sky in tensors, which have no infinity."""


def pinhole_rig(yaws: Sequence[float], size: tuple[int, int], view: float, pitch: float = 0.0) -> RigLayout:
    """Cameras on a vehicle that look so many degrees to the left, `view` degrees wide, `pitch` degrees up."""
    width, height = size
    focal = width / 2 / math.tan(math.radians(view) / 2)
    lens = Calibration(width=width, height=height, k=(focal, 0, (width - 1) / 2, 0, focal, (height - 1) / 2, 0, 0, 1.0))
    return RigLayout(cameras=tuple(_entry(f"camera_{i}", lens, yaw, pitch) for i, yaw in enumerate(yaws)))


def _entry(name: str, lens: Calibration, yaw: float, pitch: float) -> CameraEntry:
    return CameraEntry(
        name=name,
        image_topic=f"/camera/{name}/image_raw/compressed",
        camera_info_topic=f"/camera/{name}/camera_info",
        frame_id=f"{name}_optical_frame",
        calibration=lens,
        base_T_camera=PoseEntry.from_matrix(_mount(yaw, pitch)),
    )


def _mount(yaw: float, pitch: float) -> np.ndarray:
    a, p = math.radians(yaw), math.radians(pitch)
    forward = np.array([math.cos(a) * math.cos(p), math.sin(a) * math.cos(p), math.sin(p)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = 0.6 + 1.0 * math.cos(a), 0.5 * math.sin(a), 1.55
    return pose


def turned(layout: RigLayout, camera: int, degrees: float, axis: int = 1) -> RigLayout:
    """The rig with one camera turned about its own x (0), y (1) or z (2)."""
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(math.radians(degrees) * np.eye(3)[axis])[0]
    entry = layout.cameras[camera]
    assert entry.base_T_camera is not None
    pose = PoseEntry.from_matrix(entry.base_T_camera.matrix(entry.name) @ turn)
    cameras = list(layout.cameras)
    cameras[camera] = entry.model_copy(update={"base_T_camera": pose})
    return layout.model_copy(update={"cameras": tuple(cameras)})


@dataclass(frozen=True, eq=False)
class TrueSet:
    """One surround set; arrays hold the cameras in the rig's order."""

    pictures: np.ndarray
    """[N, H, W, 3] uint8 RGB."""
    depth: np.ndarray
    """[N, H, W] metres, inf for the sky."""
    objects: np.ndarray
    """[N, H, W] numbers, see `World.names`."""
    world_T_base: np.ndarray
    """[N, 4, 4] at each camera's exposure."""


class TrueDrive:
    """A drive whose sets are rendered when they are asked for, once each."""

    def __init__(self, spec: DriveSpec) -> None:
        self.drive = SimulatedDrive(spec)
        self.rig = self.drive.rig
        self.mounts = np.stack([camera.base_T_camera for camera in self.rig.cameras])
        self.intrinsics = np.stack([camera.calibration.raw_intrinsics for camera in self.rig.cameras])
        self._sets: dict[int, TrueSet] = {}

    def true_set(self, number: int) -> TrueSet:
        """The set of that number."""
        if number not in self._sets:
            shots = [self.drive.shoot(camera, number) for camera in range(len(self.mounts))]
            times = [self.drive.spec.camera_time(camera, number) for camera in self.rig.cameras]
            self._sets[number] = TrueSet(
                np.stack([shot.picture for shot in shots]),
                np.stack([shot.truth.depth for shot in shots]),
                np.stack([shot.truth.objects for shot in shots]),
                np.stack([self.drive.way.pose(time) for time in times]),
            )
        return self._sets[number]

    def surround(self, number: int) -> SurroundDepth:
        """The set as an estimator would give it, with the true depth."""
        found = self.true_set(number)
        depth = np.minimum(found.depth, FAR).astype(np.float32)
        return SurroundDepth(depth, found.pictures, self.intrinsics, np.ones(len(depth), bool))

    def batch(self, target: int, before: int, after: int) -> RigBatch:
        """A training batch of one sample, float64, every camera where it was when it fired."""
        sets = [self.true_set(number) for number in (target, before, after)]
        anchor = self.rig.names.index(self.rig.anchor)
        base_T_world = inverse(sets[0].world_T_base[anchor])
        pairs = torch.tensor(self.rig.neighbour_indices)
        frames = torch.from_numpy(np.stack([found.pictures for found in sets])).permute(0, 1, 4, 2, 3)
        return RigBatch(
            frames=frames[None].double() / 255,
            masks=torch.ones(1, *sets[0].depth.shape, dtype=torch.float64)[:, :, None],
            intrinsics=torch.from_numpy(self.intrinsics)[None],
            base_T_camera=torch.from_numpy(base_T_world @ sets[0].world_T_base @ self.mounts)[None],
            targets=pairs[:, 0],
            sources=pairs[:, 1],
            camera_names=self.rig.names,
            anchor=anchor,
        )

    def depth(self, number: int) -> torch.Tensor:
        """[1, N, 1, H, W] metres."""
        return torch.from_numpy(np.minimum(self.true_set(number).depth, FAR))[None, :, None]

    def motions(self, target: int, before: int, after: int) -> torch.Tensor:
        """[1, 2, N, 4, 4] `context_T_target` of every camera."""
        now, *others = (self.true_set(number).world_T_base @ self.mounts for number in (target, before, after))
        motions = [[inverse(there) @ here for there, here in zip(other, now, strict=True)] for other in others]
        return torch.from_numpy(np.array(motions))[None]


def with_camera_of(surround: SurroundDepth, other: SurroundDepth, camera: int) -> SurroundDepth:
    """The set with picture and depth of one camera taken from a set of that camera alone."""
    depth, pictures = surround.depth.copy(), surround.pictures.copy()
    depth[camera], pictures[camera] = other.depth[0], other.pictures[0]
    return replace(surround, depth=depth, pictures=pictures)
