# SPDX-License-Identifier: Apache-2.0
"""The held-out part of every recording, scored as `evaluate` scores it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.training.config import TrainingConfig
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.console import progress_bar
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings, unique_names
from cvcdepth_ros.evaluation.result import EvaluationResult
from cvcdepth_ros.evaluation.workers import KeptScores, evaluate_all
from cvcdepth_ros.training_data.index import RecordingIndex
from cvcdepth_ros.training_data.sample_choice import first_held_out

_FEWEST_SETS = 2  # the label-free scores from set to set need two


@dataclass(frozen=True)
class HeldOutPart:
    """The last sets of one recording, which are never trained on."""

    job: EvaluationJob
    """The evaluation of the whole part."""
    recording_start: int
    """Log time of the recording's first message, ns."""
    spans: tuple[tuple[int, int], ...]
    """First and last log time of each set, ns."""

    def job_of_sets(self, first: int, count: int) -> EvaluationJob:
        """Return the job of `count` sets from number `first` of the part on."""
        start, stop = self.spans[first][0], max(last for _, last in self.spans[first : first + count]) + 1
        seconds = (start - self.recording_start) / NANOSECONDS
        return replace(self.job, start=seconds, duration=(stop - start) / NANOSECONDS)


def held_out_parts(
    indexes: Sequence[RecordingIndex], config: TrainingConfig, device: str, lidar: tuple[str, ...] | None
) -> list[HeldOutPart]:
    """Return the held-out part of each recording that has one; `lidar` is that of `EvaluationJob`."""
    settings = EvaluationSettings.model_validate(
        {
            "tolerance": config.recordings.tolerance,
            "max_depth": config.evaluation.max_depth,
            "refine": config.evaluation.refine,
            "device": device,
            "backend": "torch_eager",  # the network as it was trained; other engines are checked against it elsewhere
            "threads": torch.get_num_threads(),
        }
    )
    names = unique_names([(index.path.name, str(index.path)) for index in indexes])
    parts = []
    for index, name in zip(indexes, names, strict=True):
        job = EvaluationJob(name, str(index.path), settings, index.layout, lidar=lidar)
        part = _held_out_part(index, job, config)
        if part is not None:
            parts.append(part)
    return parts


def _held_out_part(index: RecordingIndex, job: EvaluationJob, config: TrainingConfig) -> HeldOutPart | None:
    log_times = index.log_times[first_held_out(index, config.recordings.held_out) :]
    if not len(log_times):
        return None
    with open_recording(index.path) as recording:
        start = recording.start
    spans = tuple((int(times.min()), int(times.max())) for times in log_times)
    part = HeldOutPart(job, start, spans)
    return replace(part, job=part.job_of_sets(0, len(spans)))


def validation_jobs(parts: Sequence[HeldOutPart], most: int) -> list[EvaluationJob]:
    """Return jobs of `most` sets in all, or the fewest that can be scored; a run is followed by their scores.

    They are consecutive sets in the middle of each part, or of some of the parts where there are many.
    """
    chosen = [parts[i] for i in np.unique(np.linspace(0, len(parts) - 1, max(1, most // _FEWEST_SETS)).astype(int))]
    share = max(_FEWEST_SETS, most // len(chosen))
    jobs = []
    for part in chosen:
        count = min(share, len(part.spans))
        jobs.append(part.job_of_sets((len(part.spans) - count) // 2, count))
    return jobs


def evaluate_checkpoint(
    jobs: Sequence[EvaluationJob], checkpoint: Path, folder: Path | None = None, label: str = ""
) -> EvaluationResult:
    """Return a checkpoint file's scores; those that are kept in `folder` are not measured again.

    With a `label` there is a progress bar on terminals. Raises RecordingError when no recording can be evaluated.
    """
    settings = jobs[0].settings.model_copy(update={"checkpoint": str(checkpoint)})
    ready = [replace(job, settings=settings) for job in jobs]
    depends_on = settings.dependencies()
    kept = None if folder is None else KeptScores(folder, depends_on)
    with progress_bar(len(jobs), "recordings", label=label, quiet=not label, is_kept=False) as show:
        outcomes = [outcome for _, outcome in evaluate_all(ready, kept=kept, progress=show)]
    return EvaluationResult.from_outcomes(ready, outcomes, depends_on)
