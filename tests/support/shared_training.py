# SPDX-License-Identifier: Apache-2.0
"""A training that one process or several can make: `torchrun ... -m shared_training RUN EPOCHS SAMPLES_PER_BATCH`."""

import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from scenes import random_batch

from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.config import OptimizerConfig, PoseConfig, TrainingConfig
from cvcdepth_core.training.distributed import Processes, launched_processes
from cvcdepth_core.training.starting_model import build_surround_model
from cvcdepth_core.training.trainer import RehearsedBatch, Trainer, ValidationOutcome

SPEC = DepthModelSpec(encoder="efficientnet_lite0", height=64, width=64, min_depth=0.5, max_depth=80)
SAMPLES = 8
UNREADABLE = 5
REHEARSED = 3


class SharedBatches:
    """Eight samples, two at a time through the networks of all processes; one sample cannot be read."""

    def __init__(self, processes: Processes) -> None:
        self.samples = SAMPLES
        self._processes = processes

    def epoch(self, number: int, first: int = 0) -> Iterator[RigBatch | None]:
        """Give this process's part of each batch."""
        for start in range(2 * first, SAMPLES, 2):
            together = list(range(start, start + 2))[self._processes.rank :: self._processes.count]
            torch.manual_seed(1000 * number + start)
            batch = random_batch(2, 3, SPEC.height, SPEC.width)
            for name in ("frames", "masks", "intrinsics", "base_T_camera"):
                setattr(batch, name, getattr(batch, name)[[sample - start for sample in together]])
            yield None if UNREADABLE in together else batch


class SharedRehearsal:
    """Three single views with truth in every step, one of which a second process takes."""

    name, weight = "worlds", 0.4

    def __init__(self, processes: Processes) -> None:
        self._processes = processes

    def of_step(self, number: int) -> Iterator[RehearsedBatch]:
        """Give this process's part of a step."""
        torch.manual_seed(5000 + number)
        whole = random_batch(REHEARSED, 3, SPEC.height, SPEC.width)
        truth = 1 + 20 * torch.rand_like(whole.masks)
        mine = slice(self._processes.rank, None, self._processes.count)
        views = RigBatch(
            whole.frames[mine, :1, :1],
            whole.masks[mine, :1],
            whole.intrinsics[mine, :1],
            whole.base_T_camera[mine, :1],
            whole.targets[:0],
            whole.sources[:0],
            ("view",),
            truth=truth[mine, :1],
        )
        yield RehearsedBatch(0, views)


def train(run: Path, epochs: int, samples_per_batch: int, processes: Processes) -> None:
    """Train in float64, so that only a mistake can make two runs differ visibly."""
    config = TrainingConfig(
        depth=SPEC,
        pose=PoseConfig(encoder="efficientnet_lite0"),
        optimizer=OptimizerConfig(
            epochs=epochs, samples_per_step=4, samples_per_batch=samples_per_batch, average_decay=0.9
        ),
    )
    trainer = Trainer(
        config,
        build_surround_model(config).double(),
        SharedBatches(processes),
        run,
        validate=lambda trainer: ValidationOutcome({"rank": processes.rank}, stop=len(trainer.validations) == 2),
        processes=processes,
        rehearsal=SharedRehearsal(processes),
    )
    trainer.train(quiet=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    with launched_processes() as launched:
        train(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), launched)
