# SPDX-License-Identifier: Apache-2.0
"""The whole node: recording -> topics -> node -> subscriber over DDS, against the baseline node.

    .venv/bin/python benchmarks/node.py [--height 192 --width 320] [--seconds 20] [--rate 2]

What `cvcdepth bench` measures on the sample, as two lines in the form of the other benchmarks. Needs rclpy.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
from pathlib import Path
from typing import Any

from measuring import circumstances, print_line

from cvcdepth_ros.bag_replay import main as cvcdepth

SAMPLE = Path(__file__).parent.parent / "samples" / "pandaset_002_excerpt"
_SHARED = ("median_ms", "p95_ms", "per_second", "outside_inference", "peak_memory_mb")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encoder", default="efficientnet_lite0", help="the default one is the default model's")
    parser.add_argument("--height", type=int, default=192)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=2.0, help="times 10 Hz: faster than the node is")
    options = parser.parse_args()
    result = measured(options)
    sizes = {"network": options.encoder, "picture": f"{options.height}x{options.width}", "rate": options.rate}
    for case, found in (("straightforward", result["baseline"]), ("node", result)):
        print_line(
            {
                "benchmark": "node",
                "case": case,
                **sizes,
                "rounds": found["sets_received"],
                **{name: found[name] for name in _SHARED},
                "age_p50_ms": found["age_ms"]["p50"],
                "age_p95_ms": found["age_ms"]["p95"],
                "inference_p50_ms": found["stages_ms"]["inference"]["p50_ms"],
                "baseline": "straightforward",
                "times_baseline": round(result["baseline"]["median_ms"] / found["median_ms"], 3),
                **circumstances(),
            }
        )


def measured(options: argparse.Namespace) -> dict[str, Any]:
    network = ["--untrained", "--encoder", options.encoder, "--height", str(options.height)]
    played = ["--width", str(options.width), "--seconds", str(options.seconds), "--rate", str(options.rate)]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = cvcdepth(["bench", str(SAMPLE), *network, *played])
    if code:
        raise SystemExit(code)
    result: dict[str, Any] = json.loads(printed.getvalue().splitlines()[-1])
    return result


if __name__ == "__main__":
    main()
