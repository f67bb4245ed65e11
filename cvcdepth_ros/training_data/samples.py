# SPDX-License-Identifier: Apache-2.0
"""Training samples straight from recordings: a surround set and those before and after it, as a `RigBatch`. No ROS.

Pictures go through the node's own decoding and preprocessing, so that the network learns from what it will see.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from cvcdepth_core.errors import ImageError, RecordingError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.config import RecordingsConfig
from cvcdepth_ros.bags import Recording, open_recording
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.recently_used import RecentlyUsed
from cvcdepth_ros.surround_sets.set_estimation import images_of
from cvcdepth_ros.training_data.index import RecordingIndex
from cvcdepth_ros.training_data.recorded_truth import TruthReader, TruthSource
from cvcdepth_ros.training_data.sample_choice import Sample, takes_recorded_exposures, takes_recorded_motion


@dataclass(frozen=True, eq=False)
class NetworkRig:
    """The constants of all samples of one rig, at network resolution."""

    preprocessor: SurroundPreprocessor
    names: tuple[str, ...]
    anchor: int
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4] without the vehicle's motion; z = 0 is the base frame's, `ground_height` above it the ground."""
    ground_height: float
    pairs: tuple[tuple[int, int], ...]
    """(camera, neighbour)."""

    @property
    def poses_above_ground(self) -> NDArray[np.float64]:
        """`base_T_camera` [N, 4, 4] with the ground at z = 0."""
        poses: NDArray[np.float64] = self.base_T_camera.copy()
        poses[:, 2, 3] -= self.ground_height
        return poses

    @classmethod
    def from_index(cls, index: RecordingIndex, height: int, width: int) -> NetworkRig:
        """Prepare the rig of a recording; RigError names a mask that does not fit."""
        rig = index.layout.complete()
        return cls(
            SurroundPreprocessor(rig, height, width),
            tuple(rig.names),
            index.anchor,
            np.stack([camera.base_T_camera for camera in rig.cameras]),
            rig.ground_z,
            tuple(rig.neighbour_indices),
        )

    def batch(
        self,
        frames: Tensor,
        base_T_camera: Tensor,
        delays: Tensor,
        context_times: Tensor,
        recorded_poses: Tensor | None = None,
        truth: Tensor | None = None,
        truth_is_sparse: bool = False,
    ) -> RigBatch:
        """Join what samples have of their own with the rig's constants.

        That is pictures (uint8 [B, 3, N, H, W, 3], target first), poses [B, N, 4, 4], times, recorded poses and truth
        of `ReadSample`. The batch's poses have the ground at z = 0; its truth is unknown where the masks are 0.
        """
        samples = len(frames)
        masks = torch.from_numpy(self.preprocessor.valid).float()[:, None]
        intrinsics = torch.from_numpy(self.preprocessor.intrinsics).float()
        base_T_camera = base_T_camera.clone()
        base_T_camera[..., 2, 3] -= self.ground_height
        return RigBatch(
            frames=frames.permute(0, 1, 2, 5, 3, 4).contiguous().float() / 255,
            masks=masks.expand(samples, *masks.shape),
            intrinsics=intrinsics.expand(samples, *intrinsics.shape),
            base_T_camera=base_T_camera.float(),
            targets=torch.tensor([target for target, _ in self.pairs], dtype=torch.int64),
            sources=torch.tensor([source for _, source in self.pairs], dtype=torch.int64),
            camera_names=self.names,
            anchor=self.anchor,
            exposure_delays=delays.float() if bool(delays.any()) else None,
            context_times=context_times.float(),
            recorded_poses=None if recorded_poses is None else recorded_poses.float(),
            truth=None if truth is None else torch.where(masks > 0, truth[:, :, None].float(), torch.nan),
            truth_is_sparse=truth_is_sparse,
        )


class ReadSample(NamedTuple):
    """A training sample's content."""

    recording: int
    pictures: NDArray[np.uint8]
    """[3, N, H, W, 3] of target, before and after."""
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4] at the target."""
    exposure_delays: NDArray[np.float64]
    """[N] seconds from the anchor's exposure to each camera's that the poses do not contain yet."""
    context_times: NDArray[np.float64]
    """[2] seconds from the target to before and after."""
    recorded_poses: NDArray[np.float64] | None
    """[3, N, 4, 4] each camera's at target, before and after, in the base frame at the anchor's target exposure; None
    where the losses take the pose network's motion."""
    truth: NDArray[np.float32] | None
    """[N, H, W] metres at the target; inf in the sky, NaN where it is not known; None where none is learnt from."""


class SampleReader(Dataset[ReadSample | None]):
    """Random access to samples, each decoded and rectified when it is asked for.

    A sample with a damaged image is None: one cut JPEG does not end a training.
    """

    def __init__(
        self,
        indexes: Sequence[RecordingIndex],
        samples: Sequence[Sample],
        height: int,
        width: int,
        config: RecordingsConfig,
        truth_sources: Sequence[TruthSource | None] = (),
        lidar: tuple[str, ...] | None = None,
    ) -> None:
        """`truth_sources` are those of each recording, without any there is no truth; `lidar` names LiDARs' topics."""
        self.samples = list(samples)
        self.rigs = [NetworkRig.from_index(index, height, width) for index in indexes]
        self._indexes = list(indexes)
        self._config = config
        self._cache: RecentlyUsed[tuple[int, int], NDArray[np.uint8]] = RecentlyUsed(config.cache_mb * 2**20)
        self._recordings: dict[int, Recording] = {}
        self.truth_sources = list(truth_sources) or [None] * len(indexes)
        self._lidar = lidar
        self._truth_readers: dict[int, TruthReader] = {}
        self._true_depth: RecentlyUsed[tuple[int, int], NDArray[np.float32]] = RecentlyUsed(config.cache_mb * 2**20)

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, item: int) -> ReadSample | None:
        sample = self.samples[item]
        try:
            frames = [self.pictures(sample.recording, row) for row in (sample.target, sample.before, sample.after)]
        except ImageError:
            return None
        poses = self.camera_poses(sample.recording, sample.target)
        exposures, recorded_poses = self.exposures(sample), self.recorded_poses(sample)
        truth = self.truth(sample.recording, sample.target)
        return ReadSample(sample.recording, np.stack(frames), poses, *exposures, recorded_poses, truth)

    def pictures(self, recording: int, row: int) -> NDArray[np.uint8]:
        """Return the rectified pictures [N, H, W, 3] of a set; ImageError names the camera of a damaged one."""
        pictures = self._cache.get((recording, row))
        if pictures is None:
            pictures = np.stack(list(self._rectified(recording, row)))
            self._cache.put((recording, row), pictures, pictures.nbytes)
        return pictures

    def truth(self, recording: int, row: int) -> NDArray[np.float32] | None:
        """Return the true depth [N, H, W] of a set as `ReadSample` has it; None where none is learnt from."""
        source = self.truth_sources[recording]
        if source is None:
            return None
        truth = self._true_depth.get((recording, row))
        if truth is None:
            if recording not in self._truth_readers:
                opened, index = self._open(recording), self._indexes[recording]
                self._truth_readers[recording] = TruthReader(index, opened, source, self._lidar)
            height, width = self.rigs[recording].preprocessor.valid.shape[1:]
            truth = self._truth_readers[recording].read(row, height, width)
            self._true_depth.put((recording, row), truth, truth.nbytes)
        return truth

    def camera_poses(self, recording: int, row: int) -> NDArray[np.float64]:
        """Return each camera's pose [N, 4, 4] at its own exposure, in the base frame at the anchor's.

        The poses lead from frame to frame too: while the vehicle's velocity is constant, its motion between two sets
        is the same from any camera's exposure to its next.
        """
        if not takes_recorded_exposures(self._indexes[recording], self._config):
            return self.rigs[recording].base_T_camera
        poses: NDArray[np.float64] = self._poses_at(recording, [row])[0]
        return poses

    def recorded_poses(self, sample: Sample) -> NDArray[np.float64] | None:
        """Return the recorded poses of `ReadSample`, or None."""
        if not takes_recorded_motion(self._indexes[sample.recording], self._config):
            return None
        return self._poses_at(sample.recording, [sample.target, sample.before, sample.after])

    def _poses_at(self, recording: int, rows: Sequence[int]) -> NDArray[np.float64]:
        """Return the cameras' recorded poses [R, N, 4, 4] in some sets, in the base frame at the first one's anchor."""
        index = self._indexes[recording]
        if index.poses is None:
            raise RecordingError(f"{index.path}: its index has no motion")
        at_once = not takes_recorded_exposures(index, self._config)
        world_T_base = index.poses[rows][:, index.anchor, None] if at_once else index.poses[rows]
        anchor_T_world = inverse(index.poses[rows[0], index.anchor])
        poses: NDArray[np.float64] = anchor_T_world @ world_T_base @ self.rigs[recording].base_T_camera
        return poses

    def exposures(self, sample: Sample) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the delays [N] that the pose network's motion has to make good for, and the contexts' times [2], s."""
        index = self._indexes[sample.recording]
        times = (index.times - index.times[sample.target, index.anchor]) / NANOSECONDS
        by_network = self._config.exposure_motion != "none" and not takes_recorded_exposures(index, self._config)
        delays = times[sample.target] if by_network else np.zeros(len(times[0]))
        return delays, times[[sample.before, sample.after], index.anchor]

    def _rectified(self, recording: int, row: int) -> Iterator[Picture]:
        messages = self._messages(recording, row)
        rig = self.rigs[recording]
        for name, message in zip(rig.names, messages, strict=True):
            if message is None:
                raise ImageError(f"camera {name}: the image of set {row} is not found again in the recording")
        images = images_of(dict(zip(rig.names, messages, strict=True)))
        for camera, name in enumerate(rig.names):
            rectifier = rig.preprocessor.rectifiers[name]
            yield rig.preprocessor.rectify(camera, images[name].decoded(name, rectifier), rectifier.reduction)

    def _messages(self, recording: int, row: int) -> list[Any]:
        """Return each camera's message of a set, None where the recording has it no more."""
        index, opened = self._indexes[recording], self._open(recording)
        log_times = index.log_times[row].tolist()
        topics = [camera.image_topic for camera in index.layout.cameras]
        wanted: dict[tuple[str, int], list[int]] = {}
        for camera, place in enumerate(zip(topics, log_times, strict=True)):
            wanted.setdefault(place, []).append(camera)
        found: list[Any] = [None] * len(topics)
        for message in opened.messages(set(topics), min(log_times), max(log_times) + 1):
            cameras = wanted.get((message.topic, message.log_time), ())
            content = opened.deserialize(message) if cameras else None
            for camera in cameras:
                if stamp_ns(content) == index.stamps[row, camera]:
                    found[camera] = content
        return found

    def _open(self, recording: int) -> Recording:
        """Open recordings where they are read, in each worker process on its own."""
        if recording not in self._recordings:
            self._recordings[recording] = open_recording(self._indexes[recording].path)
        return self._recordings[recording]
