# SPDX-License-Identifier: Apache-2.0
"""Recordings evaluated by Ray: on a cluster started here, or on one that is there already."""

from __future__ import annotations

import logging
import os
import platform
import socket
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, redirect_stdout, suppress
from functools import partial
from pathlib import Path
from typing import Any

from cvcdepth_core.errors import ConfigError, CvcDepthError
from cvcdepth_ros.evaluation.job import Dependencies, EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.result import Failure
from cvcdepth_ros.evaluation.workers import Outcome, Pool, evaluate_safely
from cvcdepth_ros.process_setup import prepare_long_work

_CONNECT_SECONDS = 10.0


@contextmanager
def ray_pool(settings: EvaluationSettings, address: str | None, workers: int | None) -> Iterator[Pool]:
    """Give the workers of the cluster at `address`, or of one that is started here for `workers` recordings at a time.

    A recording takes as many CPUs as the settings name threads, and a GPU where there are any for its network. Without
    `workers` it is as many as the machine has CPUs for. Raises ConfigError when Ray is not installed, the cluster
    cannot be reached, or no machine of it is large enough.
    """
    try:
        import ray
    except ImportError as error:
        raise ConfigError(f"{error}; `pip install 'cvcdepth_ros[fleet]'` brings Ray") from error
    # Ray prints what its workers say, but the standard output is for results.
    with redirect_stdout(sys.stderr):
        _connect(settings, address, workers)
        try:
            executor = partial(RayExecutor, settings.threads, _gpus(settings))
            work = partial(_evaluate_as_here, expected=settings.dependencies(), folder=Path.cwd())
            yield Pool(lambda _: executor(), _worker_deaths(), work)
        finally:
            ray.shutdown()


class RayExecutor(Executor):
    """Calls functions on the cluster that this process is connected to."""

    def __init__(self, cpus: int, gpus: int) -> None:
        """Each call takes so many CPUs and GPUs of one machine. A call whose worker died is not repeated."""
        self._options = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": 0}
        self._running: set[Any] = set()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a call and return its future, which raises one of Ray's own errors when the worker dies."""
        import ray

        reference = ray.remote(**self._options)(_call).remote(fn, *args, **kwargs)
        future: Future[Any] = reference.future()
        self._running.add(reference)
        future.add_done_callback(lambda _: self._running.discard(reference))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Stop what has not ended where `cancel_futures` says so; the cluster stays."""
        import ray

        for reference in [*self._running] if cancel_futures else ():
            ray.cancel(reference, force=True)


def _call(fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call `fn`; Ray takes plain functions only, no other callables."""
    return fn(*args, **kwargs)


def _connect(settings: EvaluationSettings, address: str | None, workers: int | None) -> None:
    import ray

    if address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        cpus = workers * settings.threads if workers else max(os.cpu_count() or 1, settings.threads)
        ray.init(num_cpus=cpus, include_dashboard=False, logging_level=logging.WARNING)
        return
    try:
        _check_reachable(address)
        ray.init(address, logging_level=logging.WARNING)
    # Ray's client, its core and gRPC each raise their own.
    except Exception as error:
        raise ConfigError(f"Ray cluster {address}: cannot be reached: {error}") from error
    greatest = max((node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]), default=0)
    if greatest < settings.threads:
        ray.shutdown()
        raise ConfigError(
            f"Ray cluster {address}: no machine has the {settings.threads} CPUs of a recording; most have {greatest:g}"
        )


def _check_reachable(address: str) -> None:
    """Raise OSError where nobody listens at host:port or ray://host:port; Ray itself would try for two minutes."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT_SECONDS).close()


def _worker_deaths() -> tuple[type[Exception], ...]:
    from ray import exceptions as died

    return (died.WorkerCrashedError, died.NodeDiedError, died.OutOfMemoryError, died.ObjectLostError)


def _gpus(settings: EvaluationSettings) -> int:
    """Return how many GPUs a recording takes; Ray hides those that are not asked for."""
    import ray

    if settings.predictor is not None or settings.device == "cpu":
        return 0
    there = ray.cluster_resources().get("GPU", 0) >= 1
    if settings.device != "auto" and not there:
        raise ConfigError(f"device {settings.device}: no machine of the Ray cluster has a GPU")
    return int(there)


def _evaluate_as_here(job: EvaluationJob, expected: Dependencies, folder: Path) -> Outcome:
    """Evaluate on a machine of the cluster, if it has the same program and checkpoint as the one that asks.

    Relative paths are from `folder`, where the machine has it.
    """
    prepare_long_work()
    with suppress(OSError):
        os.chdir(folder)
    try:
        found = job.settings.dependencies()
    except CvcDepthError as error:
        return Failure(job.name, job.path, f"on {platform.node()}: {error}")
    if found != expected:
        return Failure(job.name, job.path, f"{platform.node()} has {found}, expected {expected}")
    return evaluate_safely(job)
