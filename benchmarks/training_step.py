# SPDX-License-Identifier: Apache-2.0
"""Time and memory of one full training step: networks, every term, backward, optimiser. Prints JSON lines.

The baseline is the same step with one view computed after the other (camera_loop.py); they take turns. "networks" and
"objective" are the parts of our step. Where others use the machine, read the CPU times.

python benchmarks/training_step.py --samples 1
python benchmarks/training_step.py --device cuda --bf16 --samples 4
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch
from camera_loop import loss_one_by_one, predict_one_by_one
from measuring import Timings, json_lines, peak_memory_mb, print_line
from numpy.typing import NDArray
from torch import Tensor

from cvcdepth_core.networks import DepthNet, PoseNet
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.model import SurroundModel
from cvcdepth_core.training.objective import ObjectiveConfig, Prediction, evaluate_objective

Result = TypeVar("Result")
Seconds = NDArray[np.float64]
"""[wall, CPU]."""

CAMERAS = 6
BASELINE = "camera loop"
PARTS = ("step", "networks", "objective")
RING_ORDER = (0, 2, 4, 5, 3, 1)  # front, front-right, back-right, back, back-left, front-left


def main() -> None:
    options = parse_options()
    torch.manual_seed(0)
    if options.threads:
        torch.set_num_threads(options.threads)
    batch = ring_of_cameras(options.samples, options.height, options.width).to(options.device)
    timings = measure(options, batch)
    sizes = {name: value for name, value in vars(options).items() if name not in ("steps", "threads")}
    for line in json_lines("training_step", timings, BASELINE, sizes, options.device):
        print_line(line | {"peak_memory_mb": round(peak_memory_mb(options.device)), "threads": torch.get_num_threads()})


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--samples", type=int, default=1, help="samples of six views per step")
    parser.add_argument("--height", type=int, default=384)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--encoder", default="resnet18", help="resnet18 or resnet34")
    parser.add_argument("--pose-method", default="front", help="front, joint_front, joint or per_camera")
    parser.add_argument("--bf16", action="store_true", help="run the networks under bfloat16 autocast")
    parser.add_argument("--steps", type=int, default=5, help="measured steps, after one to warm up")
    parser.add_argument("--threads", type=int, default=0, help="CPU threads, 0 for torch's choice")
    return parser.parse_args()


def measure(options: argparse.Namespace, batch: RigBatch) -> dict[str, Timings]:
    model = SurroundModel(
        DepthNet(options.encoder),
        PoseNet(options.encoder),
        min_depth=1.5,
        max_depth=200.0,
        pose_method=options.pose_method,
    ).to(options.device)
    config = ObjectiveConfig(pose_consistency=0.1 if options.pose_method == "per_camera" else 0.0)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4)
    steps = [
        (
            timed_loop_step(options, model, batch, config, optimizer),
            *timed_step(options, model, batch, config, optimizer),
        )
        for _ in range(options.steps + 1)
    ][1:]
    names = (BASELINE, *PARTS)
    columns = {name: np.stack(column).T.tolist() for name, column in zip(names, zip(*steps, strict=True), strict=True)}
    return {name: Timings(wall, cpu) for name, (wall, cpu) in columns.items()}


def timed_loop_step(
    options: argparse.Namespace,
    model: SurroundModel,
    batch: RigBatch,
    config: ObjectiveConfig,
    optimizer: torch.optim.Optimizer,
) -> Seconds:
    """Return seconds for the whole step of the baseline."""

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        with torch.autocast(batch.frames.device.type, torch.bfloat16, enabled=options.bf16):
            prediction = predict_one_by_one(model, batch)
        noise = torch.randn_like(batch.contexts[:, :, :, :1])
        loss_one_by_one(batch, prediction, config, noise).backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    return timed(options, step)[1]


def timed_step(
    options: argparse.Namespace,
    model: SurroundModel,
    batch: RigBatch,
    config: ObjectiveConfig,
    optimizer: torch.optim.Optimizer,
) -> tuple[Seconds, Seconds, Seconds]:
    """Return seconds for the whole step, for both networks and for the objective, forward and backward each.

    The graph is cut between networks and objective, so that the two halves of the backward pass can be told apart; the
    gradients are those of an uncut step.
    """
    no_flip = torch.zeros(options.samples, dtype=torch.bool, device=options.device)

    def predict() -> Prediction:
        with torch.autocast(batch.frames.device.type, torch.bfloat16, enabled=options.bf16):
            return model(batch, batch.frames, no_flip, no_flip)  # type: ignore[no-any-return]

    began = now()
    optimizer.zero_grad(set_to_none=True)
    prediction, forward = timed(options, predict)
    leaves = [
        tensor.detach().requires_grad_() for tensor in (prediction.disparity, prediction.depth, prediction.motions)
    ]
    _, objective = timed(options, lambda: backpropagate_objective(batch, Prediction(*leaves), config))
    outputs = [prediction.disparity, prediction.depth, prediction.motions]
    gradients = [leaf.grad for leaf in leaves]
    _, backward = timed(options, lambda: torch.autograd.backward(outputs, gradients))
    timed(options, optimizer.step)
    return now() - began, forward + backward, objective


def backpropagate_objective(batch: RigBatch, prediction: Prediction, config: ObjectiveConfig) -> None:
    evaluate_objective(batch, prediction, config).loss.backward()  # type: ignore[no-untyped-call]


def timed(options: argparse.Namespace, work: Callable[[], Result]) -> tuple[Result, Seconds]:
    began = now()
    result = work()
    if options.device.startswith("cuda"):
        torch.cuda.synchronize()
    return result, now() - began


def now() -> Seconds:
    return np.array([time.perf_counter(), time.process_time()])


def ring_of_cameras(samples: int, height: int, width: int) -> RigBatch:
    """Return random smooth images of six cameras around a vehicle, 60 degrees apart, with 80 degrees of view."""
    coarse = torch.rand(samples * 3 * CAMERAS, 3, height // 32, width // 32)
    frames = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)
    position = {camera: place for place, camera in enumerate(RING_ORDER)}
    poses = torch.stack([camera_pose(math.radians(60 * position[camera])) for camera in range(CAMERAS)])
    focal = width / 2 / math.tan(math.radians(40))
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    pairs = [(camera, RING_ORDER[(position[camera] + side) % CAMERAS]) for camera in range(CAMERAS) for side in (-1, 1)]
    return RigBatch(
        frames=frames.view(samples, 3, CAMERAS, 3, height, width),
        masks=torch.ones(samples, CAMERAS, 1, height, width),
        intrinsics=intrinsics.expand(samples, CAMERAS, 3, 3),
        base_T_camera=poses.expand(samples, CAMERAS, 4, 4),
        targets=torch.tensor([pair[0] for pair in pairs]),
        sources=torch.tensor([pair[1] for pair in pairs]),
        camera_names=[f"camera{index}" for index in range(CAMERAS)],
    )


def camera_pose(yaw_right: float) -> Tensor:
    """Return base_T_camera of a camera 1 m from the vehicle's middle that looks `yaw_right` radians right of ahead."""
    forward = torch.tensor([math.cos(yaw_right), -math.sin(yaw_right), 0.0])
    right = torch.tensor([-math.sin(yaw_right), -math.cos(yaw_right), 0.0])
    down = torch.tensor([0.0, 0.0, -1.0])
    pose = torch.eye(4)
    pose[:3] = torch.stack([right, down, forward, forward], dim=1)
    return pose


if __name__ == "__main__":
    main()
