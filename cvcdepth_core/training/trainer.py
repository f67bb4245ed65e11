# SPDX-License-Identifier: Apache-2.0
"""The training loop: plain torch, one process or several; a run can be killed and resumed at any moment.

Every sample's random draws come from a generator seeded by the configuration's seed, the step's number and the sample's
place in the step, and the batches of an epoch from seed and epoch. So a resumed run computes exactly what an
uninterrupted one does, a checkpoint needs no generator's state, and it does not matter how many processes share a step.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from tqdm import tqdm

from cvcdepth_core.errors import ConfigError, TrainingError
from cvcdepth_core.networks.checkpoint import save_checkpoint
from cvcdepth_core.processor import BFLOAT16, multiplies_bfloat16
from cvcdepth_core.training.augmentation import draw_flips, jitter_colors, zoom_in
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.config import AugmentationConfig, OptimizerConfig, TrainingConfig
from cvcdepth_core.training.distributed import SINGLE_PROCESS, Processes, share_batch_statistics
from cvcdepth_core.training.model import SurroundModel
from cvcdepth_core.training.novel_views import draw_turns
from cvcdepth_core.training.objective import ObjectiveValue, Prediction, evaluate_objective
from cvcdepth_core.training.run_folder import RunFolder, RunIdentity

_MAX_SKIPPED_IN_A_ROW = 20
_LEAST_OF_COSINE = 0.01


@dataclass(frozen=True)
class ValidationOutcome:
    """Result of a validation."""

    scores: Mapping[str, float]
    """Numbers by name, written to the log."""
    stop: bool = False
    """Whether the run ends here, before its configured epochs (early stopping)."""


Validation = Callable[["Trainer"], ValidationOutcome]
"""Scores the trainer's `result`, which is in evaluation mode then; `validations` holds the former results."""


class RunObserver(Protocol):
    """Observer of a run. Its methods are called from the training loop, which waits for them."""

    def on_step(self, trainer: Trainer, entry: Mapping[str, Any]) -> None:
        """Take the log entry of a step."""

    def on_pictures(self, trainer: Trainer, batch: RigBatch, prediction: Prediction) -> None:
        """Take the first sample of a step and its prediction, every `pictures_every` steps."""

    def on_validation(self, trainer: Trainer, entry: Mapping[str, Any]) -> None:
        """Take the log entry of a validation."""


class Batches(Protocol):
    """Source of one process's training batches; their order must depend on the epoch's number only.

    Several processes take the parts of the same batches: sample i of process r's part is sample i * count + r of the
    whole, and all have as many batches.
    """

    @property
    def samples(self) -> int:
        """Samples of one epoch, of all processes together."""

    def epoch(self, number: int, first: int = 0) -> Iterator[RigBatch | None]:
        """Yield the batches of an epoch from number `first` on; None for one that could not be read."""


class RehearsedBatch(NamedTuple):
    """What one process takes of some consecutive samples of a step's rehearsal."""

    first: int
    """The number of the first of these samples among all of the step's rehearsal."""
    batch: RigBatch | None
    """Sample i of process r's part is sample i * count + r of them; None where none could be read."""


class Rehearsal(Protocol):
    """Samples of another kind that every step learns from too, so that what they taught is not forgotten."""

    @property
    def name(self) -> str:
        """What is put before the names of its terms in the log."""

    @property
    def weight(self) -> float:
        """How much one of its samples counts in a step; one of `Batches` counts 1."""

    def of_step(self, number: int) -> Iterator[RehearsedBatch]:
        """Yield the samples of a step, which depend on its number only; as many batches in every process."""


class _Part(NamedTuple):
    """A batch of a step."""

    batch: RigBatch
    first: int
    """The place in the step, over all processes, of its first sample."""
    weight: float = 1.0
    """Of each of its samples."""
    kind: str = ""
    """The rehearsal's name, where it is of that."""


@dataclass
class Progress:
    """Progress of a run."""

    epoch: int = 0
    """Completed epochs."""
    batch: int = 0
    """Completed batches of the current epoch."""
    step: int = 0
    """Optimiser steps, including skipped ones."""
    skipped: int = 0
    """Steps skipped because loss or gradient was not finite."""
    unreadable: int = 0
    """Batches none of whose samples could be read."""
    stopped: bool = False
    """Whether a validation has ended the run."""


class Trainer:
    """Trains a model on batches into a run folder; resumes from the folder's last state."""

    def __init__(
        self,
        config: TrainingConfig,
        model: SurroundModel,
        batches: Batches,
        run_directory: Path,
        device: torch.device | str = "cpu",
        validate: Validation | None = None,
        metadata: Mapping[str, str] | None = None,
        observers: Sequence[RunObserver] = (),
        processes: Processes = SINGLE_PROCESS,
        inputs: Mapping[str, str] | None = None,
        rehearsal: Rehearsal | None = None,
    ) -> None:
        """`metadata` is stored in the checkpoints. Of several `processes`, only the first validates and writes.

        `inputs` identify what a run depends on beside its configuration; it is resumed only with the same ones.
        Every step learns from its share of `rehearsal` too.
        Raises CheckpointError when the folder holds another run, ConfigError when the processes cannot share a step,
        TrainingError when they have not found the same samples.
        """
        _refuse_uneven_shares(config, processes)
        _refuse_different_samples(batches.samples, processes)
        self.config = config
        self.progress = Progress()
        self.validations: list[dict[str, Any]] = []
        """Log entries of all validations."""
        self._device = torch.device(device)
        self.model = _prepared(model, self._device, processes)
        self._batches = batches
        self._rehearsal = rehearsal
        self._processes = processes
        self._validate = validate
        self._observers = tuple(observers) if processes.is_first else ()
        self._metadata = dict(metadata or {})
        self._inputs: dict[str, str] = json.loads(
            processes.broadcast_from_first(json.dumps(dict(inputs or {})).encode())
        )
        self._folder = RunFolder(run_directory)
        self._optimizer = torch.optim.AdamW(
            _parameter_groups(self.model, config.optimizer),
            lr=config.optimizer.learning_rate,
            betas=config.optimizer.betas,
            fused=True,
            weight_decay=config.optimizer.weight_decay,
        )
        self._average = _averaged(self.model, config.optimizer.average_decay)
        self._skipped_in_a_row = 0
        if config.optimizer.compile:
            _compile(self.model)
        self.autocast = self._processes.broadcast_from_first(_autocast(config, self._device).encode()).decode()
        """`none` or `bfloat16`: the precision of the networks."""
        if processes.is_first:
            self._folder.create()
        self._resume()
        _refuse_slow_bfloat16(self.autocast, self._device)

    @property
    def result(self) -> SurroundModel:
        """The model that is validated and saved: the weights' average, or the weights where none is kept."""
        return self.model if self._average is None else cast(SurroundModel, self._average.module)

    def train(self, quiet: bool = False) -> None:
        """Train to the configured number of epochs or until a validation ends the run; it then stays ended.

        Raises TrainingError when the loss stays non-finite.
        """
        if self._processes.is_first:
            self._folder.write_config(self.config)
        epochs = self.config.optimizer.epochs
        if self.progress.step == 0 and not self.validations:
            self._score()
            self.save()
        total, hidden = epochs * self._batches.samples, True if quiet or not self._processes.is_first else None
        with tqdm(total=total, initial=self._samples_done, unit="sample", disable=hidden) as bar:
            while self.progress.epoch < epochs and not self.progress.stopped:
                self._train_epoch(bar)
                if self.progress.epoch % self.config.validate_every == 0 or self.progress.epoch == epochs:
                    self._score()
                self.save()

    def save(self) -> None:
        """Write the state to resume from, then the checkpoint; each appears complete or not at all."""
        if not self._processes.is_first:
            return
        self._folder.write_state(
            {
                **self._identity.to_state(),
                "progress": asdict(self.progress),
                "validations": json.dumps(self.validations),
                "autocast": self.autocast,
                "model": self.model.state_dict(),
                "average": None if self._average is None else self._average.state_dict(),
                "optimizer": self._optimizer.state_dict(),
            }
        )
        self.save_result(self._folder.checkpoint)

    def save_result(self, path: Path) -> None:
        """Write `result` as a checkpoint."""
        save_checkpoint(
            path,
            self.config.depth,
            self.result.depth_net.state_dict(),
            self.result.pose_net.state_dict(),
            {**self._metadata, "step": str(self.progress.step), "epoch": str(self.progress.epoch)},
        )

    @property
    def _identity(self) -> RunIdentity:
        return RunIdentity(self.config, self._batches.samples, self._samples_together, self._inputs)

    @property
    def _samples_together(self) -> int:
        """Samples that go through the networks of all processes together, sharing batch statistics."""
        return self.config.optimizer.samples_per_batch * self._processes.count

    @property
    def _samples_done(self) -> int:
        """Samples of this and the former epochs that went into steps."""
        samples = self._batches.samples
        return self.progress.epoch * samples + min(self.progress.batch * self._samples_together, samples)

    def _resume(self) -> None:
        content = self._processes.broadcast_from_first(self._folder.read_state() if self._processes.is_first else b"")
        if content:
            state = self._folder.state_from(content)
            self._identity.refuse_other(state, self._folder.state)
            self.progress = Progress(**state["progress"])
            self.validations = json.loads(state["validations"])
            self.autocast = state.get("autocast", self.autocast)
            self.model.load_state_dict(state["model"])
            self._optimizer.load_state_dict(state["optimizer"])
            if self._average is not None:
                self._average.load_state_dict(state["average"])
        if self._processes.is_first:
            self._folder.drop_remains(self.progress.step, self.validations)

    def _train_epoch(self, bar: tqdm[Any]) -> None:
        optimizer = self.config.optimizer
        batches = self._batches.epoch(self.progress.epoch, self.progress.batch)
        length = optimizer.samples_per_step // self._samples_together
        self.model.train()
        while True:
            began = time.perf_counter()
            if not (batches_of_step := list(islice(batches, length))):
                break
            self._set_learning_rates()
            entry = {"seconds_waiting": round(time.perf_counter() - began, 4), **self._step(batches_of_step)}
            entry["seconds"] = round(time.perf_counter() - began, 4)
            self.progress.batch += len(batches_of_step)
            self._log(entry)
            for observer in self._observers:
                observer.on_step(self, entry)
            bar.update(self._samples_done - bar.n)
            bar.set_postfix(loss=entry["loss"], skipped=self.progress.skipped)
            if self.progress.step % self.config.checkpoint_every == 0:
                self.save()
        self.progress.epoch += 1
        self.progress.batch = 0

    def _set_learning_rates(self) -> None:
        optimizer = self.config.optimizer
        rate = optimizer.learning_rate * min(1.0, (self.progress.step + 1) / max(1, optimizer.warm_up))
        if optimizer.schedule == "cosine":
            done = self._samples_done / (optimizer.epochs * self._batches.samples)
            rate *= max(_LEAST_OF_COSINE, 0.5 + 0.5 * math.cos(math.pi * done))
        else:
            rate *= optimizer.decay_factor ** (self.progress.epoch // optimizer.decay_after_epochs)
        for group, share in zip(self._optimizer.param_groups, (1.0, optimizer.encoder_rate), strict=False):
            group["lr"] = rate * share

    def _step(self, batches: Sequence[RigBatch | None]) -> dict[str, Any]:
        """Make one optimiser step of several batches; return its log entry."""
        self.progress.step += 1
        parts = self._readable_parts(batches)
        self._optimizer.zero_grad(set_to_none=True)
        values = [self._backpropagate(part._replace(batch=part.batch.to(self._device))) for part in parts]
        samples, weight, loss, terms = self._means(parts, values)
        norm = self._mean_gradient_norm(weight)
        self._update_weights(math.isfinite(loss) and math.isfinite(norm) and weight > 0)
        return {
            "step": self.progress.step,
            "epoch": self.progress.epoch,
            "samples": samples,
            "loss": loss,
            "terms": terms,
            "gradient_norm": norm,
            "learning_rate": self._optimizer.param_groups[0]["lr"],
            "autocast": self.autocast,
            "skipped": self.progress.skipped,
        }

    def _readable_parts(self, batches: Sequence[RigBatch | None]) -> list[_Part]:
        """Return the step's batches of which every process could read something, and count the others."""
        rehearsed = [] if self._rehearsal is None else list(self._rehearsal.of_step(self.progress.step))
        readable = self._readable_by_all([*batches, *(one.batch for one in rehearsed)])
        self.progress.unreadable += len(batches) + len(rehearsed) - len(readable)
        parts = []
        for place, batch in readable.items():
            if place < len(batches) or self._rehearsal is None:
                parts.append(_Part(batch, place * self._samples_together))
            else:
                first = self.config.optimizer.samples_per_step + rehearsed[place - len(batches)].first
                parts.append(_Part(batch, first, self._rehearsal.weight, self._rehearsal.name))
        return parts

    def _readable_by_all(self, batches: Sequence[RigBatch | None]) -> dict[int, RigBatch]:
        """Return the batches, by their place, of which every process could read something.

        The processes have to go through the networks as often, or they would wait for each other's statistics for ever.
        """
        missing = torch.tensor([float(batch is None) for batch in batches], device=self._device)
        somewhere = self._processes.sum_over_processes(missing).tolist()
        return {place: batch for place, batch in enumerate(batches) if batch is not None and not somewhere[place]}

    def _backpropagate(self, part: _Part) -> ObjectiveValue:
        """Add the gradients of the batch's samples, summed, not averaged: the last batch of an epoch may be smaller."""
        config, batch, processes = self.config, part.batch, self._processes
        places = range(processes.rank, processes.count * len(batch.frames), processes.count)
        generators = [_generator(config.seed, self.progress.step, part.first + sample) for sample in places]
        if not part.kind:
            batch = zoom_in(batch, config.augmentation.zoom, generators)
        seen, depth_flips, pose_flips = _augment(batch, config.augmentation, generators)
        with torch.autocast(self._device.type, torch.bfloat16, self.autocast == "bfloat16"):
            prediction = self.model(batch, seen, depth_flips, pose_flips, self._turns(batch, generators))
        value = evaluate_objective(batch, prediction, config.objective, _identity_noise(batch, generators))
        (part.weight * value.per_sample.sum()).backward()  # type: ignore[no-untyped-call]
        if part.first == 0 and (self.progress.step - 1) % config.pictures_every == 0:
            for observer in self._observers:
                observer.on_pictures(self, batch.first_sample(), prediction.first_sample())
        return ObjectiveValue(value.per_sample.detach(), {name: term.detach() for name, term in value.terms.items()})

    def _turns(self, batch: RigBatch, generators: Sequence[torch.Generator]) -> Tensor | None:
        """Draw how far the cameras of novel views are turned, where there are any."""
        if not self.config.objective.synthesises:
            return None
        return draw_turns(self.config.synthesis, batch.cameras, generators).to(batch.frames)

    def _means(
        self, parts: Sequence[_Part], values: Sequence[ObjectiveValue]
    ) -> tuple[int, float, float, dict[str, float]]:
        """Return the number of samples of all processes, without the rehearsal's, and the weight of all.

        Also their mean loss and the means of its terms.
        """
        if not values:
            return 0, 0.0, 0.0, {}
        zero = torch.zeros(2, dtype=torch.float64, device=self._device)
        sums = {"samples": zero, "loss": zero}
        for part, value in zip(parts, values, strict=True):
            weights = torch.full_like(value.per_sample, part.weight)
            if not part.kind:
                sums["samples"] = sums["samples"] + len(weights)
            sums["loss"] = sums["loss"] + _sum_and_weight(value.per_sample, weights)
            for name, term in value.terms.items():  # a term may be there for some recordings only
                told = f"{part.kind}_{name}" if part.kind else name
                sums[f"terms {told}"] = sums.get(f"terms {told}", zero) + _sum_and_weight(term, torch.ones_like(term))
        totals, counts = self._processes.sum_over_processes(torch.stack(list(sums.values()))).unbind(1)
        means = dict(zip(sums, (totals / counts).tolist(), strict=True))
        terms = {name.removeprefix("terms "): mean for name, mean in means.items() if name.startswith("terms ")}
        return int(counts[0]), float(counts[1]), means["loss"], terms

    def _mean_gradient_norm(self, weight: float) -> float:
        """Turn the gradients' sum into the mean of all processes and shorten it if configured; return its length."""
        self._processes.sum_gradients_over_processes(list(self.model.parameters()))
        for parameter in self.model.parameters():
            if parameter.grad is not None and weight not in (0.0, 1.0):
                parameter.grad /= weight
        limit = self.config.optimizer.max_gradient_norm or math.inf
        return float(nn.utils.clip_grad_norm_(self.model.parameters(), limit))

    def _update_weights(self, is_usable: bool) -> None:
        if is_usable:
            self._optimizer.step()
            if self._average is not None:
                self._average.update_parameters(self.model)
            self._skipped_in_a_row = 0
            return
        self.progress.skipped += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= _MAX_SKIPPED_IN_A_ROW:
            raise TrainingError(
                f"step {self.progress.step}: loss or gradient is not finite, or no sample could be read, for "
                f"{_MAX_SKIPPED_IN_A_ROW} steps in a row; {self._folder.checkpoint} is the last good checkpoint"
            )

    def _score(self) -> None:
        if self._validate is None:
            return
        scores = self._scores(self._validate) if self._processes.is_first else b""
        entry = json.loads(self._processes.broadcast_from_first(scores))
        self.progress.stopped = entry["stop"]
        self.validations.append(entry)
        self._log(entry)
        for observer in self._observers:
            observer.on_validation(self, entry)

    def _scores(self, validate: Validation) -> bytes:
        """Validate; return the log entry as JSON."""
        was_training = self.result.training
        self.result.eval()
        with torch.inference_mode():
            outcome = validate(self)
        self.result.train(was_training)
        place = {"step": self.progress.step, "epoch": self.progress.epoch}
        return json.dumps({**place, "validation": dict(outcome.scores), "stop": outcome.stop}).encode()

    def _log(self, entry: Mapping[str, Any]) -> None:
        if self._processes.is_first:
            self._folder.append_to_log(entry)


def _prepared(model: SurroundModel, device: torch.device, processes: Processes) -> SurroundModel:
    # On CPUs, channels-last makes a step of the networks a fifth to a third shorter.
    model = model.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return model if processes.count == 1 else cast(SurroundModel, share_batch_statistics(model, device))


def _parameter_groups(model: SurroundModel, config: OptimizerConfig) -> list[dict[str, Any]]:
    """Return all parameters as one group; or the encoders', which learn at another rate, as a second one."""
    if config.encoder_rate == 1.0:
        return [{"params": list(model.parameters())}]
    groups: tuple[list[nn.Parameter], list[nn.Parameter]] = ([], [])
    for name, parameter in model.named_parameters():
        groups["_encoder." in name].append(parameter)
    return [{"params": group} for group in groups]


def _refuse_uneven_shares(config: TrainingConfig, processes: Processes) -> None:
    together, step = config.optimizer.samples_per_batch * processes.count, config.optimizer.samples_per_step
    if step % together:
        raise ConfigError(
            f"optimizer.samples_per_step is {step}, expected a multiple of {together}: samples_per_batch "
            f"({config.optimizer.samples_per_batch}) x {processes.count} processes"
        )


def _refuse_different_samples(samples: int, processes: Processes) -> None:
    first = int(processes.broadcast_from_first(str(samples).encode()))
    if samples != first:
        raise TrainingError(
            f"process {processes.rank} has {samples} samples, the first has {first}: the machines do not have the same "
            "recordings"
        )


def _autocast(config: TrainingConfig, device: torch.device) -> str:
    """Return what a run that begins here takes."""
    if config.optimizer.autocast != "auto":
        return config.optimizer.autocast
    return "bfloat16" if device.type == "cpu" and multiplies_bfloat16() else "none"


def _refuse_slow_bfloat16(autocast: str, device: torch.device) -> None:
    if autocast == "bfloat16" and device.type == "cpu" and not multiplies_bfloat16():
        raise ConfigError(
            "optimizer.autocast is bfloat16, or auto and the run began with it, but this CPU does not multiply "
            f"bfloat16 (no {' or '.join(BFLOAT16)}) and would be slow; go on where one does, or begin anew with none"
        )


def _compile(model: SurroundModel) -> None:
    """Have torch translate the networks, not the objective, which is many small operations."""
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler) is None:
        raise ConfigError(
            f"optimizer.compile is true, but torch.compile needs a C++ compiler and {compiler!r} is not there; install "
            "g++, name another in the environment variable CXX, or leave compile off"
        )
    model.depth_net.compile()
    model.pose_net.compile()


def _generator(seed: int, step: int, place: int) -> torch.Generator:
    """Return the generator of the sample at `place` of a step."""
    state = np.random.SeedSequence([seed, step, place]).generate_state(1)
    return torch.Generator().manual_seed(int(state[0]))


def _augment(
    batch: RigBatch, config: AugmentationConfig, generators: Sequence[torch.Generator]
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw what the networks see: jittered frames, and which samples each network sees mirrored."""
    seen = jitter_colors(batch.frames, config.color_jitter, generators)
    flips = draw_flips(generators).to(batch.frames.device)
    none = torch.zeros_like(flips)
    depth_flips = flips if config.flip in ("depth", "both") else none
    return seen, depth_flips, flips if config.flip in ("pose", "both") else none


def _sum_and_weight(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted sum of values and the sum of their weights, float64 [2]."""
    values, weights = values.double(), weights.double()
    return torch.stack([(values * weights).sum(), weights.sum()])


def _identity_noise(batch: RigBatch, generators: Sequence[torch.Generator]) -> Tensor:
    """Draw the objective's noise on the batch's device, where there may be much to draw."""
    contexts = batch.contexts[:, :, :, :1]
    noise = torch.empty_like(contexts)
    for sample, generator in zip(noise, generators, strict=True):
        seed = int(torch.randint(2**31, (), generator=generator))
        sample.normal_(generator=torch.Generator(noise.device).manual_seed(seed))
    return noise


def _averaged(model: SurroundModel, decay: float | None) -> AveragedModel | None:
    """Return the moving average of the weights; while it is young it forgets faster, so as not to keep the start."""
    if decay is None:
        return None

    def update(average: Tensor, current: Tensor, updates: Tensor | int) -> Tensor:
        young = (1 + int(updates)) / (10 + int(updates))
        return torch.lerp(average, current, 1 - min(decay, young))

    return AveragedModel(model, avg_fn=update)
