# SPDX-License-Identifier: Apache-2.0
"""A whole fine-tuning: prepare, score the start, train, judge, promote."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cvcdepth_core.engines import resolve_device
from cvcdepth_core.errors import CheckpointError, RecordingError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.networks.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from cvcdepth_core.training.config import RecordingsConfig, TrainingConfig
from cvcdepth_core.training.distributed import Processes, own_device
from cvcdepth_core.training.model import SurroundModel
from cvcdepth_core.training.pose_network import TRUSTED_RATIOS
from cvcdepth_core.training.run_folder import CHECKPOINT_FILE
from cvcdepth_core.training.starting_model import build_surround_model
from cvcdepth_core.training.trainer import RunObserver, Trainer
from cvcdepth_ros.evaluation.result import EvaluationResult
from cvcdepth_ros.evaluation.trained_on import TrainedPart, to_metadata, trained_parts
from cvcdepth_ros.finetuning.general import General, open_general
from cvcdepth_ros.finetuning.held_out import HeldOutPart, evaluate_checkpoint, held_out_parts, validation_jobs
from cvcdepth_ros.finetuning.judgement import Verdict, judge
from cvcdepth_ros.finetuning.preparation import Prepared, Source, prepare
from cvcdepth_ros.finetuning.provenance import inputs_of, trained_on
from cvcdepth_ros.finetuning.tensorboard import TensorBoardObserver, has_tensorboard
from cvcdepth_ros.finetuning.validation import CANDIDATE_FILE, HeldOutValidation
from cvcdepth_ros.finetuning.world_scores import NOT_TOLD, WorldVerdict, compare_worlds
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.training_data.loader import RecordingBatches
from cvcdepth_ros.training_data.sample_choice import describe_skipped_samples, describe_unprovable, held_out_sets

START_FILE, BEST_FILE = "start.safetensors", "best.safetensors"

_START_KEY, _WORLDS_KEY = "start", "worlds"
_SCORES_FOLDER = "scores"


@dataclass(frozen=True)
class FinetuneJob:
    """What to train on, how, and from which weights."""

    source: Source
    config: TrainingConfig
    run: Path
    """The run's folder."""
    start: Checkpoint | None
    """Weights to start from; None: random ones."""
    device: str = "auto"
    quiet: bool = False
    with_promotion: bool = True
    """Whether `best.safetensors` is wanted: then a run is refused that could not prove its weights to be better."""
    shards: Sequence[Path] = ()
    """Shards of simulated drives that are learnt from and scored too, by `config.worlds`."""

    @property
    def started_from(self) -> str:
        """The start's file name and hash, or `random weights`."""
        return "random weights" if self.start is None else f"{self.start.path.name} sha256:{self.start.sha256}"


@dataclass(frozen=True, eq=False)
class FinetuneResult:
    """The weights of a finished run, and the evidence for and against them."""

    job: FinetuneJob
    prepared: Prepared
    trainer: Trainer
    samples: list[int]
    """Training samples of each recording."""
    parts: list[HeldOutPart]
    weights: Path
    """The file that was judged: the best one where it was promoted, else the candidate, else the last weights."""
    before: EvaluationResult | None
    """The start's scores on the whole held-out part; None where nothing is held out."""
    after: EvaluationResult | None
    """The weights' scores there."""
    verdict: Verdict
    general: General | None = None
    """The worlds that were learned from too."""
    on_worlds: WorldVerdict | None = None
    """What happened to the depth of held-out worlds."""


def fine_tune(job: FinetuneJob, processes: Processes, warn: Callable[[str], None]) -> FinetuneResult | None:
    """Train and judge, in one of `processes`; the result is None in every process but the first.

    `warn` is called with a line about each loss: recordings, sets and samples that are not trained on. What a former
    call in the same folder has finished is not done again.
    """
    with processes.first_process_first():
        prepared = prepare(job.source, job.run)
    if processes.is_first:
        _warn_of_losses(prepared, job, warn)
    batches = RecordingBatches(prepared.indexes, job.config, processes, job.source.lidar)
    general = open_general(job.shards, batches, job.config, processes)
    if job.with_promotion:
        _refuse_unprovable(prepared, job.config.recordings)
    model = build_surround_model(job.config, job.start)
    device = own_device(resolve_device(job.device))
    parts = []
    if processes.is_first:
        parts = held_out_parts(prepared.indexes, job.config, str(device), job.source.lidar)
    if processes.is_first and (parts or general):
        _keep_start(job, model)  # before the trainer fills the model with what a former call reached
    observers = [TensorBoardObserver(job.run)] if processes.is_first and has_tensorboard() else []
    trainer = _trainer(job, model, batches, parts, processes, observers, prepared, general)
    if processes.is_first and trainer.progress.step == 0:
        _forget_former_run(job.run)
    before = _evaluated(job, parts, job.run / START_FILE, "before") if parts else None
    if before is not None:
        _warn_of_pose_network(before, "the start's", prepared, warn)
    try:
        trainer.train(quiet=job.quiet)
    finally:
        for observer in observers:
            observer.close()
    if not processes.is_first:
        return None
    weights, after, verdict = _judged(job, parts, before)
    if after is not None:
        _warn_of_pose_network(after, "the trained", prepared, warn)
    on_worlds = _judged_on_worlds(job, general, weights, prepared, warn)
    samples = [sum(sample.recording == i for sample in batches.targets) for i in range(len(prepared.indexes))]
    return FinetuneResult(job, prepared, trainer, samples, parts, weights, before, after, verdict, general, on_worlds)


def _judged_on_worlds(
    job: FinetuneJob, general: General | None, weights: Path, prepared: Prepared, warn: Callable[[str], None]
) -> WorldVerdict | None:
    """Compare start and weights on all held-out worlds; warn, and keep the warning, where something is forgotten."""
    scores = None if general is None else general.scores(own_device(resolve_device(job.device)))
    if scores is None:
        return None
    found = compare_worlds(scores, scores.of_file(job.run / START_FILE), scores.of_file(weights))
    if found.is_worse:
        text = f"the weights are {found.describe()}; a larger worlds.share (--keep-general) forgets less"
        prepared.warnings.append(text)
        warn(text)
    return found


def _warn_of_losses(prepared: Prepared, job: FinetuneJob, warn: Callable[[str], None]) -> None:
    """Warn of what is not trained on, and keep the warnings for the report."""
    for index in prepared.indexes:
        if told := describe_skipped_samples(index, job.config.recordings):
            prepared.warnings.append(f"{index.path}: {told}")
    if job.shards and not job.config.depth.is_told_its_rig:
        prepared.warnings.append(NOT_TOLD)
    for text in (*(f"left out: {reason}" for reason in prepared.left_out.values()), *prepared.warnings):
        warn(text)


def _refuse_unprovable(prepared: Prepared, config: RecordingsConfig) -> None:
    """Raise RecordingError, with the counts, where the held-out parts are too small for any verdict."""
    counts = {str(index.path): held_out_sets(index, config) for index in prepared.indexes}
    if told := describe_unprovable(sum(counts.values())):
        by_recording = ", ".join(f"{count} of {path}" for path, count in counts.items())
        raise RecordingError(
            f"{told} ({by_recording}; recordings.held_out is {config.held_out:g}): take longer or more recordings, "
            "hold more out, or train without a verdict, by --no-promotion"
        )


def _warn_of_pose_network(
    scored: EvaluationResult, whose: str, prepared: Prepared, warn: Callable[[str], None]
) -> None:
    """Warn of a pose network that the recorded motion contradicts, and keep the warning for the report."""
    score = scored.pose_score
    if score is None or score.is_trusted:
        return
    least, greatest = TRUSTED_RATIOS
    text = f"{whose} pose network tells {score.describe()}; {least} to {greatest} of the way is right"
    prepared.warnings.append(text)
    warn(text)


def _trainer(
    job: FinetuneJob,
    model: SurroundModel,
    batches: RecordingBatches,
    parts: list[HeldOutPart],
    processes: Processes,
    observers: list[TensorBoardObserver],
    prepared: Prepared,
    general: General | None,
) -> Trainer:
    config = job.config
    learned_from = trained_on(prepared, config.recordings.held_out, job.start)
    watching: list[RunObserver] = [*observers]
    device = own_device(resolve_device(job.device))
    validation = None
    if parts:
        jobs = validation_jobs(parts, config.evaluation.sets)
        worlds = None if general is None else general.scores(device, config.evaluation.sets)
        validation = HeldOutValidation(jobs, job.run, config.evaluation.patience, worlds)
    return Trainer(
        config,
        model,
        batches,
        job.run,
        device,
        validation,
        _metadata(job, learned_from) | ({} if general is None else {_WORLDS_KEY: json.dumps(general.to_json())}),
        watching,
        processes,
        inputs_of(prepared, job.started_from) | ({} if general is None else {"the worlds": general.identity}),
        None if general is None else general.rehearsal,
    )


def _metadata(job: FinetuneJob, learned_from: Sequence[TrainedPart]) -> dict[str, str]:
    config = job.config.model_dump_json()
    described = {"version": package_version(), "config": config, _START_KEY: job.started_from}
    return described | to_metadata(learned_from)


def _keep_start(job: FinetuneJob, model: SurroundModel) -> None:
    """Write the weights that the run starts from; CheckpointError when the folder's run started from others."""
    path = job.run / START_FILE
    if not path.exists():
        states = (model.depth_net.state_dict(), model.pose_net.state_dict())
        save_checkpoint(path, job.config.depth, *states, _metadata(job, trained_parts(job.start)))
    found = load_checkpoint(path).metadata.get(_START_KEY)
    if found != job.started_from:
        raise CheckpointError(f"{job.run}: its run started from {found}, now it is {job.started_from}")


def _forget_former_run(run: Path) -> None:
    """Remove weights that a run left whose state somebody has removed: they may be of other recordings."""
    for name in (BEST_FILE, CANDIDATE_FILE):
        (run / name).unlink(missing_ok=True)


def _evaluated(job: FinetuneJob, parts: list[HeldOutPart], weights: Path, when: str) -> EvaluationResult:
    label = "" if job.quiet else f"held-out part, {when}"
    return evaluate_checkpoint([part.job for part in parts], weights, job.run / _SCORES_FOLDER / when, label)


def _judged(
    job: FinetuneJob, parts: list[HeldOutPart], before: EvaluationResult | None
) -> tuple[Path, EvaluationResult | None, Verdict]:
    """Return the judged weights, their scores and the verdict; promoted weights are written as `BEST_FILE`."""
    run = job.run
    best, candidate = run / BEST_FILE, run / CANDIDATE_FILE
    if before is None:
        reason = "nothing was proven: no recording has a held-out part (recordings.held_out)"
        return run / CHECKPOINT_FILE, None, Verdict(False, reason)
    weights = candidate if candidate.exists() else run / CHECKPOINT_FILE
    after = _evaluated(job, parts, weights, "after")
    verdict = judge(before, after)
    if not job.with_promotion:
        return weights, after, replace(verdict, promoted=False, reason=f"no promotion is wanted; {verdict.reason}")
    if verdict.promoted:
        write_atomically(best, weights.read_bytes())
        return best, after, verdict
    if best.exists():  # of a former call, with fewer epochs: what it proved stays proven
        proven = _evaluated(job, parts, best, "proven")
        former = judge(before, proven)
        if former.promoted:
            reason = f"{former.reason}; these are weights of a former call, those of this one are {verdict.reason}"
            return best, proven, replace(former, reason=reason)
    return weights, after, verdict
