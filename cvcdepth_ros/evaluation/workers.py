# SPDX-License-Identifier: Apache-2.0
"""Many recordings, each a unit of work: in this process or in several, finished ones kept for the next run."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.files import write_atomically
from cvcdepth_ros.bags import file_identities
from cvcdepth_ros.evaluation.job import Dependencies, EvaluationJob
from cvcdepth_ros.evaluation.measuring import Progress, RecordingScores, evaluate_recording
from cvcdepth_ros.evaluation.result import Failure

Outcome = RecordingScores | Failure

_logger = logging.getLogger(__name__)


class KeptParts:
    """The finished recordings' scores, one file each, which hold for the very same work only."""

    def __init__(self, folder: Path, depends_on: Dependencies) -> None:
        self._folder = folder
        self._depends_on = depends_on

    def load(self, job: EvaluationJob) -> RecordingScores | None:
        """Return the scores of a former run; None where there are none, or of another work."""
        try:
            with np.load(self._path(job), allow_pickle=False) as arrays:
                known = json.loads(arrays["work"].tobytes()) == self._work(job)
                return RecordingScores.from_arrays(arrays) if known else None
        except (OSError, ValueError, KeyError, TypeError, BadZipFile, CvcDepthError):
            return None  # not there, or cut by whatever ended the former run: then the work is done again

    def save(self, job: EvaluationJob, scores: RecordingScores) -> None:
        """Keep the scores; the file appears whole or not at all."""
        try:
            work = self._work(job)
        except OSError:
            return  # the recording cannot be reached any more, so nobody can know it again
        self._folder.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()
        arrays: dict[str, Any] = {"work": np.frombuffer(json.dumps(work).encode(), dtype=np.uint8)} | scores.to_arrays()
        np.savez(content, **arrays)
        write_atomically(self._path(job), content.getvalue())

    def _path(self, job: EvaluationJob) -> Path:
        return self._folder / f"{hashlib.sha256(job.name.encode()).hexdigest()[:16]}.npz"

    def _work(self, job: EvaluationJob) -> dict[str, Any]:
        masks = [str(camera.mask) for camera in job.layout.cameras if camera.mask] if job.layout else []
        return {
            **self._depends_on._asdict(),
            "configuration": job.configuration(),
            "name": job.name,
            "path": job.path,
            "files": [identity for path in (job.path, *masks) for identity in file_identities(path)],
        }


@dataclass(frozen=True)
class Pool:
    """Where recordings are evaluated at the same time."""

    open: Callable[[int], Executor]
    """Gives an executor for so many at a time."""
    died: tuple[type[Exception], ...]
    """What a call's future raises when the worker dies."""
    work: Callable[[EvaluationJob], Outcome]
    """Evaluates one recording over there."""


def evaluate_all(
    jobs: Sequence[EvaluationJob],
    workers: int = 1,
    kept: KeptParts | None = None,
    progress: Progress | None = None,
    pool: Pool | None = None,
) -> Iterator[tuple[EvaluationJob, Outcome]]:
    """Evaluate recordings and give each as soon as it is finished: in this process, or several at a time in a pool.

    The pool is `workers` processes of this machine unless another is given. A recording that fails, whatever the
    reason, is a `Failure` and stops no other. What `kept` has is not done again. `progress` is told how many recordings
    are done.
    """
    done = 0
    missing = []
    for job in jobs:
        found = kept.load(job) if kept else None
        if found is None:
            missing.append(job)
        else:
            done += 1
            yield job, found
    tell = progress or (lambda _: None)
    if pool or min(workers, len(missing)) > 1:
        outcomes = _in_pool(pool or PROCESSES, missing, workers)
    else:
        outcomes = ((job, evaluate_safely(job, lambda share: tell(done + share))) for job in missing)
    for job, outcome in outcomes:
        if kept and isinstance(outcome, RecordingScores):
            kept.save(job, outcome)
        done += 1
        tell(done)
        yield job, outcome


def evaluate_safely(job: EvaluationJob, progress: Progress | None = None) -> Outcome:
    """Evaluate a recording; whatever goes wrong becomes a `Failure`."""
    try:
        return evaluate_recording(job, progress)
    except (CvcDepthError, OSError) as error:
        return Failure(job.name, job.path, str(error))
    except Exception as error:
        _logger.exception("%s: a defect of this program", job.path)
        return _unexpected(job, error)


def _in_pool(pool: Pool, jobs: Sequence[EvaluationJob], workers: int) -> Iterator[tuple[EvaluationJob, Outcome]]:
    """Where a worker dies, jobs that it took with it are done again, each in an executor of its own."""
    lost = []
    for job, outcome in _with_executor(pool, min(workers, len(jobs)), jobs):
        if outcome is None:
            lost.append(job)
        else:
            yield job, outcome
    for job in lost:
        for _, outcome in _with_executor(pool, 1, [job]):
            yield job, outcome or Failure(job.name, job.path, "the worker process died (out of memory?)")


def _with_executor(
    pool: Pool, workers: int, jobs: Iterable[EvaluationJob]
) -> Iterator[tuple[EvaluationJob, Outcome | None]]:
    """Hand the jobs to an executor; None is what became of a job whose worker died."""
    executor = pool.open(workers)
    try:
        futures: dict[Future[Outcome], EvaluationJob] = {executor.submit(pool.work, job): job for job in jobs}
        for future in as_completed(futures):
            job = futures.pop(future)
            try:
                yield job, future.result()
            except pool.died:
                yield job, None
            except Exception as error:  # the job could not be sent there, or its outcome not back
                yield job, _unexpected(job, error)
    finally:
        executor.shutdown(cancel_futures=True)


def _processes(workers: int) -> ProcessPoolExecutor:
    """Return fresh interpreters: a forked one would inherit torch's threads and CUDA in a state that does not work."""
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


PROCESSES = Pool(_processes, (BrokenProcessPool,), evaluate_safely)


def _unexpected(job: EvaluationJob, error: Exception) -> Failure:
    return Failure(job.name, job.path, f"unexpected {type(error).__name__}: {error}")
