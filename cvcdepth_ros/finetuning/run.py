# SPDX-License-Identifier: Apache-2.0
"""A whole fine-tuning: prepare, score the start, train, judge, promote, and leave the evidence beside the weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from cvcdepth_core.engines import resolve_device
from cvcdepth_core.errors import CheckpointError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.networks.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from cvcdepth_core.training.config import TrainingConfig
from cvcdepth_core.training.distributed import Processes, own_device
from cvcdepth_core.training.model import SurroundModel
from cvcdepth_core.training.run_folder import CHECKPOINT_FILE
from cvcdepth_core.training.starting_model import build_surround_model
from cvcdepth_core.training.trainer import RunObserver, Trainer
from cvcdepth_ros.evaluation.result import EvaluationResult
from cvcdepth_ros.finetuning.held_out import HeldOutPart, evaluate, held_out_parts, some_sets
from cvcdepth_ros.finetuning.judgement import Verdict, judge
from cvcdepth_ros.finetuning.preparation import Prepared, Source, prepare
from cvcdepth_ros.finetuning.provenance import inputs_of
from cvcdepth_ros.finetuning.tensorboard import TensorBoardObserver, has_tensorboard
from cvcdepth_ros.finetuning.validation import CANDIDATE_FILE, HeldOutValidation
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.training_data.samples import RecordingBatches, told_beyond_reach

START_FILE, BEST_FILE = "start.safetensors", "best.safetensors"

_START_KEY = "start"
_SCORES_FOLDER = "scores"

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Order:
    """What is to be done."""

    source: Source
    config: TrainingConfig
    run: Path
    """The run's folder."""
    start: Checkpoint | None
    """Weights to start from; None: random ones."""
    device: str = "auto"
    quiet: bool = False

    @property
    def started_from(self) -> str:
        """What the weights that it starts from are, in words."""
        return "random weights" if self.start is None else f"{self.start.path.name} sha256:{self.start.sha256}"


@dataclass(frozen=True, eq=False)
class FineTuned:
    """What became of it."""

    order: Order
    prepared: Prepared
    trainer: Trainer
    samples: list[int]
    """Training samples of each recording."""
    parts: list[HeldOutPart]
    weights: Path
    """What was judged: the best file where it was promoted, else the candidate, else the last weights."""
    before: EvaluationResult | None
    """Of the whole held-out part; None where nothing is held out."""
    after: EvaluationResult | None
    verdict: Verdict


def fine_tune(order: Order, processes: Processes, tell: Tell) -> FineTuned | None:
    """Do all of it; `tell` is called with what is worth a line meanwhile. None in every process but the first.

    What a former call in the same folder has finished is not done again.
    """
    with processes.first_goes_ahead():
        prepared = prepare(order.source, order.run)
    if processes.is_first:
        _tell_of_losses(prepared, order, tell)
    batches = RecordingBatches(prepared.indexes, order.config, processes)
    model = build_surround_model(order.config, order.start)
    device = own_device(resolve_device(order.device))
    parts = []
    if processes.is_first:
        parts = held_out_parts(prepared.indexes, order.config, str(device), order.source.lidar)
    if parts:
        _keep_start(order, model)  # before the trainer fills the model with what a former call reached
    observers = [TensorBoardObserver(order.run)] if processes.is_first and has_tensorboard() else []
    trainer = _trainer(order, model, batches, parts, processes, observers, inputs_of(prepared, order.started_from))
    if processes.is_first and trainer.progress.step == 0:
        _forget_former_run(order.run)
    before = _scored(order, parts, order.run / START_FILE, "before") if parts else None
    try:
        trainer.train(quiet=order.quiet)
    finally:
        for observer in observers:
            observer.close()
    if not processes.is_first:
        return None
    weights, after, verdict = _judged(order, parts, before)
    samples = [sum(sample.recording == i for sample in batches.reader.samples) for i in range(len(prepared.indexes))]
    return FineTuned(order, prepared, trainer, samples, parts, weights, before, after, verdict)


def _tell_of_losses(prepared: Prepared, order: Order, tell: Tell) -> None:
    """Tell what of the recordings is not trained on, and keep it for the report."""
    for index in prepared.indexes:
        if told := told_beyond_reach(index, order.config.recordings):
            prepared.warnings.append(f"{index.path}: {told}")
    for text in (*(f"left out: {reason}" for reason in prepared.left_out.values()), *prepared.warnings):
        tell(text)


def _trainer(
    order: Order,
    model: SurroundModel,
    batches: RecordingBatches,
    parts: list[HeldOutPart],
    processes: Processes,
    observers: list[TensorBoardObserver],
    inputs: Mapping[str, str],
) -> Trainer:
    config = order.config
    watching: list[RunObserver] = [*observers]
    validation = None
    if parts:
        validation = HeldOutValidation(some_sets(parts, config.evaluation.sets), order.run, config.evaluation.patience)
    return Trainer(
        config,
        model,
        batches,
        order.run,
        own_device(resolve_device(order.device)),
        validation,
        _metadata(order),
        watching,
        processes,
        inputs,
    )


def _metadata(order: Order) -> dict[str, str]:
    config = order.config.model_dump_json()
    return {"version": package_version(), "config": config, _START_KEY: order.started_from}


def _keep_start(order: Order, model: SurroundModel) -> None:
    """Write what the run starts from; CheckpointError when the run in this folder started from other weights."""
    path = order.run / START_FILE
    if not path.exists():
        states = (model.depth_net.state_dict(), model.pose_net.state_dict())
        save_checkpoint(path, order.config.depth, *states, _metadata(order))
    found = load_checkpoint(path).metadata.get(_START_KEY)
    if found != order.started_from:
        raise CheckpointError(f"{order.run}: its run started from {found}, now it is {order.started_from}")


def _forget_former_run(run: Path) -> None:
    """Remove weights that a run left whose state somebody has removed: they may be of other recordings."""
    for name in (BEST_FILE, CANDIDATE_FILE):
        (run / name).unlink(missing_ok=True)


def _scored(order: Order, parts: list[HeldOutPart], weights: Path, when: str) -> EvaluationResult:
    label = "" if order.quiet else f"held-out part, {when}"
    return evaluate([part.job for part in parts], weights, order.run / _SCORES_FOLDER / when, label)


def _judged(
    order: Order, parts: list[HeldOutPart], before: EvaluationResult | None
) -> tuple[Path, EvaluationResult | None, Verdict]:
    """Score the candidate, compare it with the start, and promote it or not."""
    run = order.run
    best, candidate = run / BEST_FILE, run / CANDIDATE_FILE
    if before is None:
        reason = "nothing was proven: no recording has a held-out part (recordings.held_out)"
        return run / CHECKPOINT_FILE, None, Verdict(False, reason)
    weights = candidate if candidate.exists() else run / CHECKPOINT_FILE
    after = _scored(order, parts, weights, "after")
    verdict = judge(before, after)
    if verdict.promoted:
        write_atomically(best, weights.read_bytes())
        return best, after, verdict
    if best.exists():  # of a former call, with fewer epochs: what it proved stays proven
        proven = _scored(order, parts, best, "proven")
        former = judge(before, proven)
        if former.promoted:
            reason = f"{former.reason}; these are weights of a former call, those of this one are {verdict.reason}"
            return best, proven, replace(former, reason=reason)
    return weights, after, verdict
