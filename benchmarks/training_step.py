# SPDX-License-Identifier: Apache-2.0
"""Time and memory of one full training step: networks, every term, backward, optimiser. Prints one JSON line.

python benchmarks/training_step.py --samples 1
python benchmarks/training_step.py --device cuda --bf16 --samples 4
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from cvcdepth_core.networks import DepthNet, PoseNet
from cvcdepth_core.objective import ObjectiveConfig, Prediction, evaluate_objective
from cvcdepth_core.rig_batch import RigBatch
from cvcdepth_core.surround_model import SurroundModel

Result = TypeVar("Result")

CAMERAS = 6
RING_ORDER = (0, 2, 4, 5, 3, 1)  # front, front-right, back-right, back, back-left, front-left


def main() -> None:
    options = parse_options()
    torch.manual_seed(0)
    if options.threads:
        torch.set_num_threads(options.threads)
    batch = ring_of_cameras(options.samples, options.height, options.width).to(options.device)
    print(json.dumps(measure(options, batch)))


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
    parser.add_argument(
        "--clock", choices=["wall", "cpu"], default="wall", help="cpu: seconds of this process, for a shared machine"
    )
    parser.add_argument("--threads", type=int, default=0, help="CPU threads, 0 for torch's choice")
    return parser.parse_args()


def measure(options: argparse.Namespace, batch: RigBatch) -> dict[str, object]:
    model = SurroundModel(
        DepthNet(options.encoder),
        PoseNet(options.encoder),
        min_depth=1.5,
        max_depth=200.0,
        pose_method=options.pose_method,
    ).to(options.device)
    config = ObjectiveConfig(pose_consistency=0.1 if options.pose_method == "per_camera" else 0.0)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4)
    timings = [timed_step(options, model, batch, config, optimizer) for _ in range(options.steps + 1)][1:]
    step, networks, objective = (1000 * statistics.median(column) for column in zip(*timings, strict=True))
    return {
        "benchmark": "training_step",
        **{key.replace("-", "_"): value for key, value in vars(options).items()},
        "machine": machine(options.device),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "cpu_threads": torch.get_num_threads(),
        "load_average": round(os.getloadavg()[0], 1),
        "step_ms": round(step, 1),
        "networks_ms": round(networks, 1),
        "objective_ms": round(objective, 1),
        "share_outside_networks": round(1 - networks / step, 3),
        "peak_memory_gb": round(peak_memory(options.device), 2),
    }


def timed_step(
    options: argparse.Namespace,
    model: SurroundModel,
    batch: RigBatch,
    config: ObjectiveConfig,
    optimizer: torch.optim.Optimizer,
) -> tuple[float, float, float]:
    """Return seconds for the whole step, for both networks and for the objective, forward and backward each.

    The graph is cut between networks and objective, so that the two halves of the backward pass can be told apart; the
    gradients are those of an uncut step.
    """
    no_flip = torch.zeros(options.samples, dtype=torch.bool, device=options.device)

    def predict() -> Prediction:
        with torch.autocast(batch.frames.device.type, torch.bfloat16, enabled=options.bf16):
            return model(batch, batch.frames, no_flip, no_flip)  # type: ignore[no-any-return]

    began = now(options)
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
    return now(options) - began, forward + backward, objective


def backpropagate_objective(batch: RigBatch, prediction: Prediction, config: ObjectiveConfig) -> None:
    evaluate_objective(batch, prediction, config).loss.backward()  # type: ignore[no-untyped-call]


def timed(options: argparse.Namespace, work: Callable[[], Result]) -> tuple[Result, float]:
    began = now(options)
    result = work()
    if options.device.startswith("cuda"):
        torch.cuda.synchronize()
    return result, now(options) - began


def now(options: argparse.Namespace) -> float:
    return time.process_time() if options.clock == "cpu" else time.perf_counter()


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


def machine(device: str) -> str:
    if device.startswith("cuda"):
        return torch.cuda.get_device_name()
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{models[0] if models else platform.processor()}, {len(models) or '?'} CPUs"


def peak_memory(device: str) -> float:
    """Return GiB: what torch allocated on the GPU, or the process's greatest resident size on the CPU."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


if __name__ == "__main__":
    main()
