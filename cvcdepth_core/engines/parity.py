# SPDX-License-Identifier: Apache-2.0
"""Whether an engine gives the depth that the network gives, asked once before it is used."""

from __future__ import annotations

import copy

import torch

from cvcdepth_core.engines.engine import DisparityEngine
from cvcdepth_core.engines.example_rigs import ring_of_cameras
from cvcdepth_core.errors import EngineError
from cvcdepth_core.model_choices import Precision
from cvcdepth_core.networks import DepthNetwork, RigImages, disparity_to_depth
from cvcdepth_core.networks.registry import DepthModelSpec

QUANTILE = 0.999
LARGEST_RELATIVE_ERRORS: dict[Precision, float] = {"float32": 1e-3, "float16": 1e-2, "bfloat16": 5e-2}
"""Largest relative error of depth, at the 99.9th percentile of the pixels, by what the engine computes in."""

_SMALL_HEIGHT, _SMALL_WIDTH = 96, 160


def check_parity(engine: DisparityEngine, network: DepthNetwork, spec: DepthModelSpec, precision: Precision) -> float:
    """Return the engine's relative depth error; EngineError gives the numbers when it is too large.

    The measure is the network itself in float64, on one picture where its cameras are independent, else on a whole rig
    with an absent camera.
    """
    error = relative_depth_error(engine, network, spec, _example(engine, network, spec))
    limit = LARGEST_RELATIVE_ERRORS[precision]
    if not error <= limit:
        raise EngineError(
            f"{engine.name}: relative depth error against float64 is {error:.2e} at the {100 * QUANTILE:g}th "
            f"percentile of the pixels, at most {limit:g} is accepted; use backend torch or torch_eager"
        )
    return error


@torch.inference_mode()
def relative_depth_error(engine: DisparityEngine, network: DepthNetwork, spec: DepthModelSpec, rig: RigImages) -> float:
    """Return |depth / exact depth - 1| of present cameras at the 99.9th percentile, NaN where the engine gives NaN."""
    rig = rig.to(engine.device)
    fx = torch.full((1,), spec.focal_scale, dtype=torch.float64)
    reference = copy.deepcopy(network).to(engine.device).double().eval()
    exact, found = (
        disparity_to_depth(disparity[rig.present].cpu().double(), fx, spec.min_depth, spec.max_depth, spec.focal_scale)
        for disparity in (reference(rig.to(dtype=torch.float64)), engine.disparity(rig))
    )
    return float(torch.quantile((found / exact - 1).abs().flatten(), QUANTILE))


def _example(engine: DisparityEngine, network: DepthNetwork, spec: DepthModelSpec) -> RigImages:
    """Return what the engine is asked about.

    A CPU would need seconds for float64 at the sizes that GPUs work at, so where one picture tells, it is a small one,
    which costs a fifth of a second.
    """
    if not network.independent:
        return ring_of_cameras(spec.height, spec.width)
    small = engine.device.type == "cpu"
    height = min(spec.height, _SMALL_HEIGHT) if small else spec.height
    width = min(spec.width, _SMALL_WIDTH) if small else spec.width
    return ring_of_cameras(height, width).of_cameras([0])
