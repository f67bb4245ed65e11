# SPDX-License-Identifier: Apache-2.0
"""Batches of training samples, shuffled anew every epoch and shared among processes. No ROS here."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import cycle, islice
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader

from cvcdepth_core.errors import RecordingError, RigError
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.networks.volume import refuse_cameras_outside
from cvcdepth_core.rig.ground import refuse_unlikely_ground
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.config import RecordingsConfig, TrainingConfig
from cvcdepth_core.training.distributed import SINGLE_PROCESS, Processes
from cvcdepth_ros.training_data.index import RecordingIndex
from cvcdepth_ros.training_data.recorded_truth import TruthSource, truth_sources
from cvcdepth_ros.training_data.sample_choice import (
    Sample,
    find_variants,
    refuse_standstill,
    takes_recorded_motion,
)
from cvcdepth_ros.training_data.samples import NetworkRig, ReadSample, SampleReader

_OF_VARIANTS = 1
"""Tells the draws of variants from those of the order."""


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

    def __init__(
        self,
        indexes: Sequence[RecordingIndex],
        config: TrainingConfig,
        processes: Processes = SINGLE_PROCESS,
        lidar: tuple[str, ...] | None = None,
    ) -> None:
        """Find the samples; RecordingError names recording and values when there are none.

        `lidar` names the LiDARs' topics, of which truth is made (None: those of each recording). RigError names
        recording and camera where the network is told a rig that cannot be right about the ground, or where its volume
        does not contain the camera.
        """
        _refuse_unrecorded_motion(indexes, config.recordings)
        _refuse_impossible_rigs(indexes, config.depth)
        refuse_standstill(indexes, config.recordings)
        variants = [
            of_target
            for recording, index in enumerate(indexes)
            for of_target in find_variants(index, config.recordings, recording)
        ]
        every = [sample for of_target in variants for sample in of_target]
        size = config.depth.height, config.depth.width
        sources = truth_sources(indexes, config.recordings, lidar)
        self.reader = SampleReader(indexes, every, *size, config.recordings, sources, lidar)
        self.targets = [of_target[0] for of_target in variants]
        """The samples of an epoch, each with its nearest contexts."""
        ends = np.cumsum([len(of_target) for of_target in variants])
        self._variants = [range(end - len(of_target), end) for of_target, end in zip(variants, ends, strict=True)]
        self._rig_groups = _group_by_rig(indexes, self.targets, config.recordings, sources)
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
        return len(self.targets)

    @property
    def cameras_per_sample(self) -> float:
        """Pictures whose depth is learnt in a sample, mean over the samples of an epoch."""
        return float(np.mean([len(self.reader.rigs[sample.recording].names) for sample in self.targets]))

    def epoch(self, number: int, first: int = 0) -> Iterator[RigBatch | None]:
        """Yield the batches of an epoch from the `first` on; None for one whose images are all damaged."""
        rank, count = self._processes.rank, self._processes.count
        drawn = self._drawn(number)
        self._order.batches = [
            [drawn[target] for target in _at_least(together, count)[rank::count]]
            for together in self._shuffled(number)[first:]
        ]
        yield from self._loader

    def _drawn(self, epoch: int) -> list[int]:
        """Return the place in the reader of the variant of each target that an epoch takes."""
        generator = np.random.default_rng([self._seed, epoch, _OF_VARIANTS])
        return [places[int(generator.integers(len(places)))] for places in self._variants]

    def _shuffled(self, epoch: int) -> list[list[int]]:
        """Return the targets that go together through the networks of all processes."""
        generator = np.random.default_rng([self._seed, epoch])
        size = self._samples_together
        orders = [generator.permutation(group).tolist() for group in self._rig_groups]
        batches = [order[start : start + size] for order in orders for start in range(0, len(order), size)]
        return [batches[i] for i in generator.permutation(len(batches))]


def _refuse_unrecorded_motion(indexes: Sequence[RecordingIndex], config: RecordingsConfig) -> None:
    without = [str(index.path) for index in indexes if index.poses is None]
    for name in ("motion", "exposure_motion"):
        if getattr(config, name) == "recorded" and without:
            raise RecordingError(
                f"{', '.join(without)}: no motion is recorded, but recordings.{name} is 'recorded'; 'auto' takes "
                "the pose network's there"
            )


def _refuse_impossible_rigs(indexes: Sequence[RecordingIndex], spec: DepthModelSpec) -> None:
    for index in indexes:
        rig = index.layout.complete()
        try:
            if spec.is_told_its_rig:
                refuse_unlikely_ground(rig)
            if spec.volume is not None:
                refuse_cameras_outside(spec.volume, rig.poses_above_ground, rig.names)
        except RigError as error:
            raise RigError(f"{index.path}: {error}") from error


def _at_least(samples: list[int], count: int) -> list[int]:
    """Repeat samples, at the end of a rig's, until every process has one: they wait for each other."""
    return list(islice(cycle(samples), max(count, len(samples))))


def _group_by_rig(
    indexes: Sequence[RecordingIndex],
    samples: Sequence[Sample],
    config: RecordingsConfig,
    sources: Sequence[TruthSource | None],
) -> list[list[int]]:
    """Return the samples' positions, those of equal rigs and of motion and truth from the same source together."""
    kinds = [
        (index.layout, takes_recorded_motion(index, config), source)
        for index, source in zip(indexes, sources, strict=True)
    ]
    groups: dict[int, list[int]] = {}
    for position, sample in enumerate(samples):
        groups.setdefault(kinds.index(kinds[sample.recording]), []).append(position)
    return list(groups.values())


def _loader(reader: SampleReader, order: _EpochOrder, workers: int) -> DataLoader[Any]:
    return DataLoader(
        reader,
        batch_sampler=order,
        num_workers=workers,
        persistent_workers=workers > 0,
        # A forked worker inherits locks that a thread of OpenCV, torch or fsspec may hold, and then waits for ever.
        multiprocessing_context="spawn" if workers else None,
        collate_fn=partial(_collate, reader.rigs, reader.truth_sources),
        worker_init_fn=_one_thread,
    )


def _one_thread(_: int) -> None:
    """Leave the cores to the other workers."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _collate(
    rigs: Sequence[NetworkRig], sources: Sequence[TruthSource | None], items: Sequence[ReadSample | None]
) -> RigBatch | None:
    read = [item for item in items if item is not None]
    if not read:
        return None
    recordings, pictures, poses, delays, times, recorded_poses, truth = zip(*read, strict=True)
    rig: NetworkRig = rigs[recordings[0]]
    return rig.batch(
        _stacked(pictures),
        _stacked(poses),
        _stacked(delays),
        _stacked(times),
        None if recorded_poses[0] is None else _stacked(recorded_poses),
        None if truth[0] is None else _stacked(truth),
        truth_is_sparse=sources[recordings[0]] == "lidar",
    )


def _stacked(column: Sequence[NDArray[Any]]) -> Tensor:
    return torch.from_numpy(np.stack(column))
