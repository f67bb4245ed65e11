# SPDX-License-Identifier: Apache-2.0
"""Pre-training on shards of simulated drives, where depth is known: before any fine-tuning on recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cvcdepth_core.engines import resolve_device
from cvcdepth_core.networks.checkpoint import Checkpoint
from cvcdepth_core.training.config import TrainingConfig
from cvcdepth_core.training.distributed import Processes, own_device
from cvcdepth_core.training.starting_model import build_surround_model
from cvcdepth_core.training.trainer import Trainer, ValidationOutcome
from cvcdepth_ros.finetuning.world_scores import NOT_TOLD, ViewScores, describe_drives, mean_scores
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.training_data.world_views import WorldBatches


@dataclass(frozen=True)
class PretrainJob:
    """What to train on, how, and from which weights."""

    shards: Sequence[Path]
    config: TrainingConfig
    run: Path
    """The run's folder."""
    start: Checkpoint | None
    """Weights to start from; None: random ones."""
    device: str = "auto"
    quiet: bool = False


def pretrain(job: PretrainJob, processes: Processes, warn: Callable[[str], None]) -> Trainer:
    """Train on the views of all drives but the last ones, which are scored before, after, and between epochs.

    An interrupted run goes on where it was. `warn` is called with a line about what is lost.
    """
    started_from = "random weights" if job.start is None else f"{job.start.path.name} sha256:{job.start.sha256}"
    batches = WorldBatches(job.shards, job.config, processes)
    device = own_device(resolve_device(job.device))
    scores = ViewScores(batches.held_out, job.config, device, job.config.evaluation.sets)
    if not job.config.depth.is_told_its_rig:
        warn(NOT_TOLD)
    trainer = Trainer(
        job.config,
        build_surround_model(job.config, job.start),
        batches,
        job.run,
        device,
        (lambda trainer: ValidationOutcome(mean_scores(scores(trainer.result)))) if scores.views else None,
        {"version": package_version(), "config": job.config.model_dump_json(), "start": started_from},
        processes=processes,
        inputs={"start": started_from, "drives": describe_drives(job.shards)},
    )
    trainer.train(quiet=job.quiet)
    return trainer
