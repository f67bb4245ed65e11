# SPDX-License-Identifier: Apache-2.0
"""Pictures of a training step: input, depth, rendered views, errors and masks."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.objective import ObjectiveConfig, Prediction, masked_errors, synthesise_views
from cvcdepth_core.visualization import DepthScale

_GREATEST_ERROR = 0.5  # photometric; of consistent depth: relative


def training_pictures(batch: RigBatch, prediction: Prediction, config: ObjectiveConfig) -> dict[str, Picture]:
    """Draw the first sample, all cameras side by side in the rig's order; by name.

    `input`; `depth`; `from_before` and `from_neighbours`, the input as it is rendered from other pictures; and for each
    term of the objective the `error_...` inside of its mask, black to yellow up to 0.5 (depth consistency: relative to
    the depth), and the `mask_...`.
    """
    with torch.inference_mode():
        views = synthesise_views(batch, prediction, config)
        # Given, not drawn: who looks at a run must not change its random numbers.
        no_noise = torch.zeros_like(views.temporal_masks)
        errors = masked_errors(batch, prediction, views, config, no_noise)
    depth = prediction.depth[0, :, 0].float().cpu().numpy()
    pictures = {
        "input": _side_by_side(_colours(batch.images[0])),
        "depth": _side_by_side(DepthScale().colours(depth)),
        "from_before": _side_by_side(_colours(views.temporal[0, 0] * views.temporal_masks[0, 0])),
    }
    if views.overlap.parts:
        seen = views.overlap.images[0, 0] * (views.overlap.masks[0, 0] > 0)
        pictures["from_neighbours"] = _side_by_side(_colours(seen))
    for name, (error, mask) in errors.items():
        shown, seen = (part[:, 0] if part.ndim == 6 else part for part in (error, mask))
        in_metres = name == "depth_consistency" and config.depth_difference == "metres"
        scaled = shown / prediction.depth if in_metres else shown
        pictures[f"error_{name}"] = _side_by_side(_heat(scaled[0, :, 0] * (seen[0, :, 0] > 0)))
        pictures[f"mask_{name}"] = _side_by_side(_colours(seen[0].expand(-1, 3, -1, -1)))
    return pictures


def _colours(images: Tensor) -> NDArray[np.uint8]:
    """Return images [N, 3, H, W] in [0, 1] as RGB [N, H, W, 3]."""
    bytes_: NDArray[np.uint8] = (images.float().clamp(0, 1) * 255).byte().permute(0, 2, 3, 1).cpu().numpy()
    return bytes_


def _heat(errors: Tensor) -> NDArray[np.uint8]:
    """Colour errors [N, H, W] as RGB [N, H, W, 3]."""
    shares = (errors.float() / _GREATEST_ERROR).nan_to_num(0.0).clamp(0, 1).cpu().numpy()
    levels = np.rint(255 * shares).astype(np.uint8)
    return np.stack([cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1] for level in levels])


def _side_by_side(pictures: NDArray[np.uint8]) -> Picture:
    return np.concatenate(list(pictures), axis=1)
