# SPDX-License-Identifier: Apache-2.0
"""What each depth network costs: GMAC, parameters, CPU time and memory of one set of six. Prints JSON lines.

    python benchmarks/networks.py
    python benchmarks/networks.py --sizes 192x320 --networks per_camera vfdepth
    python benchmarks/networks.py --volume                          # VFDepth's volume against loops over cameras
    python benchmarks/networks.py --volume --backward

Networks run as torch_eager runs them, in a process each, for the peak memory is its. GMAC are those of convolutions and
matrix products, as torch counts them; reading a volume is not among them. With `--volume`, the baseline is the volume
as one writes it at first, camera by camera, its convolutions in the voxels and torch's own three-dimensional sampling.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from measuring import circumstances, json_lines, measure_in_turns, peak_memory_mb, print_line, summary

if TYPE_CHECKING:
    from torch import Tensor

    from cvcdepth_core.networks import DepthModelSpec, RigImages
    from cvcdepth_core.networks.vfdepth import FusedDepthNet

BASELINE = "per_camera"


def main() -> None:
    options = parse_options()
    if options.case:
        print_line(measured_here(options))
        return
    for size in options.sizes:
        for line in volumes(size, options) if options.volume else networks(size, options):
            print_line(line)


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["192x320", "384x640"], metavar="HxW")
    parser.add_argument("--networks", nargs="+", default=[BASELINE, "vfdepth"], metavar="NAME")
    parser.add_argument("--encoder", default="resnet18", help="resnet18, resnet34 or efficientnet_lite0")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1, help="CPU threads")
    parser.add_argument("--volume", action="store_true", help="VFDepth's volume and rays alone")
    parser.add_argument("--backward", action="store_true", help="their gradients too")
    parser.add_argument("--case", help=argparse.SUPPRESS)  # what a process measures for the one that started it
    return parser.parse_args()


def networks(size: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Measure each network in a process of its own."""
    passed = [f"--{name}={getattr(options, name)}" for name in ("encoder", "rounds", "threads")]
    baseline = None
    for name in options.networks:
        finished = subprocess.run(
            [sys.executable, __file__, f"--case={name}", f"--sizes={size}", *passed],
            env={**os.environ, "OMP_NUM_THREADS": str(options.threads)},
            stdout=subprocess.PIPE,
            check=True,
        )
        found = json.loads(finished.stdout)
        baseline = baseline or found
        yield found | {
            "baseline": baseline["case"],
            "times_baseline": round(baseline["median_ms"] / found["median_ms"], 3),
            "times_baseline_cpu": round(baseline["cpu_ms"] / found["cpu_ms"], 3),
            **circumstances(),
            "threads": options.threads,
        }


def measured_here(options: argparse.Namespace) -> dict[str, Any]:
    """Measure one network in this process."""
    import torch

    from cvcdepth_core.engines.torch_engine import TorchEagerEngine
    from cvcdepth_core.estimator import untrained_network

    torch.set_num_threads(options.threads)
    spec = spec_of(options.case, options.sizes[0], options.encoder)
    network, rig = untrained_network(spec), rig_of(spec)
    engine = TorchEagerEngine(network, torch.device("cpu"))
    timings = measure_in_turns({options.case: lambda: engine.disparity(rig)}, options.rounds)[options.case]
    peak = peak_memory_mb()  # before the counting, which runs once more
    return {
        "benchmark": "networks",
        "case": options.case,
        "size": options.sizes[0],
        "encoder": options.encoder,
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "gmac": round(gmac(lambda: engine.disparity(rig)), 1),
        **summary(timings.wall),
        "cpu_ms": round(1e3 * timings.median_cpu, 3),
        "peak_memory_mb": round(peak),
    }


def spec_of(network: str, size: str, encoder: str) -> DepthModelSpec:
    from cvcdepth_core.networks import DepthModelSpec

    height, width = map(int, size.split("x"))
    return DepthModelSpec(network=network, encoder=encoder, height=height, width=width, min_depth=1.5, max_depth=200.0)


def rig_of(spec: DepthModelSpec) -> RigImages:
    """Return one set of six cameras in a ring, all of them present."""
    import torch

    from cvcdepth_core.engines.example_rigs import ring_of_cameras

    rig = ring_of_cameras(spec.height, spec.width)
    return rig._replace(present=torch.ones_like(rig.present))


def gmac(work: Callable[[], object]) -> float:
    """Return the multiplications and additions of convolutions and matrix products, 1e9."""
    from torch.utils.flop_counter import FlopCounterMode

    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops() / 2e9


def volumes(size: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Let both forms of the volume take turns."""
    import torch

    from cvcdepth_core.estimator import untrained_network

    torch.set_num_threads(options.threads)
    spec = spec_of("vfdepth", size, options.encoder)
    network: Any = untrained_network(spec)
    rig = rig_of(spec)
    height, width = spec.height // 8, spec.width // 8
    features = torch.randn(6, network.volume.image_channels, height, width, requires_grad=options.backward)
    geometry = network.geometry(rig)

    def ours(kept: bool) -> Tensor:
        known = geometry if kept else network.geometry(rig)
        sampled: Tensor = known.rays.sum_of(network.fusion(features, known.fusion))
        return sampled

    def run(work: Callable[[], Tensor]) -> Callable[[], object]:
        def once() -> None:
            with torch.set_grad_enabled(options.backward):
                found = work()
                if options.backward:
                    found.sum().backward()  # type: ignore[no-untyped-call]

        return once

    cases = {
        "camera by camera": run(lambda: looped_volume(network, rig, features)),
        "all at once": run(lambda: ours(kept=False)),
        "all at once, geometry kept": run(lambda: ours(kept=True)),
    }
    timings = measure_in_turns(cases, options.rounds)
    sizes = {"size": size, "backward": options.backward}
    for line in json_lines("networks_volume", timings, "camera by camera", sizes):
        yield line | {"threads": options.threads}


def looped_volume(network: FusedDepthNet, rig: RigImages, features: Tensor) -> Tensor:
    """Return what the rays read [N, Q D, h, w] of one set, as it is written down at first."""
    import torch
    from torch.nn import functional as F  # noqa: N812

    from cvcdepth_core.networks.volume import project_voxels, ring_of

    volume, (height, width) = network.volume, features.shape[-2:]
    pixels, depth = project_voxels(volume, rig)
    grid = 2 * (pixels / pixels.new_tensor([width - 1, height - 1]) - 0.5)
    count, alone, slots = 0, 0, [0, 0]
    for camera, slot in enumerate(ring_of(rig.base_T_camera).slots[0].tolist()):
        seen = (depth[0, camera] > 0) & (grid[0, camera].abs() <= 1).all(dim=-1)
        read = F.grid_sample(features[camera, None], grid[:, camera, None], align_corners=True)[0, :, 0]
        found = torch.cat([read, depth[:, camera] / volume.depth_unit]) * seen
        count, alone, slots[slot] = count + seen.long(), alone + found, slots[slot] + found
    one = F.leaky_relu(network.fusion.alone(alone), 0.1) * (count == 1)
    two = F.leaky_relu(network.fusion.overlap(torch.cat(slots)), 0.1) * (count == 2)
    voxels = (one + two).view(1, -1, *reversed(volume.voxels))
    return torch.cat([seen_from(network, rig, voxels, camera) for camera in range(len(features))])


def seen_from(network: FusedDepthNet, rig: RigImages, voxels: Tensor, camera: int) -> Tensor:
    """Return what one camera's rays read [1, Q D, h, w]."""
    import torch
    from torch.nn import functional as F  # noqa: N812

    from cvcdepth_core.networks.volume import feature_intrinsics

    volume, (height, width) = network.volume, (extent // 8 for extent in rig.images.shape[-2:])
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rays = torch.linalg.inv(feature_intrinsics(rig.intrinsics[0, camera])) @ torch.stack(
        [u.flatten(), v.flatten(), torch.ones_like(u).flatten()]
    ).to(voxels)
    depths = torch.linspace(volume.nearest, volume.farthest, volume.steps)
    pose = rig.base_T_camera[0, camera]
    points = (pose[:3, :3] @ rays)[:, None] * depths[:, None] + pose[:3, 3:, None]
    first, last = (points.new_tensor(part)[:, None, None] for part in (volume.first_voxel, volume.last_voxel))
    grid = (2 * (points - first) / (last - first) - 1).view(1, 3, volume.steps, height, width).permute(0, 2, 3, 4, 1)
    return F.grid_sample(voxels, grid, align_corners=True).flatten(1, 2)


if __name__ == "__main__":
    main()
