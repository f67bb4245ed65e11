# SPDX-License-Identifier: Apache-2.0
"""Whether an engine gives the depth that the network gives, asked once before it is used."""

from __future__ import annotations

import copy

import cv2
import numpy as np
import torch

from cvcdepth_core.engines.engine import DisparityEngine
from cvcdepth_core.errors import EngineError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.surround import to_tensor
from cvcdepth_core.model_choices import Precision
from cvcdepth_core.networks import DepthNet, disparity_to_depth
from cvcdepth_core.networks.checkpoint import DepthModelSpec

QUANTILE = 0.999
LARGEST_RELATIVE_ERRORS: dict[Precision, float] = {"float32": 1e-3, "float16": 1e-2, "bfloat16": 5e-2}
"""Largest relative error of depth, at the 99.9th percentile of the pixels, by what the engine computes in."""

_SMALL_HEIGHT, _SMALL_WIDTH = 96, 160


def check_parity(engine: DisparityEngine, network: DepthNet, spec: DepthModelSpec, precision: Precision) -> float:
    """Return the engine's relative depth error on one picture; EngineError gives the numbers when it is too large.

    The measure is the network itself in float64. A CPU would need seconds for that at the sizes that GPUs work at, so
    it is asked about a small picture, which costs a fifth of a second.
    """
    height, width = (spec.height, spec.width) if engine.device.type != "cpu" else _small(spec)
    error = relative_depth_error(engine, network, spec, street_like_picture(height, width))
    limit = LARGEST_RELATIVE_ERRORS[precision]
    if not error <= limit:
        raise EngineError(
            f"{engine.name}: relative depth error against float64 is {error:.2e} at the {100 * QUANTILE:g}th "
            f"percentile of the pixels, at most {limit:g} is accepted; use backend torch or torch_eager"
        )
    return error


@torch.inference_mode()
def relative_depth_error(engine: DisparityEngine, network: DepthNet, spec: DepthModelSpec, picture: Picture) -> float:
    """Return |depth / exact depth - 1| at the 99.9th percentile, NaN where the engine gives NaN."""
    images = to_tensor([picture], engine.device)
    fx = torch.full((1,), spec.focal_scale, dtype=torch.float64)
    reference = copy.deepcopy(network).to(engine.device).double().eval()
    exact, found = (
        disparity_to_depth(disparity.cpu().double(), fx, spec.min_depth, spec.max_depth, spec.focal_scale)
        for disparity in (reference(images.double()), engine.disparity(images))
    )
    return float(torch.quantile((found / exact - 1).abs().flatten(), QUANTILE))


def _small(spec: DepthModelSpec) -> tuple[int, int]:
    return min(spec.height, _SMALL_HEIGHT), min(spec.width, _SMALL_WIDTH)


def street_like_picture(height: int, width: int) -> Picture:
    """Return a picture [H, W, 3] with what pictures have: light from above, edges at all distances, fine texture."""
    rng = np.random.default_rng(0)
    picture = np.repeat(np.linspace(230, 60, height)[:, None, None], width, axis=1) + np.array([-10.0, 0.0, 10.0])
    for _ in range(40):
        size = rng.integers(4, height // 2, 2)
        corner = rng.integers(0, (width, height))
        cv2.rectangle(picture, corner, corner + size, rng.uniform(20, 235, 3).tolist(), thickness=-1)
    noisy = picture + rng.normal(0, 6, picture.shape)
    result: Picture = np.clip(noisy, 0, 255).astype(np.uint8)
    return result
