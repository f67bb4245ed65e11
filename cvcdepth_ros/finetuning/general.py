# SPDX-License-Identifier: Apache-2.0
"""Worlds beside recordings: views that a fine-tuning learns from too and is scored on, so that it does not forget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cvcdepth_core.training.config import TrainingConfig
from cvcdepth_core.training.distributed import Processes
from cvcdepth_ros.finetuning.world_scores import ViewScores, describe_drives
from cvcdepth_ros.training_data.loader import RecordingBatches
from cvcdepth_ros.training_data.world_views import ViewReader, WorldRehearsal, read_drives


@dataclass(frozen=True, eq=False)
class General:
    """The worlds of a run."""

    shards: Sequence[Path]
    training: ViewReader
    held_out: ViewReader
    rehearsal: WorldRehearsal | None
    """None where the run learns from recordings alone."""
    config: TrainingConfig

    def scores(self, device: torch.device, most: int | None = None) -> ViewScores | None:
        """Return what scores the held-out views, at most `most` of them; None where fewer than two are held out."""
        return ViewScores(self.held_out, self.config, device, most) if len(self.held_out.views) > 1 else None

    @property
    def identity(self) -> str:
        """Number and hash of the drives."""
        return describe_drives(self.shards)

    def to_json(self) -> dict[str, Any]:
        """Return what the run learns from, with JSON's types."""
        return {
            "drives": self.identity,
            "training_views": len(self.training.views) if self.rehearsal is not None else 0,
            "held_out_views": len(self.held_out.views),
            "views_per_step": 0 if self.rehearsal is None else self.rehearsal.views_per_step,
            "share": self.config.worlds.share,
            "weight": self.config.worlds.weight,
        }


def open_general(
    shards: Sequence[Path], batches: RecordingBatches, config: TrainingConfig, processes: Processes
) -> General | None:
    """Return the worlds of `shards` as a run with these recordings has them; None without shards.

    ConfigError when no drive is left to train on; RecordingError names a damaged shard.
    """
    if not shards:
        return None
    training, held_out = read_drives(shards, config)
    rehearsal = None
    if config.worlds.share:
        rehearsal = WorldRehearsal(training, config, batches.cameras_per_sample, processes)
    return General(shards, training, held_out, rehearsal, config)
