# SPDX-License-Identifier: Apache-2.0
"""How long the merged cloud of a surround set takes, from depth to the message's field, in one thread.

    .venv/bin/python benchmarks/cloud.py [--height 384 --width 640] [--rounds 30]

All cases end in the `array.array` that rclpy's PointCloud2 takes. The baseline works on whole cameras in numpy.
"""

from __future__ import annotations

import argparse
import array
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from measuring import json_lines, measure_in_turns, print_line
from numpy.typing import NDArray

from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.pointcloud import CloudLimits, merged_cloud
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.bench.baseline_cloud import baseline_cloud
from cvcdepth_ros.process_setup import prepare_process
from cvcdepth_ros.recordings.rig import discover_rig

SAMPLE = Path(__file__).parent.parent / "samples" / "pandaset_002_excerpt"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=int, default=384)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--rounds", type=int, default=30)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    prepare_process()
    with open_recording(SAMPLE) as recording:
        rig = discover_rig(recording).complete()
    surround = slanted_walls(rig, options.height, options.width)
    sizes = {"cameras": len(rig.cameras), "picture": f"{options.height}x{options.width}"}
    timings = measure_in_turns(cases(surround, rig), options.rounds)
    for line in json_lines("cloud", timings, "straightforward", sizes):
        print_line(line)


def cases(surround: SurroundDepth, rig: Rig) -> dict[str, Callable[[], object]]:
    everything, near = CloudLimits(), CloudLimits(1, 0.5, 80.0)
    return {
        "straightforward": lambda: array.array("B", baseline_cloud(surround, rig, everything).tobytes()),
        "all points": lambda: field(merged_cloud(surround, rig, everything)),
        "0.5 to 80 m": lambda: field(merged_cloud(surround, rig, near)),
        "0.5 to 80 m, stride 2": lambda: field(merged_cloud(surround, rig, CloudLimits(2, 0.5, 80.0))),
        "0.5 to 80 m, 0.2 m voxels": lambda: field(merged_cloud(surround, rig, CloudLimits(1, 0.5, 80.0, 0.2))),
    }


def field(cloud: NDArray[np.float32]) -> array.array[int]:
    """Fill what the message's `data` takes without looking at every byte."""
    content = array.array("B")
    content.frombytes(cloud.view(np.uint8).data.cast("B"))
    return content


def slanted_walls(rig: Rig, height: int, width: int) -> SurroundDepth:
    """Depth from 2 to 100 m, so that a fifth of it is beyond the range limit, and pictures of noise."""
    cameras = len(rig.cameras)
    depth = np.broadcast_to(np.linspace(100.0, 2.0, height, dtype=np.float32)[None, :, None], (cameras, height, width))
    pictures = np.random.default_rng(0).integers(0, 256, (cameras, height, width, 3), dtype=np.uint8)
    intrinsics = SurroundPreprocessor(rig, height, width).intrinsics
    return SurroundDepth(depth.copy(), pictures, intrinsics, np.ones(cameras, bool))


if __name__ == "__main__":
    main()
