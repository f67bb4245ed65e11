# SPDX-License-Identifier: Apache-2.0
"""The training loop: plain torch, one process, a run folder that survives being killed at any moment.

Every random draw of a step comes from a generator seeded by the configuration's seed and the step's number, and the
batches of an epoch from seed and epoch. So a resumed run computes exactly what an uninterrupted one does, and a
checkpoint needs no generator's state.
"""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, cast

import torch
import yaml
from pydantic import ValidationError
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from tqdm import tqdm

from cvcdepth_core.atomic_file import write_atomically
from cvcdepth_core.augmentation import draw_flips, jitter_colors
from cvcdepth_core.checkpoint import Checkpoint, load_network_state, save_checkpoint
from cvcdepth_core.errors import CheckpointError, TrainingError
from cvcdepth_core.networks import DepthNet, PoseNet
from cvcdepth_core.objective import ObjectiveValue, Prediction, evaluate_objective
from cvcdepth_core.rig_batch import RigBatch
from cvcdepth_core.surround_model import SurroundModel
from cvcdepth_core.training_config import AugmentationConfig, TrainingConfig

CHECKPOINT_FILE, STATE_FILE, LOG_FILE, CONFIG_FILE = "last.safetensors", "state.pt", "log.jsonl", "config.yaml"

_MAX_SKIPPED_IN_A_ROW = 20


@dataclass(frozen=True)
class ValidationOutcome:
    """What a validation found."""

    scores: Mapping[str, float]
    """They go to the log."""
    stop: bool = False
    """Whether the run ends here, before its configured epochs (early stopping)."""


Validation = Callable[["Trainer"], ValidationOutcome]
"""Scores the trainer's `result`, then in evaluation mode; its `validations` tell what was found before."""


class RunObserver(Protocol):
    """Is told what a run does while it does it; what it takes long for, the run waits for."""

    def on_step(self, trainer: Trainer, entry: Mapping[str, Any]) -> None:
        """Take what was logged of a step."""

    def on_pictures(self, trainer: Trainer, batch: RigBatch, prediction: Prediction) -> None:
        """Take the first sample of a step and what the networks said of it, every `pictures_every` steps."""

    def on_validation(self, trainer: Trainer, entry: Mapping[str, Any]) -> None:
        """Take what was logged of a validation."""


class Batches(Protocol):
    """Where training batches come from; their order must depend on the epoch's number only."""

    @property
    def samples(self) -> int:
        """Samples of one epoch."""

    def epoch(self, number: int, first: int = 0) -> Iterator[RigBatch | None]:
        """Give the batches of an epoch from the `first` on; None for one that could not be read."""


@dataclass
class Progress:
    """How far a run is."""

    epoch: int = 0
    """Epochs that are complete."""
    batch: int = 0
    """Batches that are done of the epoch in work."""
    step: int = 0
    """Optimiser steps, skipped ones too."""
    skipped: int = 0
    """Steps that were left out since their loss or gradient was not finite."""
    unreadable: int = 0
    """Batches none of whose samples could be read."""
    stopped: bool = False
    """Whether a validation has ended the run."""


def build_surround_model(config: TrainingConfig, start: Checkpoint | None = None) -> SurroundModel:
    """Return both networks of `config` with random weights by its seed, or with those of `start`.

    A checkpoint without a pose network leaves that random. Raises CheckpointError, naming the values, when `start` was
    built for another encoder or depth range: its disparities would mean other depths.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        depth_net, pose_net = DepthNet(config.depth.encoder), PoseNet(config.pose.encoder)
    if start is not None:
        _refuse_other_meaning(start, config)
        load_network_state(depth_net, start.depth_net, origin=f"{start.path}: depth network")
        if start.pose_net:
            load_network_state(pose_net, start.pose_net, origin=f"{start.path}: pose network")
    return SurroundModel(
        depth_net,
        pose_net,
        min_depth=config.depth.min_depth,
        max_depth=config.depth.max_depth,
        focal_scale=config.depth.focal_scale,
        pose_method=config.pose.method,
    )


def _refuse_other_meaning(start: Checkpoint, config: TrainingConfig) -> None:
    for name in ("encoder", "min_depth", "max_depth", "focal_scale"):
        found, want = getattr(start.spec, name), getattr(config.depth, name)
        if found != want:
            raise CheckpointError(f"{start.path}: {name} is {found}, but the configuration's depth.{name} is {want}")


class Trainer:
    """Trains a model on batches into a run folder, from where the folder's last checkpoint stands."""

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
    ) -> None:
        """`metadata` travels in the checkpoints. Raises CheckpointError when the folder holds another run."""
        self.config = config
        self.progress = Progress()
        self.validations: list[dict[str, Any]] = []
        """What was logged of every validation."""
        # On CPUs, channels-last makes a step of the networks a fifth to a third shorter.
        self.model = model.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._batches = batches
        self._device = torch.device(device)
        self._validate = validate
        self._observers = tuple(observers)
        self._metadata = dict(metadata or {})
        self._run = run_directory
        self._optimizer = torch.optim.AdamW(
            self.model.parameters(),
            lr=config.optimizer.learning_rate,
            betas=config.optimizer.betas,
            fused=True,
            weight_decay=config.optimizer.weight_decay,
        )
        self._average = _averaged(self.model, config.optimizer.average_decay)
        self._skipped_in_a_row = 0
        self._run.mkdir(parents=True, exist_ok=True)
        self._resume()

    @property
    def result(self) -> SurroundModel:
        """The model that is validated and saved: the weights' average, or the weights where none is kept."""
        return self.model if self._average is None else cast(SurroundModel, self._average.module)

    def train(self, quiet: bool = False) -> None:
        """Train to the configured number of epochs or until a validation ends the run; it then stays ended.

        Raises TrainingError when the loss stays non-finite.
        """
        (self._run / CONFIG_FILE).write_text(yaml.safe_dump(self.config.model_dump(mode="json"), sort_keys=False))
        samples, epochs = self._batches.samples, self.config.optimizer.epochs
        if self.progress.step == 0 and not self.validations:
            self._score()
            self.save()
        done = self.progress.epoch * samples + self.progress.batch * self.config.optimizer.samples_per_batch
        with tqdm(total=epochs * samples, initial=done, unit="sample", disable=True if quiet else None) as bar:
            while self.progress.epoch < epochs and not self.progress.stopped:
                self._train_epoch(bar)
                if self.progress.epoch % self.config.validate_every == 0 or self.progress.epoch == epochs:
                    self._score()
                self.save()

    def save(self) -> None:
        """Write what resuming needs, then the checkpoint; each appears complete or not at all."""
        state = {
            "config": self.config.model_dump_json(),
            "samples": self._batches.samples,
            "progress": asdict(self.progress),
            "validations": json.dumps(self.validations),
            "model": self.model.state_dict(),
            "average": None if self._average is None else self._average.state_dict(),
            "optimizer": self._optimizer.state_dict(),
        }
        content = io.BytesIO()
        torch.save(state, content)
        write_atomically(self._run / STATE_FILE, content.getvalue())
        self.save_result(self._run / CHECKPOINT_FILE)

    def save_result(self, path: Path) -> None:
        """Write `result` as a checkpoint."""
        save_checkpoint(
            path,
            self.config.depth,
            self.result.depth_net.state_dict(),
            self.result.pose_net.state_dict(),
            {**self._metadata, "step": str(self.progress.step), "epoch": str(self.progress.epoch)},
        )

    def _resume(self) -> None:
        path = self._run / STATE_FILE
        if path.exists():
            state = torch.load(path, map_location=self._device, weights_only=True)
            self._refuse_other_run(path, state)
            self.progress = Progress(**state["progress"])
            self.validations = json.loads(state["validations"])
            self.model.load_state_dict(state["model"])
            self._optimizer.load_state_dict(state["optimizer"])
            if self._average is not None:
                self._average.load_state_dict(state["average"])
        self._drop_log_of_lost_steps()

    def _drop_log_of_lost_steps(self) -> None:
        """Drop what a killed run had logged after its last checkpoint: it will be made again."""
        path = self._run / LOG_FILE
        if not path.exists():
            return
        kept, validated = [], {(entry["step"], entry["epoch"]) for entry in self.validations}
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                break  # cut while it was written
            place = (entry["step"], entry["epoch"])
            if place in validated if "validation" in entry else entry["step"] <= self.progress.step:
                kept.append(line + "\n")
        write_atomically(path, "".join(kept).encode())

    def _refuse_other_run(self, path: Path, state: Mapping[str, Any]) -> None:
        """Raise unless the run that `state` is of would have computed the same; it may have been shorter."""
        was, now = (_what_is_computed(config) for config in (_configuration(path, state), self.config))
        changed = [name for name in now if was[name] != now[name]]
        if changed:
            raise CheckpointError(
                f"{path}: was made with another configuration ({', '.join(changed)}); resume with the run's own "
                f"{CONFIG_FILE}, or choose another folder"
            )
        if state["samples"] != self._batches.samples:
            raise CheckpointError(
                f"{path}: was made from {state['samples']} samples, now there are {self._batches.samples}; "
                "choose another folder"
            )

    def _train_epoch(self, bar: tqdm[Any]) -> None:
        optimizer = self.config.optimizer
        decays = self.progress.epoch // optimizer.decay_after_epochs
        for group in self._optimizer.param_groups:
            group["lr"] = optimizer.learning_rate * optimizer.decay_factor**decays
        batches = self._batches.epoch(self.progress.epoch, self.progress.batch)
        self.model.train()
        while group_of_step := list(islice(batches, optimizer.samples_per_step // optimizer.samples_per_batch)):
            entry = self._step(group_of_step)
            self.progress.batch += len(group_of_step)
            self._log(entry)
            for observer in self._observers:
                observer.on_step(self, entry)
            bar.update(len(group_of_step) * optimizer.samples_per_batch)
            bar.set_postfix(loss=entry["loss"], skipped=self.progress.skipped)
            if self.progress.step % self.config.checkpoint_every == 0:
                self.save()
        self.progress.epoch += 1
        self.progress.batch = 0

    def _step(self, batches: Sequence[RigBatch | None]) -> dict[str, Any]:
        """Make one optimiser step of several batches; return what is logged of it."""
        began = time.perf_counter()
        self.progress.step += 1
        torch.manual_seed(self.config.seed * 1_000_003 + self.progress.step)
        readable = [batch for batch in batches if batch is not None]
        self.progress.unreadable += len(batches) - len(readable)
        self._optimizer.zero_grad(set_to_none=True)
        values = [self._backpropagate(batch.to(self._device), is_first=not i) for i, batch in enumerate(readable)]
        samples = sum(len(value.per_sample) for value in values)
        norm = self._scaled_gradient_norm(samples)
        loss = sum(float(value.per_sample.sum()) for value in values) / max(samples, 1)
        self._update_weights(math.isfinite(loss) and math.isfinite(norm), samples)
        return {
            "step": self.progress.step,
            "epoch": self.progress.epoch,
            "loss": loss,
            "terms": _mean_terms(values),
            "gradient_norm": norm,
            "learning_rate": self._optimizer.param_groups[0]["lr"],
            "skipped": self.progress.skipped,
            "seconds": round(time.perf_counter() - began, 4),
        }

    def _backpropagate(self, batch: RigBatch, is_first: bool) -> ObjectiveValue:
        """Add the gradients of the batch's samples, summed, not averaged: the last batch of an epoch may be smaller."""
        seen, depth_flips, pose_flips = _augment(batch, self.config.augmentation)
        with torch.autocast(self._device.type, torch.bfloat16, self.config.optimizer.autocast == "bfloat16"):
            prediction = self.model(batch, seen, depth_flips, pose_flips)
        value = evaluate_objective(batch, prediction, self.config.objective)
        value.per_sample.sum().backward()  # type: ignore[no-untyped-call]
        if is_first and (self.progress.step - 1) % self.config.pictures_every == 0:
            for observer in self._observers:
                observer.on_pictures(self, batch.first_sample(), prediction.first_sample())
        return ObjectiveValue(value.per_sample.detach(), {name: term.detach() for name, term in value.terms.items()})

    def _scaled_gradient_norm(self, samples: int) -> float:
        """Turn the gradients' sum into their mean and shorten it if configured; return its length before."""
        for parameter in self.model.parameters():
            if parameter.grad is not None:
                parameter.grad /= max(samples, 1)
        limit = self.config.optimizer.max_gradient_norm or math.inf
        return float(nn.utils.clip_grad_norm_(self.model.parameters(), limit))

    def _update_weights(self, is_finite: bool, samples: int) -> None:
        if is_finite and samples:
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
                f"{_MAX_SKIPPED_IN_A_ROW} steps in a row; {self._run / CHECKPOINT_FILE} is the last good checkpoint"
            )

    def _score(self) -> None:
        if self._validate is None:
            return
        was_training = self.result.training
        self.result.eval()
        with torch.inference_mode():
            outcome = self._validate(self)
        self.result.train(was_training)
        self.progress.stopped = outcome.stop
        place = {"step": self.progress.step, "epoch": self.progress.epoch}
        entry = {**place, "validation": dict(outcome.scores), "stop": outcome.stop}
        self.validations.append(entry)
        self._log(entry)
        for observer in self._observers:
            observer.on_validation(self, entry)

    def _log(self, entry: Mapping[str, Any]) -> None:
        with (self._run / LOG_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")


def _configuration(path: Path, state: Mapping[str, Any]) -> TrainingConfig:
    """Return the configuration of the run that `state` is of; fields that are newer than it have their defaults."""
    try:
        return TrainingConfig.model_validate_json(state["config"])
    except ValidationError as error:
        raise CheckpointError(f"{path}: its configuration is not one of this version: {error}") from error


def _what_is_computed(config: TrainingConfig) -> dict[str, Any]:
    """Return the fields that decide the weights after a step, not how many there are or what is told of them."""
    return config.model_dump(
        exclude={
            "optimizer": {"epochs"},
            "recordings": {"workers", "cache_mb"},
            "checkpoint_every": True,
            "pictures_every": True,
        }
    )


def _augment(batch: RigBatch, config: AugmentationConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Draw what the networks see: jittered frames, and which samples each network sees mirrored."""
    seen = jitter_colors(batch.frames, config.color_jitter)
    flips = draw_flips(len(batch.frames)).to(batch.frames.device)
    none = torch.zeros_like(flips)
    depth_flips = flips if config.flip in ("depth", "both") else none
    return seen, depth_flips, flips if config.flip in ("pose", "both") else none


def _averaged(model: SurroundModel, decay: float | None) -> AveragedModel | None:
    """Return the moving average of the weights; while it is young it forgets faster, so as not to keep the start."""
    if decay is None:
        return None

    def update(average: Tensor, current: Tensor, updates: Tensor | int) -> Tensor:
        young = (1 + int(updates)) / (10 + int(updates))
        return torch.lerp(average, current, 1 - min(decay, young))

    return AveragedModel(model, avg_fn=update)


def _mean_terms(values: Sequence[ObjectiveValue]) -> dict[str, float]:
    names = values[0].terms if values else {}
    return {name: float(torch.cat([value.terms[name] for value in values]).mean()) for name in names}
