# SPDX-License-Identifier: Apache-2.0
"""What geometric refinement costs beside the default model's inference: CPU time of a set on the sample.

    .venv/bin/python benchmarks/refinement.py [--rounds 10] [--threads 1]

The last of the sample's ten sets is refined again and again with the history of those before; `times_baseline_cpu` of a
case is inference over it, measured in turns.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from measuring import json_lines, measure_in_turns, print_line

from cvcdepth_core.estimator import DepthEstimator
from cvcdepth_core.refinement.alignment import AlignedSet, align
from cvcdepth_core.refinement.moments import SurroundMoment
from cvcdepth_core.refinement.refiner import SurroundRefiner
from cvcdepth_core.refinement.settings import RefinementSettings
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.surround_depth import SurroundPictures
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import MeasuredSet, open_evaluation
from cvcdepth_ros.process_setup import prepare_process

SAMPLE = Path(__file__).parent.parent / "samples" / "pandaset_002_excerpt"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    prepare_process()
    settings = EvaluationSettings(threads=options.threads)
    with open_evaluation(EvaluationJob("sample", str(SAMPLE), settings)) as evaluation:
        rig = evaluation.replay.rig
        moments = [taken(one) for one in evaluation.sets(*evaluation.window)]
        estimator = evaluation.depths.estimator
    torch.set_num_threads(options.threads)
    height, width = moments[0].depth.shape[1:]
    sizes = {"cameras": len(rig.cameras), "picture": f"{height}x{width}"}
    timings = measure_in_turns(cases(rig, moments, estimator), options.rounds)
    for line in json_lines("refinement", timings, "inference", sizes):
        print_line(line)


def taken(measured: MeasuredSet) -> SurroundMoment:
    """Put a measured set together."""
    rig, images, depth = measured.estimated.rig, measured.estimated.surround_set, measured.estimated.result
    return SurroundMoment(
        depth=depth.depth,
        pictures=depth.pictures,
        present=depth.present,
        intrinsics=depth.intrinsics,
        valid=~np.isnan(depth.depth),
        base_T_camera=np.stack([camera.base_T_camera for camera in rig.cameras]),
        times_ns=np.array([images.times_ns[name] for name in rig.names]),
        world_T_base=None if measured.world_T_base is None else np.stack(measured.world_T_base),
    )


def cases(rig: Rig, moments: list[SurroundMoment], estimator: DepthEstimator) -> dict[str, Callable[[], object]]:
    last = moments[-1]
    surround = SurroundPictures(last.pictures, last.present, last.intrinsics, last.base_T_camera, last.valid)
    found: dict[str, Callable[[], object]] = {"inference": lambda: estimator.estimate(surround)}
    for width in (160, 320):
        found[f"refinement, {width * 3 // 5}x{width}"] = refining(
            rig, moments, RefinementSettings(max_grid_width=width)
        )
    found["neighbours alone, 96x160"] = refining(rig, moments, RefinementSettings(distances=()))
    before, now = (AlignedSet.of(moment, 160) for moment in moments[-2:])
    found["alignment, 96x160"] = lambda: align(before, now)
    return found


def refining(rig: Rig, moments: list[SurroundMoment], settings: RefinementSettings) -> Callable[[], object]:
    """Refine the last moment with the history of the others, each time anew."""
    refiner = SurroundRefiner(rig.neighbour_indices, settings)
    for moment in moments[:-1]:
        refiner.refine(moment)
    return lambda: copy.deepcopy(refiner).refine(moments[-1])


if __name__ == "__main__":
    main()
