# SPDX-License-Identifier: Apache-2.0
"""Pre-training on shards of simulated drives, where depth is known: before any fine-tuning on recordings."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from cvcdepth_core.engines import resolve_device
from cvcdepth_core.networks.checkpoint import Checkpoint
from cvcdepth_core.networks.registry import RIG_CONDITIONED
from cvcdepth_core.scoring.metrics import METRIC_NAMES, SUMS, metrics_of, sum_errors
from cvcdepth_core.training.config import TrainingConfig
from cvcdepth_core.training.distributed import Processes, own_device
from cvcdepth_core.training.starting_model import build_surround_model
from cvcdepth_core.training.trainer import Trainer, ValidationOutcome
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.training_data.world_views import ViewReader, WorldBatches, batch_of_views

_MIN_DEPTH = 0.5  # metres, of scores
_TOGETHER = 8  # views that are scored at a time


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
    score = ViewScores(batches.held_out, job.config, device) if batches.held_out.views else None
    if not job.config.depth.is_told_its_rig:
        warn(f"depth.network is not {RIG_CONDITIONED}: a network that is not told its rig learns no rig's scale")
    trainer = Trainer(
        job.config,
        build_surround_model(job.config, job.start),
        batches,
        job.run,
        device,
        score,
        {"version": package_version(), "config": job.config.model_dump_json(), "start": started_from},
        processes=processes,
        inputs={"start": started_from, "drives": _identity(job.shards)},
    )
    trainer.train(quiet=job.quiet)
    return trainer


def _identity(paths: Sequence[Path]) -> str:
    """Return a hash of the shards' names and sizes: the same choices give the same bytes."""
    told = "\n".join(f"{path.name} {path.stat().st_size}" for path in paths)
    return f"{len(paths)} drives {hashlib.sha256(told.encode()).hexdigest()[:16]}"


class ViewScores:
    """Scores weights on whole views of held-out drives, at most `evaluation.sets` of them."""

    def __init__(self, reader: ViewReader, config: TrainingConfig, device: torch.device) -> None:
        chosen = np.random.default_rng(config.seed).permutation(len(reader.views))[: config.evaluation.sets]
        self._reader, self._config, self._device = reader, config, device
        self._views = [reader.views[i] for i in sorted(chosen.tolist())]

    def __call__(self, trainer: Trainer) -> ValidationOutcome:
        """Return the metrics of all pixels nearer than `evaluation.max_depth`, mean over views."""
        model, rows = trainer.result, []
        for start in range(0, len(self._views), _TOGETHER):
            views = [self._reader.read(v, self._config.worlds, None) for v in self._views[start : start + _TOGETHER]]
            batch = batch_of_views(views).to(self._device)
            as_it_is = torch.zeros(len(views), dtype=torch.bool, device=self._device)
            depth = model(batch, batch.frames, as_it_is, as_it_is).depth[:, 0, 0].double().cpu().numpy()
            for found, view in zip(depth, views, strict=True):
                known = (view.truth > _MIN_DEPTH) & (view.truth < self._config.evaluation.max_depth)
                if known.any():
                    rows.append(sum_errors(found[known], view.truth[known].astype(np.float64)))
        means = np.nanmean(metrics_of(np.array(rows, SUMS)), axis=0)
        scores = {name: round(float(mean), 4) for name, mean in zip(METRIC_NAMES, means, strict=True)}
        return ValidationOutcome(scores)
