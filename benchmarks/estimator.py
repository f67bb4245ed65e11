# SPDX-License-Identifier: Apache-2.0
"""Six pictures in, six depth maps out, by every engine that is installed: time, memory, and how far the depth is off.

    python benchmarks/estimator.py [--rounds 10] [--threads 1] [--device cuda] [--networks efficientnet_lite0:192x320]

Each engine has a process of its own, whose peak memory it is, and they take turns. The baseline is ResNet-18 at
6 x 384 x 640 as torch runs it: all cameras as one batch, operation by operation, float32. `times_eager` compares with
the same for the same network and size. The engines run in processes set up like those of node and bag tool, which keep
freed buffers (`prepare_process`); "buffers kept" is the baseline in such a process. Weights are random: they change
nothing about the speed. A network is named by the encoder of the published one, or `rig_conditioned`. `gflop_per_cpu_s`
is the work of the network as it was trained over the CPU time of all threads, `of_matrix_product` its ratio to what a
thread reaches with large matrices, the limit of a core.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import numpy as np
from measuring import Timings, json_lines, measure_in_turns, peak_memory_mb, print_line, times_quicker
from numpy.typing import NDArray

if TYPE_CHECKING:
    from cvcdepth_core.networks import DepthModelSpec, DepthNetwork
    from cvcdepth_core.surround_depth import SurroundPictures

CAMERAS = 6
BASELINE = ("torch eager batch", "resnet18", 384, 640)
KEPT_BUFFERS = "torch eager batch, buffers kept"
CPU_BACKENDS = ("torch_eager", "torch", "ncnn", "openvino", "onnxruntime")
CUDA_BACKENDS = ("torch_eager", "torch", "torch_compiled", "onnxruntime", "tensorrt")

Case = tuple[str, str, int, int]
"""Engine (with its precision), encoder, height, width."""
Depth = NDArray[np.float32]


def main() -> None:
    options = parse_options()
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    for network in options.networks:
        for line in measured(network, options):
            print_line(line)


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument(
        "--networks",
        type=network_of,
        nargs="+",
        default=[
            ("resnet18", 384, 640),
            ("rig_conditioned", 160, 256),
            ("efficientnet_lite0", 192, 320),
            ("efficientnet_lite0", 384, 640),
        ],
        metavar="NETWORK:HxW",
    )
    return parser.parse_args()


def network_of(text: str) -> tuple[str, int, int]:
    name, _, size = text.partition(":")
    height, _, width = size.partition("x")
    return name, int(height), int(width)


def spec_of(network: tuple[str, int, int]) -> DepthModelSpec:
    """Return what the network is for; the depth range changes nothing about its speed."""
    from cvcdepth_core.networks.registry import RIG_CONDITIONED, DepthModelSpec

    name, height, width = network
    kind = {"network": name, "encoder": "efficientnet_lite0"} if name == RIG_CONDITIONED else {"encoder": name}
    return DepthModelSpec(height=height, width=width, min_depth=0.5, max_depth=100.0, **kind)  # type: ignore[arg-type]


def measured(network: tuple[str, int, int], options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Let the baseline and all engines of one network take turns."""
    eager: Case = (BASELINE[0], *network)
    cases = list(
        dict.fromkeys(
            [BASELINE, eager, (KEPT_BUFFERS, *network), *((engine, *network) for engine in engines(options.device))]
        )
    )
    workers = {case: Worker(case, options) for case in cases}
    depths = {case: worker.ask() for case, worker in workers.items()}
    timings = {case: Timings() for case in cases}
    for _ in range(options.rounds):
        for case, worker in workers.items():
            wall, cpu = worker.ask()
            timings[case].wall.append(wall)
            timings[case].cpu.append(cpu)
    memory = {case: worker.ask(finish=True) for case, worker in workers.items()}
    limit = gigaflops_of_matrix_product() if options.device == "cpu" else None
    names = {case: " ".join(map(str, case)) for case in cases}
    lines = json_lines("estimator", {names[case]: timings[case] for case in cases}, names[BASELINE], {}, options.device)
    for case, line in zip(cases, lines, strict=True):
        if case[1:] == network:
            own = {"case": case[0], "encoder": case[1], "cameras": CAMERAS, "size": f"{case[3]} x {case[2]}"}
            yield (
                line
                | own
                | {
                    "times_eager": round(times_quicker(timings[eager].wall, timings[case].wall), 3),
                    "times_eager_cpu": round(times_quicker(timings[eager].cpu, timings[case].cpu), 3),
                    **(rate_of(network, timings[case].median_cpu, limit) if limit else {}),
                    "relative_depth_difference_p99.9": float(f"{difference(depths[case], depths[eager]):.2g}"),
                    "peak_memory_mb": round(memory[case]),
                }
            )


def rate_of(network: tuple[str, int, int], cpu_seconds: float, limit: float) -> dict[str, float]:
    """Say how many GFLOP a second are done, and of how many that could be."""
    rate = 1e-9 * floating_point_operations(network) / cpu_seconds
    return {"gflop_per_cpu_s": round(rate, 1), "of_matrix_product": round(rate / limit, 3)}


@lru_cache
def floating_point_operations(network: tuple[str, int, int]) -> float:
    """Return what the convolutions of the network as it was trained ask for, for all cameras.

    An engine that rewrites it, or convolves by Winograd's method, computes less.
    """
    import torch
    from torch import nn

    from cvcdepth_core.engines.example_rigs import ring_of_cameras
    from cvcdepth_core.networks import build_depth_network

    spec = spec_of(network)
    done: list[float] = []

    def count(layer: nn.Module, _: object, output: torch.Tensor) -> None:
        done.append(2.0 * output.numel() * layer.weight[0].numel())  # type: ignore[operator,union-attr,index]

    counted = build_depth_network(spec).eval()
    for layer in counted.modules():
        if isinstance(layer, nn.Conv2d):
            layer.register_forward_hook(count)
    with torch.inference_mode():
        counted(ring_of_cameras(spec.height, spec.width).of_cameras([0]))
    return CAMERAS * sum(done)


def gigaflops_of_matrix_product(size: int = 1024, rounds: int = 7) -> float:
    """Return how many GFLOP one thread does in a second of CPU time where it only multiplies float32 matrices."""
    import torch

    threads, matrix = torch.get_num_threads(), torch.rand(size, size)
    torch.set_num_threads(1)
    timings = measure_in_turns({"": lambda: matrix @ matrix}, rounds)[""]
    torch.set_num_threads(threads)
    return 2e-9 * size**3 / timings.median_cpu


def engines(device: str) -> list[str]:
    """Name the engines that are installed, and on a GPU each precision."""
    from cvcdepth_core.engines import is_installed

    if device == "cpu":
        return [name for name in CPU_BACKENDS if is_installed(name)]
    half = [f"{name} bfloat16" for name in ("torch", "torch_compiled")]
    return [*(name for name in CUDA_BACKENDS if is_installed(name)), *half]


def difference(depth: Depth, exact: Depth) -> float:
    return float(np.quantile(np.abs(depth / exact - 1), 0.999))


class Worker:
    """One engine in a process of its own."""

    def __init__(self, case: Case, options: argparse.Namespace) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        arguments = (theirs, case, options.device, options.threads)
        self._process = context.Process(target=work, args=arguments, daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, finish: bool = False) -> Any:
        """Return the depth the first time, then seconds of wall and CPU time, and in the end the peak memory in MiB."""
        self._connection.send(finish)
        answer = self._connection.recv()
        if finish:
            self._process.join()
        return answer


def work(connection: Connection, case: Case, device: str, threads: int) -> None:
    """Answer what `Worker.ask` asks."""
    import torch

    from cvcdepth_ros.process_setup import prepare_process

    torch.set_num_threads(threads)
    if case[0] != BASELINE[0]:
        prepare_process()
    estimate = estimate_of(case, device)
    connection.recv()
    connection.send(estimate())
    while not connection.recv():
        wall, cpu = time.perf_counter(), time.process_time()
        estimate()
        connection.send((time.perf_counter() - wall, time.process_time() - cpu))
    connection.send(peak_memory_mb(device))


def estimate_of(case: Case, device: str) -> Callable[[], Depth]:
    """Return what is measured; pictures and weights are the same for every engine of a network."""
    from cvcdepth_core.engines.example_rigs import ring_of_pictures
    from cvcdepth_core.estimator import DepthEstimator, untrained_network

    engine, *network_and_size = case
    spec = spec_of(tuple(network_and_size))
    surround = ring_of_pictures(spec.height, spec.width)
    network = untrained_network(spec)
    if engine in (BASELINE[0], KEPT_BUFFERS):
        return straightforward(network, spec, surround, device)
    backend, _, precision = engine.partition(" ")
    estimator = DepthEstimator(network, spec, "random", device, backend, precision or "float32")  # type: ignore[arg-type]
    return lambda: estimator.estimate(surround)


def straightforward(
    network: DepthNetwork, spec: DepthModelSpec, surround: SurroundPictures, device: str
) -> Callable[[], Depth]:
    """Return the pipeline that anyone would write first: one batch through the network."""
    import torch

    from cvcdepth_core.networks import RigImages, disparity_to_depth

    network.eval().to(device)
    focal_lengths = torch.as_tensor(surround.fx, dtype=torch.float32, device=device)

    @torch.inference_mode()
    def estimate() -> Depth:
        disparity = network(RigImages.from_pictures(surround, device=device))[0]
        depth = disparity_to_depth(disparity, focal_lengths, spec.min_depth, spec.max_depth, spec.focal_scale)
        return depth[:, 0].cpu().numpy()  # type: ignore[no-any-return]

    return estimate


if __name__ == "__main__":
    main()
