# SPDX-License-Identifier: Apache-2.0
"""Evaluation of many recordings, one after the other or several at a time; finished ones are kept for the next call."""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_ros.bags import file_identities
from cvcdepth_ros.evaluation.job import Dependencies, EvaluationJob
from cvcdepth_ros.evaluation.measuring import Progress, RecordingScores, evaluate_recording
from cvcdepth_ros.evaluation.result import Failure
from cvcdepth_ros.kept import KeptResults, Work
from cvcdepth_ros.process_setup import prepare_long_work

Outcome = RecordingScores | Failure

_logger = logging.getLogger(__name__)


class KeptScores:
    """The finished recordings' scores, which hold for the very same recording, settings, program and checkpoint."""

    def __init__(self, folder: Path, depends_on: Dependencies) -> None:
        self._results = KeptResults(folder, RecordingScores.to_arrays, RecordingScores.from_arrays)
        self._depends_on = depends_on

    def load(self, job: EvaluationJob) -> RecordingScores | None:
        """Return the scores of a former call; None where there are none, or of other work."""
        work = self._work(job)
        return None if work is None else self._results.load(job.name, work)

    def save(self, job: EvaluationJob, scores: RecordingScores) -> None:
        """Keep the scores; not those of a recording that cannot be reached any more, which nobody could know again."""
        work = self._work(job)
        if work is not None:
            self._results.save(job.name, work, scores)

    def _work(self, job: EvaluationJob) -> Work | None:
        """Return all that the job's scores depend on; None where its files cannot be reached."""
        masks = [str(camera.mask) for camera in job.layout.cameras if camera.mask] if job.layout else []
        try:
            files = [identity for path in (job.path, *masks) for identity in file_identities(path)]
        except (OSError, CvcDepthError):
            return None
        return {
            **self._depends_on._asdict(),
            "configuration": job.configuration(),
            "name": job.name,
            "path": job.path,
            "files": files,
        }


@dataclass(frozen=True)
class Pool:
    """Workers that evaluate several recordings at the same time."""

    open: Callable[[int], Executor]
    """Returns an executor for this many recordings at a time."""
    died: tuple[type[Exception], ...]
    """The exceptions of a call's future when its worker dies."""
    work: Callable[[EvaluationJob], Outcome]
    """Evaluates one recording, in a worker."""


def evaluate_all(
    jobs: Sequence[EvaluationJob],
    workers: int = 1,
    kept: KeptScores | None = None,
    progress: Progress | None = None,
    pool: Pool | None = None,
) -> Iterator[tuple[EvaluationJob, Outcome]]:
    """Evaluate recordings, in this process or several at a time in a pool; give each as soon as it is finished.

    The pool is `workers` processes of this machine unless another is given. A recording that fails, whatever the
    reason, is a `Failure` and stops no other. Recordings that `kept` has are not evaluated again. `progress` is called
    with the number of recordings that are done.
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
    """Return a recording's scores, or a `Failure` whatever goes wrong."""
    try:
        return evaluate_recording(job, progress)
    except (CvcDepthError, OSError) as error:
        return Failure(job.name, job.path, str(error))
    except Exception as error:
        _logger.exception("%s: a defect of this program", job.path)
        return _unexpected(job, error)


def _in_pool(pool: Pool, jobs: Sequence[EvaluationJob], workers: int) -> Iterator[tuple[EvaluationJob, Outcome]]:
    """Give the outcomes of jobs; those that a dying worker took with it are tried again, each in its own executor."""
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
    """Give the outcomes of jobs, None where the worker died."""
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
    """Return an executor of fresh interpreters: a forked one would inherit torch's threads and CUDA in a bad state."""
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=prepare_long_work)


PROCESSES = Pool(_processes, (BrokenProcessPool,), evaluate_safely)


def _unexpected(job: EvaluationJob, error: Exception) -> Failure:
    return Failure(job.name, job.path, f"unexpected {type(error).__name__}: {error}")
