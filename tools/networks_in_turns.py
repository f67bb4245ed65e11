# SPDX-License-Identifier: Apache-2.0
"""What checkpoints cost beside each other: CPU time of six pictures, in turns in one process; the first is the measure.

    python tools/networks_in_turns.py old.safetensors default default:192x320 --backend openvino --rounds 15

A checkpoint runs at its own size, or at the one after the colon; its error of depth against float64 is told too.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch

from cvcdepth_core.engines.example_rigs import ring_of_cameras, ring_of_pictures
from cvcdepth_core.engines.parity import relative_depth_error
from cvcdepth_core.engines.selection import checked_engine
from cvcdepth_core.estimator import DepthEstimator
from cvcdepth_core.model_choices import BACKENDS, checkpoint_path
from cvcdepth_core.networks import DepthModelSpec, DepthNetwork
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_ros.process_setup import prepare_process


class Case(NamedTuple):
    """A network at a size."""

    name: str
    engine: str
    error: float
    """Relative, at the 99.9th percentile."""
    estimate: Callable[[], object]


def main() -> None:
    """Measure, and print a Markdown table."""
    options = parse_options()
    torch.set_num_threads(options.threads)
    prepare_process()
    cases = [prepared(text, options.backend) for text in options.checkpoints]
    print(table(cases, cpu_times(cases, options.rounds)))


def prepared(text: str, backend: str) -> Case:
    """Return a checkpoint ready to run."""
    network, spec = network_at(text)
    estimator = DepthEstimator(network, spec, text, "cpu", backend)
    engine = checked_engine(network, spec, torch.device("cpu"), backend, "float32")
    error = relative_depth_error(engine, network, spec, ring_of_cameras(spec.height, spec.width))
    pictures = ring_of_pictures(spec.height, spec.width)
    estimator.estimate(pictures)
    name = f"{spec.kind}, {spec.height} x {spec.width}"
    return Case(name, engine.name, error, lambda: estimator.estimate(pictures))


def network_at(text: str) -> tuple[DepthNetwork, DepthModelSpec]:
    """Return the network of `CHECKPOINT[:HxW]`, and what it is for at that size."""
    name, _, size = text.partition(":")
    checkpoint = load_checkpoint(checkpoint_path(name))
    if not size:
        return checkpoint.build_depth_net(), checkpoint.spec
    height, width = map(int, size.split("x"))
    # Depth goes with fx / focal_scale, and fx with the width.
    focal_scale = checkpoint.spec.focal_scale * width / checkpoint.spec.width
    changes = {"height": height, "width": width, "focal_scale": focal_scale}
    spec = DepthModelSpec.model_validate(checkpoint.spec.model_dump() | changes)
    return replace(checkpoint, spec=spec).build_depth_net(), spec


def cpu_times(cases: Sequence[Case], rounds: int) -> list[list[float]]:
    """Return the milliseconds of CPU time of each case in every round."""
    spent: list[list[float]] = [[] for _ in cases]
    for _ in range(rounds):
        for case, times in zip(cases, spent, strict=True):
            began = time.process_time()
            case.estimate()
            times.append(1e3 * (time.process_time() - began))
    return spent


def table(cases: Sequence[Case], spent: Sequence[Sequence[float]]) -> str:
    """Return medians, and the median over the rounds of the ratio to the first case."""
    lines = ["| network | CPU ms a set | times the first | error, p99.9 | engine |", "|---|---|---|---|---|"]
    for case, times in zip(cases, spent, strict=True):
        ratio = statistics.median(own / first for own, first in zip(times, spent[0], strict=True))
        median = statistics.median(times)
        lines.append(f"| {case.name} | {median:.1f} | {ratio:.2f} | {case.error:.1e} | {case.engine} |")
    return "\n".join(lines)


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", metavar="CHECKPOINT[:HxW]", help="file, or 'default'")
    parser.add_argument("--backend", default="auto", choices=BACKENDS, help="[auto]")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args()


if __name__ == "__main__":
    main()
