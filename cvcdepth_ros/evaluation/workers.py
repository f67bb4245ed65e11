# SPDX-License-Identifier: Apache-2.0
"""Many recordings, each a unit of work: in this process or in several, finished ones kept for the next run."""

from __future__ import annotations

import hashlib
import json
import logging
import multiprocessing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from cvcdepth_core.atomic_file import write_atomically
from cvcdepth_core.errors import CvcDepthError
from cvcdepth_ros.bags import file_identities
from cvcdepth_ros.evaluation.job import EvaluationJob
from cvcdepth_ros.evaluation.recording import Progress, RecordingScores, evaluate_recording
from cvcdepth_ros.evaluation.result import Failure

Outcome = RecordingScores | Failure

_logger = logging.getLogger(__name__)


class KeptParts:
    """The finished recordings' scores, one file each, which hold for the very same work only."""

    def __init__(self, folder: Path, depends_on: Mapping[str, Any]) -> None:
        """`depends_on` says, with JSON's types, what else the scores depend on: the program, the checkpoint."""
        self._folder = folder
        self._depends_on = depends_on

    def load(self, job: EvaluationJob) -> RecordingScores | None:
        """Return the scores of a former run; None where there are none, or of another work."""
        try:
            content = json.loads(self._path(job).read_text(encoding="utf-8"))
            return RecordingScores.from_json(content["scores"]) if content["work"] == self._work(job) else None
        except (OSError, ValueError, KeyError, TypeError, CvcDepthError):
            return None  # not there, or cut by whatever ended the former run: then the work is done again

    def save(self, job: EvaluationJob, scores: RecordingScores) -> None:
        """Keep the scores; the file appears whole or not at all."""
        try:
            work = self._work(job)
        except OSError:
            return  # the recording cannot be reached any more, so nobody can know it again
        self._folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self._path(job), json.dumps({"work": work, "scores": scores.to_json()}).encode())

    def _path(self, job: EvaluationJob) -> Path:
        return self._folder / f"{hashlib.sha256(job.name.encode()).hexdigest()[:16]}.json"

    def _work(self, job: EvaluationJob) -> dict[str, Any]:
        masks = [str(camera.mask) for camera in job.layout.cameras if camera.mask] if job.layout else []
        return {
            **self._depends_on,
            "configuration": job.configuration(),
            "name": job.name,
            "path": job.path,
            "files": [identity for path in (job.path, *masks) for identity in file_identities(path)],
        }


def evaluate_all(
    jobs: Sequence[EvaluationJob], workers: int, kept: KeptParts | None = None, progress: Progress | None = None
) -> Iterator[tuple[EvaluationJob, Outcome]]:
    """Evaluate recordings with so many processes (1: in this one), and give each as soon as it is finished.

    A recording that fails, whatever the reason, is a `Failure` and stops no other. What `kept` has is not done again.
    """
    missing = []
    for job in jobs:
        found = kept.load(job) if kept else None
        if found is None:
            missing.append(job)
        else:
            yield job, found
    outcomes = _in_turn(missing, progress) if min(workers, len(missing)) <= 1 else _in_processes(missing, workers)
    for job, outcome in outcomes:
        if kept and isinstance(outcome, RecordingScores):
            kept.save(job, outcome)
        yield job, outcome


def _in_turn(jobs: Iterable[EvaluationJob], progress: Progress | None) -> Iterator[tuple[EvaluationJob, Outcome]]:
    for job in jobs:
        yield job, _outcome(job, progress)


def _in_processes(jobs: Sequence[EvaluationJob], workers: int) -> Iterator[tuple[EvaluationJob, Outcome]]:
    """Where a worker dies all jobs in hand are lost: they are done again, each in a process of its own."""
    lost = []
    for job, outcome in _with_executor(_processes(min(workers, len(jobs))), jobs):
        if outcome is None:
            lost.append(job)
        else:
            yield job, outcome
    for job in lost:
        for _, outcome in _with_executor(_processes(1), [job]):
            yield job, outcome or Failure(job.name, job.path, "the worker process died (out of memory?)")


def _processes(workers: int) -> ProcessPoolExecutor:
    """Return fresh interpreters: a forked one would inherit torch's threads and CUDA in a state that does not work."""
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


def _with_executor(executor: Executor, jobs: Iterable[EvaluationJob]) -> Iterator[tuple[EvaluationJob, Outcome | None]]:
    """Hand the jobs to any executor; None is what became of a job whose worker died."""
    try:
        futures: dict[Future[Outcome], EvaluationJob] = {executor.submit(_outcome, job): job for job in jobs}
        for future in as_completed(futures):
            try:
                yield futures[future], future.result()
            except BrokenProcessPool:
                yield futures[future], None
    finally:
        executor.shutdown(cancel_futures=True)


def _outcome(job: EvaluationJob, progress: Progress | None = None) -> Outcome:
    try:
        return evaluate_recording(job, progress)
    except (CvcDepthError, OSError) as error:
        return Failure(job.name, job.path, str(error))
    except Exception as error:
        _logger.exception("%s: a defect of this program", job.path)
        return Failure(job.name, job.path, f"unexpected {type(error).__name__}: {error}")
