# SPDX-License-Identifier: Apache-2.0
"""The whole node: recording -> topics -> node -> subscriber over DDS, against the baseline node.

    .venv/bin/python benchmarks/node.py [--height 192 --width 320] [--seconds 20] [--rate 2]
    .venv/bin/python benchmarks/node.py --against ../main_of_yesterday --rounds 3
    .venv/bin/python benchmarks/node.py --busy 2

What `cvcdepth bench` measures on the sample, as lines in the form of the other benchmarks. Needs rclpy. `--against`
names checkouts of other commits, whose nodes take turns with ours; of several rounds the one with the median interval
between sets is told.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from measuring import busy_processes, circumstances, print_line

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "samples" / "pandaset_002_excerpt"
BASELINE, NODE = "straightforward", "node"
_SHARED = ("median_ms", "p95_ms", "per_second", "outside_inference", "peak_memory_mb")

Result = dict[str, Any]


def main() -> None:
    options = parse_options()
    found: dict[str, list[Result]] = {}
    with busy_processes(options.busy):
        for _ in range(options.rounds):
            ours = measured(ROOT, options)
            found.setdefault(BASELINE, []).append(ours["baseline"])
            found.setdefault(NODE, []).append(ours)
            for path in options.against:
                found.setdefault(f"{NODE} of {path.name}", []).append(
                    measured(path.resolve(), options, "--no-baseline")
                )
    median = {case: middle(results) for case, results in found.items()}
    for case, result in median.items():
        print_line(line_of(case, result, median[BASELINE], options))


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encoder", default="efficientnet_lite0", help="of a network with random weights")
    parser.add_argument("--height", type=int, default=192)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=2.0, help="times 10 Hz: faster than the node is")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--against", nargs="+", type=Path, default=[], metavar="CHECKOUT", help="other commits")
    parser.add_argument("--busy", type=int, default=0, help="foreign processes that use a processor each meanwhile")
    return parser.parse_args()


def measured(checkout: Path, options: argparse.Namespace, *more: str) -> Result:
    """Return what the `cvcdepth bench` of a checkout says."""
    network = ["--untrained", "--encoder", options.encoder, "--height", str(options.height)]
    played = ["--width", str(options.width), "--seconds", str(options.seconds), "--rate", str(options.rate)]
    finished = subprocess.run(
        [sys.executable, "-m", "cvcdepth_ros.bag_replay", "bench", str(SAMPLE), *network, *played, *more],
        env=os.environ | {"PYTHONPATH": str(checkout)},
        stdout=subprocess.PIPE,
        check=True,
    )
    result: Result = json.loads(finished.stdout.splitlines()[-1])
    return result


def middle(results: list[Result]) -> Result:
    """Return the result with the median interval between sets."""
    median = statistics.median_low(result["median_ms"] for result in results)
    return next(result for result in results if result["median_ms"] == median)


def line_of(case: str, result: Result, baseline: Result, options: argparse.Namespace) -> Result:
    return {
        "benchmark": "node",
        "case": case,
        "network": options.encoder,
        "picture": f"{options.height}x{options.width}",
        "rate": options.rate,
        "foreign processes": options.busy,
        "rounds": result["sets_received"],
        **{name: result[name] for name in _SHARED},
        "age_p50_ms": result["age_ms"]["p50"],
        "age_p95_ms": result["age_ms"]["p95"],
        "inference_p50_ms": result["stages_ms"]["inference"]["p50_ms"],
        "baseline": BASELINE,
        "times_baseline": round(baseline["median_ms"] / result["median_ms"], 3),
        **circumstances(),
    }


if __name__ == "__main__":
    main()
