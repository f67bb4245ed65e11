# SPDX-License-Identifier: Apache-2.0
"""What all benchmarks share: measuring in turns, so that a busy machine is busy for all alike, and one JSON line each.

timings = measure_in_turns({"straightforward": slow, "ours": fast}, rounds=20)
for line in json_lines("cloud", timings, baseline="straightforward", sizes={"cameras": 6}):
    print_line(line)
"""

from __future__ import annotations

import contextlib
import datetime
import importlib.metadata
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_PACKAGES = ("torch", "numpy", "opencv-python-headless", "ncnn", "openvino", "onnxruntime")


@dataclass
class Timings:
    """Seconds of each run of one thing, in the order of the rounds."""

    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    """Of this process, all threads together: what tells more where others use the machine too."""

    @property
    def median_cpu(self) -> float:
        """Seconds of CPU time."""
        return statistics.median(self.cpu)

    def add(self, work: Callable[[], object]) -> None:
        """Run it once and note what it took."""
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        self.cpu.append(time.process_time() - cpu)
        self.wall.append(time.perf_counter() - wall)


def measure_in_turns(cases: Mapping[str, Callable[[], object]], rounds: int, warm_up: int = 1) -> dict[str, Timings]:
    """Run every case once per round, one after the other, after rounds that warm up.

    A case on a GPU has to wait for the device before it returns.
    """
    for _ in range(warm_up):
        for work in cases.values():
            work()
    timings = {name: Timings() for name in cases}
    for _ in range(rounds):
        for name, work in cases.items():
            timings[name].add(work)
    return timings


@contextlib.contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Have so many processes do nothing but use a processor, beside what the block measures."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def json_lines(
    benchmark: str, timings: Mapping[str, Timings], baseline: str, sizes: Mapping[str, Any], device: str = "cpu"
) -> Iterator[dict[str, Any]]:
    """Describe every case in the form that `table.py` reads; `sizes` says what it was measured on.

    `times_baseline` is how many times quicker than the baseline a case was: the median over the rounds, each of which
    ran both.
    """
    for name, measured in timings.items():
        yield {
            "benchmark": benchmark,
            "case": name,
            **sizes,
            **summary(measured.wall),
            "cpu_ms": round(1e3 * measured.median_cpu, 3),
            "baseline": baseline,
            "times_baseline": round(times_quicker(timings[baseline].wall, measured.wall), 3),
            "times_baseline_cpu": round(times_quicker(timings[baseline].cpu, measured.cpu), 3),
            "peak_memory_mb": round(peak_memory_mb()),
            **circumstances(device),
        }


def summary(seconds: Sequence[float]) -> dict[str, float]:
    """Return median and 95th percentile in milliseconds, and runs per second."""
    median = statistics.median(seconds)
    p95 = sorted(seconds)[min(len(seconds) - 1, int(0.95 * len(seconds)))]
    return {
        "rounds": len(seconds),
        "median_ms": round(1e3 * median, 3),
        "p95_ms": round(1e3 * p95, 3),
        "per_second": round(1 / median, 3),
    }


def times_quicker(baseline: Sequence[float], ours: Sequence[float]) -> float:
    """Return the median over the rounds of baseline / ours."""
    return statistics.median(b / max(a, 1e-9) for b, a in zip(baseline, ours, strict=True))


def circumstances(device: str = "cpu") -> dict[str, Any]:
    """Say when and on what it was measured."""
    return {
        "machine": machine(device),
        "threads": os.environ.get("OMP_NUM_THREADS", "all"),
        "load_average": round(os.getloadavg()[0], 1),
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M"),
        "python": platform.python_version(),
        "versions": dict(installed_versions()),
    }


def installed_versions() -> Iterator[tuple[str, str]]:
    """Name those packages that the numbers depend on and that are installed."""
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            yield name, importlib.metadata.version(name)


def machine(device: str = "cpu") -> str:
    """Name the GPU, or the processor and how many of it this process may use."""
    if device.startswith("cuda"):
        import torch

        return torch.cuda.get_device_name(device)
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    extensions = next((line.split() for line in lines if line.startswith("flags")), [])
    vectors = next((name for name in ("avx512f", "avx2") if name in extensions), "")
    return f"{models[0] if models else platform.processor()}, {len(os.sched_getaffinity(0))} cores {vectors}".strip()


def peak_memory_mb(device: str = "cpu") -> float:
    """Return MiB: what torch allocated on the GPU, or this process's greatest resident size."""
    if device.startswith("cuda"):
        import torch

        return torch.cuda.max_memory_allocated() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def print_line(line: Mapping[str, Any]) -> None:
    """Print one JSON line at once, also into a pipe."""
    print(json.dumps(line), flush=True)
