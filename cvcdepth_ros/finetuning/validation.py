# SPDX-License-Identifier: Apache-2.0
"""The validation of a run: some held-out sets are scored, the best weights kept, and a run without progress ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from cvcdepth_core.training.trainer import Trainer, ValidationOutcome
from cvcdepth_ros.evaluation.job import EvaluationJob
from cvcdepth_ros.finetuning.held_out import evaluate_checkpoint
from cvcdepth_ros.finetuning.judgement import numbers_of
from cvcdepth_ros.finetuning.world_scores import ViewScores, mean_scores

CANDIDATE_FILE = "candidate.safetensors"
"""The weights with the best validation since the start."""

_VALIDATED_FILE = ".validated.safetensors"


class HeldOutValidation:
    """Scores the trainer's weights on some held-out sets, from the file that would be shipped."""

    def __init__(
        self, jobs: Sequence[EvaluationJob], run: Path, patience: int | None, worlds: ViewScores | None = None
    ) -> None:
        """With `worlds`, these are scored too, which changes nothing but what is told."""
        self._jobs = jobs
        self._run = run
        self._patience = patience
        self._worlds = worlds

    def __call__(self, trainer: Trainer) -> ValidationOutcome:
        """Return the scores, and whether to stop; the weights are kept if they are the best so far."""
        path = self._run / _VALIDATED_FILE
        trainer.save_result(path)
        numbers = numbers_of(evaluate_checkpoint(self._jobs, path))
        score = numbers.get("score", math.inf)
        earlier = [(entry["step"], entry["validation"].get("score", math.inf)) for entry in trainer.validations]
        is_start = trainer.progress.step == 0
        if not is_start and all(score < other for step, other in earlier if step > 0):
            path.replace(self._run / CANDIDATE_FILE)
        else:
            path.unlink()
        scores = [*(other for _, other in earlier), score]
        if self._worlds is not None:
            on_worlds = mean_scores(self._worlds(trainer.result))
            numbers |= {f"worlds_{name}": value for name, value in on_worlds.items()}
        return ValidationOutcome(numbers, stop=not is_start and self._has_waited_enough(scores))

    def _has_waited_enough(self, scores: Sequence[float]) -> bool:
        since_best = len(scores) - 1 - scores.index(min(scores))
        return self._patience is not None and since_best >= self._patience
