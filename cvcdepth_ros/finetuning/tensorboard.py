# SPDX-License-Identifier: Apache-2.0
"""A run in TensorBoard: every number of the log, and pictures of the networks' input and output."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.objective import Prediction
from cvcdepth_core.training.trainer import Trainer
from cvcdepth_ros.finetuning.training_pictures import training_pictures

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

TENSORBOARD_FOLDER = "tensorboard"
WITHOUT_TENSORBOARD = "no TensorBoard files: tensorboard is not installed; pip install 'cvcdepth_ros[tensorboard]'"


def has_tensorboard() -> bool:
    """Return whether TensorBoard files can be written here."""
    return find_spec("tensorboard") is not None


class TensorBoardObserver:
    """Writes a run's numbers and pictures; those of steps that an interrupted run repeats are replaced."""

    def __init__(self, run: Path) -> None:
        self._folder = run / TENSORBOARD_FOLDER
        self._opened: SummaryWriter | None = None

    def on_step(self, trainer: Trainer, entry: Mapping[str, Any]) -> None:
        """Write the loss, its terms, gradient, learning rate and time."""
        writer, step = self._writer(trainer), entry["step"]
        for name in ("loss", "gradient_norm", "learning_rate", "skipped", "seconds"):
            writer.add_scalar(f"training/{name}", entry[name], step)
        for name, value in entry["terms"].items():
            writer.add_scalar(f"terms/{name}", value, step)

    def on_pictures(self, trainer: Trainer, batch: RigBatch, prediction: Prediction) -> None:
        """Write the pictures of `training_pictures`."""
        writer = self._writer(trainer)
        for name, picture in training_pictures(batch, prediction, trainer.config.objective).items():
            writer.add_image(name, picture, trainer.progress.step, dataformats="HWC")

    def on_validation(self, trainer: Trainer, entry: Mapping[str, Any]) -> None:
        """Write the scores on held-out sets."""
        writer = self._writer(trainer)
        for name, value in entry["validation"].items():
            writer.add_scalar(f"held_out/{name}", value, entry["step"])
        writer.flush()

    def close(self) -> None:
        """Write what is buffered, and close the file."""
        if self._opened is not None:
            self._opened.close()

    def _writer(self, trainer: Trainer) -> SummaryWriter:
        if self._opened is None:
            from torch.utils.tensorboard import SummaryWriter

            self._opened = SummaryWriter(str(self._folder), purge_step=trainer.progress.step)
        return self._opened
