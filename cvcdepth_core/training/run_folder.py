# SPDX-License-Identifier: Apache-2.0
"""The folder of a training run: checkpoint, state, log and configuration, consistent whenever the run is killed."""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import yaml
from pydantic import ValidationError

from cvcdepth_core.errors import CheckpointError, OutputError, validation_messages
from cvcdepth_core.files import write_atomically
from cvcdepth_core.training.config import TrainingConfig

CHECKPOINT_FILE, LOG_FILE = "last.safetensors", "log.jsonl"
_STATE_FILE, _CONFIG_FILE = "state.pt", "config.yaml"


class RunFolder:
    """The files of one run. Writing raises OutputError, naming the file, when it fails."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.checkpoint = path / CHECKPOINT_FILE
        self.state = path / _STATE_FILE

    def create(self) -> None:
        """Create the folder unless it exists."""
        self._path.mkdir(parents=True, exist_ok=True)

    def write_config(self, config: TrainingConfig) -> None:
        """Write the configuration beside the results."""
        text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
        write_atomically(self._path / _CONFIG_FILE, text.encode())

    def write_state(self, state: Mapping[str, Any]) -> None:
        """Write the state that a run is resumed from, replacing the former one."""
        content = io.BytesIO()
        torch.save(dict(state), content)
        write_atomically(self.state, content.getvalue())

    def read_state(self) -> bytes:
        """Return the state's bytes, empty without a state; CheckpointError when the file is empty."""
        content = self.state.read_bytes() if self.state.exists() else None
        if content == b"":
            raise CheckpointError(f"{self.state}: is empty (0 bytes); remove it to start the run anew")
        return content or b""

    def state_from(self, content: bytes) -> dict[str, Any]:
        """Return the state, on the CPU, from the bytes of `read_state`; CheckpointError when they are damaged."""
        try:
            return dict(torch.load(io.BytesIO(content), map_location="cpu", weights_only=True))
        except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError, TypeError, ValueError) as error:
            reason = str(error).partition("\n")[0]
            raise CheckpointError(f"{self.state}: is damaged ({reason}); remove it to start the run anew") from error

    def append_to_log(self, entry: Mapping[str, Any]) -> None:
        """Append one line of JSON to the log."""
        path = self._path / LOG_FILE
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error

    def drop_remains(self, step: int, validations: Sequence[Mapping[str, Any]]) -> None:
        """Remove what a killed run wrote after its state: later log lines, other validations, unfinished files."""
        for unfinished in self._path.glob(".*.tmp"):
            unfinished.unlink()
        path = self._path / LOG_FILE
        if not path.exists():
            return
        kept, validated = [], {(entry["step"], entry["epoch"]) for entry in validations}
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                break  # cut while it was written
            place = (entry["step"], entry["epoch"])
            if place in validated if "validation" in entry else entry["step"] <= step:
                kept.append(line + "\n")
        write_atomically(path, "".join(kept).encode())


@dataclass(frozen=True)
class RunIdentity:
    """Everything that determines the weights after a step; a run is only resumed with the same."""

    config: TrainingConfig
    samples: int
    """Number of samples of one epoch, of all processes together."""
    samples_together: int
    """Samples that go through the networks of all processes together."""
    inputs: Mapping[str, str] = field(default_factory=dict)
    """Identity of each input by its name: the starting weights, and the data beyond the number of samples."""

    def to_state(self) -> dict[str, Any]:
        """Return what `refuse_other` compares, for the run's state."""
        return {
            "config": self.config.model_dump_json(),
            "samples": self.samples,
            "samples_together": self.samples_together,
            "inputs": json.dumps(dict(self.inputs)),
        }

    def refuse_other(self, state: Mapping[str, Any], path: Path) -> None:
        """Raise CheckpointError unless the run of this `state`, from `path`, computed the same; it may be shorter."""
        was, now = (_what_is_computed(config) for config in (_configuration(path, state), self.config))
        changed = [name for name in now if was[name] != now[name]]
        if changed:
            raise CheckpointError(
                f"{path}: was made with another configuration ({', '.join(changed)}); resume with the run's own "
                f"{_CONFIG_FILE}, or choose another folder"
            )
        if state["samples_together"] != self.samples_together:
            processes = self.samples_together // self.config.optimizer.samples_per_batch
            raise CheckpointError(
                f"{path}: {state['samples_together']} samples went through the networks together, now it is "
                f"{self.samples_together} (optimizer.samples_per_batch x {processes} processes)"
            )
        self._refuse_other_inputs(json.loads(state.get("inputs", "{}")), path)
        if state["samples"] != self.samples:
            raise CheckpointError(
                f"{path}: was made from {state['samples']} samples, now there are {self.samples}; choose another folder"
            )

    def _refuse_other_inputs(self, were: Mapping[str, str], path: Path) -> None:
        differences = [
            f"{name} was {were.get(name, 'none')}, now it is {self.inputs.get(name, 'none')}"
            for name in {**were, **self.inputs}
            if were.get(name) != self.inputs.get(name)
        ]
        if differences:
            listed = "; ".join(differences)
            raise CheckpointError(f"{path}: was made from something else: {listed}; choose another folder")


def _configuration(path: Path, state: Mapping[str, Any]) -> TrainingConfig:
    """Return the configuration of the run that wrote `state`; fields that it did not know have their defaults."""
    try:
        return TrainingConfig.model_validate_json(state["config"])
    except ValidationError as error:
        reason = validation_messages(error, TrainingConfig)
        raise CheckpointError(f"{path}: its configuration is not one of this version: {reason}") from error


def _what_is_computed(config: TrainingConfig) -> dict[str, Any]:
    """Return the fields that determine the weights after a step, without the number of steps and the reporting."""
    steps_follow_epochs = config.optimizer.schedule == "cosine"
    return config.model_dump(
        exclude={
            "optimizer": {"samples_per_batch"} if steps_follow_epochs else {"epochs", "samples_per_batch"},
            "recordings": {"workers", "cache_mb"},
            "checkpoint_every": True,
            "pictures_every": True,
        }
    )
