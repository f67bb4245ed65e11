# SPDX-License-Identifier: Apache-2.0
"""Training samples straight from recordings: a surround set and those before and after it, as a `RigBatch`. No ROS.

Pictures go through the node's own decoding and preprocessing, so that the network learns from what it will see.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle, islice, pairwise
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from cvcdepth_core.errors import ImageError, RecordingError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.rectifier import SurroundPreprocessor
from cvcdepth_core.networks.pose import MAX_TRANSLATION
from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.config import RecordingsConfig, TrainingConfig
from cvcdepth_core.training.distributed import ALONE, Processes
from cvcdepth_ros.bags import Recording, open_recording
from cvcdepth_ros.messages.conversion import picture_from_message, stamp_ns
from cvcdepth_ros.training_data.index import RecordingIndex

Part = Literal["training", "held_out"]


class Sample(NamedTuple):
    """Which sets of which recording form a training sample."""

    recording: int
    target: int
    before: int
    after: int


def first_held_out(index: RecordingIndex, held_out: float) -> int:
    """Return the number of the first set that is held out; of no set where none is.

    Sets are counted, not seconds: stamps may jump, from 1970 to now when the clock is set while the vehicle drives.
    """
    return len(index) - math.ceil(held_out * (len(index) - 1))


def find_samples(index: RecordingIndex, config: RecordingsConfig, part: Part, recording: int = 0) -> list[Sample]:
    """Return the samples of one part of a recording, none of whose sets is of the other part.

    A sample's contexts are the nearest sets before and after the target that the vehicle has moved far enough from.
    Where they are known to be farther than the pose network can tell, there is no sample (`told_beyond_reach`).
    """
    found = _within_interval(index, config, part, recording)
    return [sample for sample in found if _travel(index, sample) <= MAX_TRANSLATION]


def told_beyond_reach(index: RecordingIndex, config: RecordingsConfig) -> str | None:
    """Say how many training samples are left out since the vehicle moves too far between their sets, if any."""
    travels = [_travel(index, sample) for sample in _within_interval(index, config, "training")]
    too_far = [travel for travel in travels if travel > MAX_TRANSLATION]
    if not too_far:
        return None
    return (
        f"{len(too_far)} training samples are left out: the vehicle moves up to {max(too_far):.1f} m between two of "
        f"their sets, and the pose network tells no more than {MAX_TRANSLATION:g}"
    )


def _travel(index: RecordingIndex, sample: Sample) -> float:
    """Return the recorded metres from the target to the farther context; 0 where no motion is recorded."""
    if index.poses is None:
        return 0.0
    return max(change_between(index, sample.target, other) for other in (sample.before, sample.after))


def _within_interval(index: RecordingIndex, config: RecordingsConfig, part: Part, recording: int = 0) -> list[Sample]:
    held_out = np.arange(len(index)) >= first_held_out(index, config.held_out)
    members = np.flatnonzero(held_out == (part == "held_out"))
    samples = []
    for target in members.tolist():
        before = _context(index, config, target, -1)
        after = _context(index, config, target, +1)
        if before is not None and after is not None and held_out[before] == held_out[after] == held_out[target]:
            samples.append(Sample(recording, target, before, after))
    return samples


def refuse_standstill(indexes: Sequence[RecordingIndex], config: RecordingsConfig) -> None:
    """Raise RecordingError, naming recording and values, when none of the recordings has a training sample."""
    if not any(find_samples(index, config, "training") for index in indexes):
        raise RecordingError("; ".join(_why_no_sample(index, config) for index in indexes))


def _context(index: RecordingIndex, config: RecordingsConfig, target: int, step: int) -> int | None:
    """Return the nearest set before (step -1) or after (+1) the target that is far enough, None without any."""
    stamps = index.stamps[:, index.anchor]
    other = target + step
    while 0 <= other < len(index) and 0 < step * (stamps[other] - stamps[target]) <= config.max_interval * NANOSECONDS:
        if _has_moved(index, config, target, other):
            return other
        other += step
    return None


def _has_moved(index: RecordingIndex, config: RecordingsConfig, first: int, second: int) -> bool:
    needed = config.min_travel if index.poses is not None else config.min_image_change
    return change_between(index, first, second) >= needed


def change_between(index: RecordingIndex, first: int, second: int) -> float:
    """Return metres travelled between two sets, or, without recorded motion, by how much the picture changed."""
    if index.poses is not None:
        positions = index.poses[[first, second], index.anchor, :3, 3]
        return float(np.linalg.norm(positions[1] - positions[0]))
    if index.thumbnails is None:
        raise RecordingError(f"{index.path}: its index has neither motion nor thumbnails")
    difference = cv2.norm(index.thumbnails[first], index.thumbnails[second], cv2.NORM_L1)
    return float(difference / index.thumbnails[0].size)


def _why_no_sample(index: RecordingIndex, config: RecordingsConfig) -> str:
    changes = [change_between(index, first, second) for first, second in pairwise(range(len(index)))]
    largest = max(changes, default=0.0)
    unplaced = f", {index.unplaced} more lie outside of the recorded motion" if index.unplaced else ""
    if beyond := told_beyond_reach(index, config):
        return f"{index.path}: no training sample in {len(index)} sets{unplaced}: {beyond}"
    if index.poses is not None:
        motion = f"the vehicle moves {largest:.3f} m at most from one to the next, min_travel is {config.min_travel:g}"
    else:
        motion = f"pictures change by {largest:.2f} at most, min_image_change is {config.min_image_change:g}"
    return (
        f"{index.path}: no training sample in {len(index)} sets{unplaced}: {motion} within max_interval "
        f"{config.max_interval:g} s on both sides of a set; held_out is {config.held_out:g}"
    )


@dataclass(frozen=True, eq=False)
class NetworkRig:
    """What all samples of one rig have in common, at network resolution."""

    preprocessor: SurroundPreprocessor
    names: tuple[str, ...]
    anchor: int
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4] without the vehicle's motion."""
    pairs: tuple[tuple[int, int], ...]
    """(camera, neighbour)."""

    @classmethod
    def of(cls, index: RecordingIndex, height: int, width: int) -> NetworkRig:
        """Prepare the rig of a recording; RigError names a mask that does not fit."""
        rig = index.layout.complete()
        return cls(
            SurroundPreprocessor(rig, height, width),
            tuple(rig.names),
            index.anchor,
            np.stack([camera.base_T_camera for camera in rig.cameras]),
            tuple(rig.neighbour_indices),
        )

    def batch(self, frames: Tensor, base_T_camera: Tensor, delays: Tensor, context_times: Tensor) -> RigBatch:
        """Join what samples have of their own with the rig's constants.

        That is pictures (uint8 [B, 3, N, H, W, 3], target first), poses [B, N, 4, 4] and the times of `ReadSample`.
        """
        samples = len(frames)
        masks = torch.from_numpy(self.preprocessor.valid).float()[:, None]
        intrinsics = torch.from_numpy(self.preprocessor.intrinsics).float()
        return RigBatch(
            frames=frames.permute(0, 1, 2, 5, 3, 4).contiguous().float() / 255,
            masks=masks.expand(samples, *masks.shape),
            intrinsics=intrinsics.expand(samples, *intrinsics.shape),
            base_T_camera=base_T_camera.float(),
            targets=torch.tensor([target for target, _ in self.pairs]),
            sources=torch.tensor([source for _, source in self.pairs]),
            camera_names=self.names,
            anchor=self.anchor,
            exposure_delays=delays.float() if bool(delays.any()) else None,
            context_times=context_times.float(),
        )


class PictureCache:
    """Pictures by key, least recently used ones dropped beyond `limit` bytes."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._pictures: OrderedDict[tuple[int, int], NDArray[np.uint8]] = OrderedDict()
        self._size = 0

    def get(self, key: tuple[int, int]) -> NDArray[np.uint8] | None:
        """Return what was put there, or None."""
        if key in self._pictures:
            self._pictures.move_to_end(key)
        return self._pictures.get(key)

    def put(self, key: tuple[int, int], pictures: NDArray[np.uint8]) -> None:
        """Keep `pictures` under a key that is not there yet."""
        self._pictures[key] = pictures
        self._size += pictures.nbytes
        while self._size > self._limit:
            self._size -= self._pictures.popitem(last=False)[1].nbytes


class ReadSample(NamedTuple):
    """A training sample's content."""

    recording: int
    pictures: NDArray[np.uint8]
    """[3, N, H, W, 3] of target, before and after."""
    base_T_camera: NDArray[np.float64]
    """[N, 4, 4] at the target."""
    exposure_delays: NDArray[np.float64]
    """[N] seconds from the anchor's exposure to each camera's that the poses do not tell yet."""
    context_times: NDArray[np.float64]
    """[2] seconds from the target to before and after."""


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
    ) -> None:
        self.samples = list(samples)
        self.rigs = [NetworkRig.of(index, height, width) for index in indexes]
        self._indexes = list(indexes)
        self._exposure_motion = config.exposure_motion
        self._cache = PictureCache(config.cache_mb * 2**20)
        self._recordings: dict[int, Recording] = {}

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, item: int) -> ReadSample | None:
        sample = self.samples[item]
        try:
            frames = [self.pictures(sample.recording, row) for row in (sample.target, sample.before, sample.after)]
        except ImageError:
            return None
        poses = self.camera_poses(sample.recording, sample.target)
        return ReadSample(sample.recording, np.stack(frames), poses, *self.exposures(sample))

    def pictures(self, recording: int, row: int) -> NDArray[np.uint8]:
        """Return the rectified pictures [N, H, W, 3] of a set; ImageError names the camera of a damaged one."""
        pictures = self._cache.get((recording, row))
        if pictures is None:
            pictures = np.stack(list(self._rectified(recording, row)))
            self._cache.put((recording, row), pictures)
        return pictures

    def camera_poses(self, recording: int, row: int) -> NDArray[np.float64]:
        """Return each camera's pose [N, 4, 4] at its own exposure, in the base frame at the anchor's.

        The poses lead from frame to frame too: while the vehicle's velocity is constant, its motion between two sets
        is the same from any camera's exposure to its next.
        """
        index, base_T_camera = self._indexes[recording], self.rigs[recording].base_T_camera
        if self._exposure_motion not in ("auto", "recorded") or index.poses is None:
            return base_T_camera
        anchor_T_world = inverse(index.poses[row, index.anchor])
        moved: NDArray[np.float64] = anchor_T_world @ index.poses[row] @ base_T_camera
        return moved

    def exposures(self, sample: Sample) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the delays [N] that the pose network's motion has to make good for, and the contexts' times [2], s."""
        index = self._indexes[sample.recording]
        times = (index.times - index.times[sample.target, index.anchor]) / NANOSECONDS
        by_network = self._exposure_motion == "network" or (self._exposure_motion == "auto" and index.poses is None)
        delays = times[sample.target] if by_network else np.zeros(len(times[0]))
        return delays, times[[sample.before, sample.after], index.anchor]

    def _rectified(self, recording: int, row: int) -> Iterator[Picture]:
        messages = self._messages(recording, row)
        rig = self.rigs[recording]
        for camera, (name, message) in enumerate(zip(rig.names, messages, strict=True)):
            if message is None:
                raise ImageError(f"camera {name}: the image of set {row} is not found again in the recording")
            reduction = rig.preprocessor.rectifiers[name].reduction
            yield rig.preprocessor.rectify(camera, picture_from_message(message, name, reduction), reduction)

    def _messages(self, recording: int, row: int) -> list[Any]:
        """Return each camera's message of a set, None where the recording has it no more."""
        index, opened = self._indexes[recording], self._open(recording)
        log_times = index.log_times[row].tolist()
        topics = [camera.image_topic for camera in index.layout.cameras]
        wanted = {(topic, time): camera for camera, (topic, time) in enumerate(zip(topics, log_times, strict=True))}
        found: list[Any] = [None] * len(topics)
        for message in opened.messages(set(topics), min(log_times), max(log_times) + 1):
            camera = wanted.get((message.topic, message.log_time))
            if camera is not None:
                content = opened.deserialize(message)
                if stamp_ns(content) == index.stamps[row, camera]:
                    found[camera] = content
        return found

    def _open(self, recording: int) -> Recording:
        """Open recordings where they are read, in each worker process on its own."""
        if recording not in self._recordings:
            self._recordings[recording] = open_recording(self._indexes[recording].path)
        return self._recordings[recording]


class _EpochOrder:
    """The batches that a DataLoader asks for; another list for every epoch, so that its workers live on."""

    def __init__(self) -> None:
        self.batches: list[list[int]] = []

    def __iter__(self) -> Iterator[list[int]]:
        return iter(self.batches)

    def __len__(self) -> int:
        return len(self.batches)


class RecordingBatches:
    """The part of the training samples that is this process's, shuffled anew every epoch; each batch is of one rig.

    The order depends on seed and epoch only, so that a run can be resumed at any batch. Samples that go through the
    networks of several processes together are of one rig, too.
    """

    def __init__(self, indexes: Sequence[RecordingIndex], config: TrainingConfig, processes: Processes = ALONE) -> None:
        """Find the samples; RecordingError names recording and values when there are none."""
        _refuse_unrecorded_motion(indexes, config.recordings)
        refuse_standstill(indexes, config.recordings)
        samples = [
            sample
            for recording, index in enumerate(indexes)
            for sample in find_samples(index, config.recordings, "training", recording)
        ]
        self.reader = SampleReader(indexes, samples, config.depth.height, config.depth.width, config.recordings)
        self._rig_groups = _group_by_rig(indexes, samples)
        self._processes = processes
        self._samples_together = config.optimizer.samples_per_batch * processes.count
        self._seed = config.seed
        self._order = _EpochOrder()
        self._loader = _loader(self.reader, self._order, config.recordings.workers)

    def __len__(self) -> int:
        return len(self._shuffled(epoch=0))

    @property
    def samples(self) -> int:
        """Samples of one epoch, of all processes together."""
        return len(self.reader)

    def epoch(self, number: int, first: int = 0) -> Iterator[RigBatch | None]:
        """Give the batches of an epoch from the `first` on; None for one whose images are all damaged."""
        rank, count = self._processes.rank, self._processes.count
        self._order.batches = [_at_least(together, count)[rank::count] for together in self._shuffled(number)[first:]]
        yield from self._loader

    def _shuffled(self, epoch: int) -> list[list[int]]:
        """Return the samples that go together through the networks of all processes."""
        generator = np.random.default_rng([self._seed, epoch])
        size = self._samples_together
        orders = [generator.permutation(group).tolist() for group in self._rig_groups]
        batches = [order[start : start + size] for order in orders for start in range(0, len(order), size)]
        return [batches[i] for i in generator.permutation(len(batches))]


def _refuse_unrecorded_motion(indexes: Sequence[RecordingIndex], config: RecordingsConfig) -> None:
    without = [str(index.path) for index in indexes if index.poses is None]
    if config.exposure_motion == "recorded" and without:
        raise RecordingError(
            f"{', '.join(without)}: no motion is recorded, but recordings.exposure_motion is 'recorded'; 'auto' takes "
            "the pose network's there"
        )


def _at_least(samples: list[int], count: int) -> list[int]:
    """Repeat samples, at the end of a rig's, until every process has one: they wait for each other."""
    return list(islice(cycle(samples), max(count, len(samples))))


def _group_by_rig(indexes: Sequence[RecordingIndex], samples: Sequence[Sample]) -> list[list[int]]:
    """Return the samples' positions, those of equal rigs together."""
    layouts = [index.layout for index in indexes]
    groups: dict[int, list[int]] = {}
    for position, sample in enumerate(samples):
        groups.setdefault(layouts.index(layouts[sample.recording]), []).append(position)
    return list(groups.values())


def _loader(reader: SampleReader, order: _EpochOrder, workers: int) -> DataLoader[Any]:
    return DataLoader(
        reader,
        batch_sampler=order,
        num_workers=workers,
        persistent_workers=workers > 0,
        # A forked worker inherits locks that a thread of OpenCV, torch or fsspec may hold, and then waits for ever.
        multiprocessing_context="spawn" if workers else None,
        collate_fn=partial(_collate, reader.rigs),
        worker_init_fn=_one_thread,
    )


def _one_thread(_: int) -> None:
    """Leave the cores to the other workers."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _collate(rigs: Sequence[NetworkRig], items: Sequence[ReadSample | None]) -> RigBatch | None:
    read = [item for item in items if item is not None]
    if not read:
        return None
    recordings, *columns = zip(*read, strict=True)
    rig: NetworkRig = rigs[recordings[0]]
    return rig.batch(*(torch.from_numpy(np.stack(column)) for column in columns))
