# SPDX-License-Identifier: Apache-2.0
"""CPU time and memory of a training step: jitter, networks, every term, backward, optimiser. Prints JSON lines.

    python benchmarks/training_step.py
    python benchmarks/training_step.py --sizes 384x640 --against ../main_of_yesterday
    python benchmarks/training_step.py --device cuda --samples 4
    python benchmarks/training_step.py --threads 2 --busy 2

"step" is the trainer's own, in a process that is set up as `finetune` sets itself up; the baseline is the same step as
one writes it at first: one view after the other (camera_loop.py), plain Adam, the allocator as it comes. "networks" and
"objective" are the parts of our step. `--against` names checkouts of other commits, whose trainers make steps too.

Idle threads wait as those of `finetune` do; `GOMP_SPINCOUNT` in the environment has them spin longer, or not at all.

Every measurement has a process of its own, for the peak memory is its; cases take turns. Depth begins at 10 m: with the
1 to 2 m of random weights, neighbouring cameras would have nothing in common.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from measuring import Timings, busy_processes, json_lines, peak_memory_mb, print_line

if TYPE_CHECKING:
    from torch import Tensor

    from cvcdepth_core.training.batch import RigBatch
    from cvcdepth_core.training.model import SurroundModel
    from cvcdepth_core.training.trainer import Trainer

CAMERAS = 6
BASELINE, STEP, HALF, NETWORKS, OBJECTIVE = "camera loop", "step", "step, bfloat16", "networks", "objective"
RING_ORDER = (0, 2, 4, 5, 3, 1)  # front, front-right, back-right, back, back-left, front-left
INITIAL_DEPTH = 10.0  # metres
ROOT = Path(__file__).resolve().parents[1]

# Where a name is, and where it was in commits of November 2026.
_MODULES = {
    "RigBatch": ("training.batch", "rig_batch"),
    "Trainer": ("training.trainer", "training"),
    "TrainingConfig": ("training.config", "training_config"),
    "build_surround_model": ("training.starting_model", "starting_model"),
}

Work = Callable[[], object]


def main() -> None:
    options = parse_options()
    if options.case:
        print_line(measured_here(options))
        return
    with busy_processes(options.busy):
        for size in options.sizes:
            for line in compared(size, options):
                print_line(line)


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--samples", type=int, default=1, help="samples of six views per step")
    parser.add_argument("--sizes", nargs="+", default=["192x320", "384x640"], metavar="HxW")
    parser.add_argument("--encoder", default="resnet18", help="resnet18, resnet34 or efficientnet_lite0")
    parser.add_argument("--pose-method", default="front", help="front, joint_front, joint or per_camera")
    parser.add_argument(
        "--rounds", type=int, default=3, help="processes for each case, of one step each after the first"
    )
    parser.add_argument("--threads", type=int, default=1, help="CPU threads")
    parser.add_argument("--against", nargs="+", type=Path, default=[], metavar="CHECKOUT", help="other commits")
    parser.add_argument("--busy", type=int, default=0, help="foreign processes that use a processor each meanwhile")
    parser.add_argument("--case", help=argparse.SUPPRESS)  # what a process measures for the one that started it
    return parser.parse_args()


def compared(size: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Let the cases take turns at one size."""
    checkouts = dict.fromkeys((BASELINE, STEP, HALF, NETWORKS, OBJECTIVE), ROOT)
    checkouts |= {f"{STEP} of {path.name}": path.resolve() for path in options.against}
    timings = {case: Timings() for case in checkouts}
    peaks = dict.fromkeys(checkouts, 0.0)
    for _ in range(options.rounds):
        for case, checkout in checkouts.items():
            found = measured_there(case, checkout, size, options)
            timings[case].wall.append(found["wall"])
            timings[case].cpu.append(found["cpu"])
            peaks[case] = max(peaks[case], found["peak_memory_mb"])
    sizes = {"size": size, **{name: getattr(options, name) for name in ("samples", "encoder", "pose_method", "device")}}
    sizes["foreign processes"] = options.busy
    for line in json_lines("training_step", timings, BASELINE, sizes, options.device):
        yield line | {"peak_memory_mb": round(peaks[line["case"]]), "threads": options.threads}


def measured_there(case: str, checkout: Path, size: str, options: argparse.Namespace) -> dict[str, float]:
    """Measure in a process of its own, with the packages of a checkout."""
    from cvcdepth_ros.process_setup import openmp_environment  # not where an older checkout's packages are measured

    passed = ("device", "samples", "encoder", "pose_method", "threads")
    arguments = [f"--{name.replace('_', '-')}={getattr(options, name)}" for name in passed]
    finished = subprocess.run(
        [sys.executable, __file__, f"--case={case}", f"--sizes={size}", *arguments],
        env={**os.environ, **openmp_environment()}
        | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": str(options.threads)},
        stdout=subprocess.PIPE,
        check=True,
    )
    found: dict[str, float] = json.loads(finished.stdout)
    return found


def measured_here(options: argparse.Namespace) -> dict[str, float]:
    """Make one step to warm up and one that counts."""
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(options.threads)
    height, width = map(int, options.sizes[0].split("x"))
    with tempfile.TemporaryDirectory(prefix="cvcdepth_bench_") as folder:
        work = work_of(options, ring_of_cameras(options.samples, height, width).to(options.device), Path(folder))
        for _ in range(2):
            wall, cpu = time.perf_counter(), time.process_time()
            work()
            if options.device.startswith("cuda"):
                torch.cuda.synchronize()
            seconds = {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}
    return seconds | {"peak_memory_mb": peak_memory_mb(options.device)}


def work_of(options: argparse.Namespace, batch: RigBatch, folder: Path) -> Work:
    """Return what the case measures."""
    if options.case in (STEP, HALF, NETWORKS, OBJECTIVE):
        from cvcdepth_ros.process_setup import prepare_long_work

        prepare_long_work()
    if options.case.startswith(STEP):
        trainer = trainer_of(options, batch, folder, "bfloat16" if options.case == HALF else "none")
        trainer.model.train()
        return lambda: trainer._step([batch])
    if options.case == BASELINE:
        return loop_step(batch, model_of(options, batch).to(options.device))
    trainer = trainer_of(options, batch, folder, "none")
    return networks_of(batch, trainer) if options.case == NETWORKS else objective_of(batch, trainer)


def imported(name: str) -> Any:
    """Import a name from where it is in the checkout that this process runs with."""
    for module in _MODULES[name]:
        try:
            return getattr(importlib.import_module(f"cvcdepth_core.{module}"), name)
        except (ImportError, AttributeError):
            continue
    raise ImportError(f"{name} is in none of {_MODULES[name]}")


def config_of(options: argparse.Namespace, batch: RigBatch, autocast: str = "none") -> Any:
    height, width = batch.frames.shape[-2:]
    per_camera = options.pose_method == "per_camera"
    return imported("TrainingConfig").model_validate(
        {
            "depth": {
                "encoder": options.encoder,
                "height": height,
                "width": width,
                "min_depth": 1.5,
                "max_depth": 200.0,
            },
            "pose": {"encoder": options.encoder, "method": options.pose_method},
            "objective": {"pose_consistency": 0.1 if per_camera else 0.0},
            "optimizer": {
                "samples_per_step": options.samples,
                "samples_per_batch": options.samples,
                "autocast": autocast,
            },
        }
    )


def model_of(options: argparse.Namespace, batch: RigBatch) -> SurroundModel:
    """Return random networks whose depth begins at `INITIAL_DEPTH`."""
    import torch

    config = config_of(options, batch)
    model: SurroundModel = imported("build_surround_model")(config)
    nearest, farthest, scale = config.depth.min_depth, config.depth.max_depth, config.depth.focal_scale
    fx = float(batch.intrinsics[0, 0, 0, 0])
    disparity = (fx / scale / INITIAL_DEPTH - 1 / farthest) / (1 / nearest - 1 / farthest)
    bias = model.depth_net.depth_decoder.decoder[-1].conv.bias  # type: ignore[union-attr,index]
    torch.nn.init.constant_(bias, math.log(disparity / (1 - disparity)))  # type: ignore[arg-type]
    return model


def trainer_of(options: argparse.Namespace, batch: RigBatch, folder: Path, autocast: str) -> Trainer:
    trainer: Trainer = imported("Trainer")(
        config_of(options, batch, autocast),
        model_of(options, batch),
        _NoBatches(options.samples),
        folder,
        options.device,
    )
    return trainer


class _NoBatches:
    """The trainer is given its batch step by step."""

    def __init__(self, samples: int) -> None:
        self.samples = samples

    def epoch(self, number: int, first: int = 0) -> Iterator[RigBatch]:
        return iter(())


def loop_step(batch: RigBatch, model: SurroundModel) -> Work:
    import torch
    from camera_loop import loss_one_by_one, predict_one_by_one

    from cvcdepth_core.training.objective import ObjectiveConfig

    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4)

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        noise = torch.randn_like(batch.contexts[:, :, :, :1])
        loss_one_by_one(batch, predict_one_by_one(model, batch), ObjectiveConfig(), noise).backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    return step


def networks_of(batch: RigBatch, trainer: Trainer) -> Work:
    """Return forward and backward pass of both networks, with made-up gradients of what they give."""
    import torch

    from cvcdepth_core.training.objective import Prediction

    no_flip = torch.zeros(len(batch.frames), dtype=torch.bool, device=batch.frames.device)

    def step() -> None:
        prediction: Prediction = trainer.model(batch, batch.frames, no_flip, no_flip)
        outputs = [prediction.disparity, prediction.depth, prediction.motions]
        torch.autograd.backward(outputs, [torch.full_like(output, 1e-3) for output in outputs])

    return step


def objective_of(batch: RigBatch, trainer: Trainer) -> Work:
    """Return forward and backward pass of the objective, for what untrained networks give."""
    import torch

    from cvcdepth_core.training.objective import Prediction, evaluate_objective

    no_flip = torch.zeros(len(batch.frames), dtype=torch.bool, device=batch.frames.device)
    with torch.no_grad():
        given: Prediction = trainer.model(batch, batch.frames, no_flip, no_flip)

    def step() -> None:
        leaves = (part.detach().requires_grad_() for part in (given.disparity, given.depth, given.motions))
        evaluate_objective(batch, Prediction(*leaves), trainer.config.objective).loss.backward()  # type: ignore[no-untyped-call]

    return step


def ring_of_cameras(samples: int, height: int, width: int) -> RigBatch:
    """Return random smooth images of six cameras around a vehicle, 60 degrees apart, with 80 degrees of view."""
    import torch

    coarse = torch.rand(samples * 3 * CAMERAS, 3, height // 32, width // 32)
    frames = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)
    position = {camera: place for place, camera in enumerate(RING_ORDER)}
    poses = torch.stack([camera_pose(math.radians(60 * position[camera])) for camera in range(CAMERAS)])
    focal = width / 2 / math.tan(math.radians(40))
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    pairs = [(camera, RING_ORDER[(position[camera] + side) % CAMERAS]) for camera in range(CAMERAS) for side in (-1, 1)]
    batch: RigBatch = imported("RigBatch")(
        frames=frames.view(samples, 3, CAMERAS, 3, height, width),
        masks=torch.ones(samples, CAMERAS, 1, height, width),
        intrinsics=intrinsics.expand(samples, CAMERAS, 3, 3),
        base_T_camera=poses.expand(samples, CAMERAS, 4, 4),
        targets=torch.tensor([pair[0] for pair in pairs]),
        sources=torch.tensor([pair[1] for pair in pairs]),
        camera_names=[f"camera{index}" for index in range(CAMERAS)],
    )
    return batch


def camera_pose(yaw_right: float) -> Tensor:
    """Return base_T_camera of a camera 1 m from the vehicle's middle that looks `yaw_right` radians right of ahead."""
    import torch

    forward = torch.tensor([math.cos(yaw_right), -math.sin(yaw_right), 0.0])
    right = torch.tensor([-math.sin(yaw_right), -math.cos(yaw_right), 0.0])
    down = torch.tensor([0.0, 0.0, -1.0])
    pose = torch.eye(4)
    pose[:3] = torch.stack([right, down, forward, forward], dim=1)
    return pose


if __name__ == "__main__":
    main()
