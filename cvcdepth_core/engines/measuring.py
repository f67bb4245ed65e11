# SPDX-License-Identifier: Apache-2.0
"""How long each engine that is installed takes for a surround set."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from cvcdepth_core.engines.example_rigs import ring_of_pictures
from cvcdepth_core.engines.guarded_engine import GuardedEngine
from cvcdepth_core.engines.selection import checked_engine, choices_of_auto
from cvcdepth_core.errors import ConfigError, EngineError
from cvcdepth_core.model_choices import Precision
from cvcdepth_core.networks import DepthNetwork
from cvcdepth_core.networks.registry import DepthModelSpec


@dataclass
class EngineTimes:
    """What one engine takes, or why it cannot be used."""

    backend: str
    name: str = ""
    """With version and precision; empty where it cannot be used."""
    problem: str = ""
    """Empty where it can be used."""
    ready_seconds: float = 0.0
    """Seconds until it had computed its first set."""
    wall_seconds: list[float] = field(default_factory=list)
    """Of each set."""
    cpu_seconds: list[float] = field(default_factory=list)
    """The same of all threads together, which other work on the machine changes less."""

    @property
    def wall_ms(self) -> float:
        """Median over the sets."""
        return 1e3 * statistics.median(self.wall_seconds)

    @property
    def cpu_ms(self) -> float:
        """Median over the sets."""
        return 1e3 * statistics.median(self.cpu_seconds)


def measure_engines(
    network: DepthNetwork, spec: DepthModelSpec, device: torch.device, precision: Precision, sets: int
) -> list[EngineTimes]:
    """Return what each engine that is installed takes for six cameras, in the order in which `auto` tries them.

    They take turns, so that a busy machine is busy for all alike; all are in memory at the same time.
    """
    surround = ring_of_pictures(spec.height, spec.width)
    measured: list[tuple[EngineTimes, Callable[[], object]]] = []
    found = []
    for backend in choices_of_auto(network, spec, device):
        times = EngineTimes(backend)
        found.append(times)
        began = time.perf_counter()
        try:
            engine = GuardedEngine(checked_engine(network, spec, device, backend, precision), network.independent)
            engine.disparity(surround)
        except (ConfigError, EngineError) as error:
            times.problem = str(error)
            continue
        times.name, times.ready_seconds = engine.name, time.perf_counter() - began
        measured.append((times, lambda engine=engine: engine.disparity(surround)))  # type: ignore[misc]
    for _ in range(sets):
        for times, estimate in measured:
            wall, cpu = time.perf_counter(), time.process_time()
            estimate()
            times.wall_seconds.append(time.perf_counter() - wall)
            times.cpu_seconds.append(time.process_time() - cpu)
    return found
