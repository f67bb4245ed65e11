# SPDX-License-Identifier: Apache-2.0
"""Simulated drives in several processes at once, each of which builds the world for itself. No ROS here."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

import cv2

from cvcdepth_core.errors import CvcDepthError

Task = TypeVar("Task")


class WorkersDiedError(CvcDepthError):
    """A worker process ended by itself."""


def run_all(
    tasks: Sequence[Task], work: Callable[[Task], None], workers: int, prepare: Callable[[], None] | None = None
) -> Iterator[Task]:
    """Do every task, and give each when it is done: in this process, or in `workers` others.

    `prepare` is called once in each process before its first task; both functions must be of a module. Raises what a
    task raises, and WorkersDiedError when a process died.
    """
    if min(workers, len(tasks)) <= 1:
        if prepare is not None and tasks:
            prepare()
        for task in tasks:
            work(task)
            yield task
        return
    # Fresh interpreters: a forked one would inherit the threads of Embree and OpenCV in a state that does not work.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(tasks)), context, _start, (prepare,)) as pool:
        futures = {pool.submit(work, task): task for task in tasks}
        try:
            for future in as_completed(futures):
                future.result()
                yield futures[future]
        except BrokenProcessPool as error:
            raise WorkersDiedError("a worker process died (out of memory?); fewer --workers need less") from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _start(prepare: Callable[[], None] | None) -> None:
    # Ctrl-C reaches all processes of a terminal; the one that was called ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    if prepare is not None:
        prepare()
