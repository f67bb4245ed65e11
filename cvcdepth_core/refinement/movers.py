# SPDX-License-Identifier: Apache-2.0
"""What drives ahead of the vehicle moves with it, hence hardly in the picture, and matches as if it were far away.

Pictures of one camera cannot tell a vehicle ahead from a distant one. So along the way, where such traffic is, earlier
pictures may not move depth much farther than the prior has it; nearer they may, and to the sides both ways.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_INNER, _OUTER = math.radians(10.0), math.radians(40.0)  # angles from the way: full guard, none
_FREE_LOG_RATIO = 0.35  # that costs nothing straight along the way
_COST = 1.0  # per unit of log ratio beyond


def guard_cost(
    way: NDArray[np.float64], intrinsics: NDArray[np.float64], size: tuple[int, int], log_ratios: Tensor
) -> Tensor:
    """Return the cost [bins, h, w] of hypotheses that would be a vehicle ahead taken for a distant one.

    `way` [3] is how the camera moved, in its own frame (any length but 0); `intrinsics` [3, 3] are of `size` (h, w).
    """
    openness = (_angles(way, intrinsics, size).to(log_ratios.device) - _INNER) / (_OUTER - _INNER)
    most = float(log_ratios.max())
    free = _FREE_LOG_RATIO + (most - _FREE_LOG_RATIO) * openness.clamp(0.0, 1.0)
    return (log_ratios[:, None, None] - free).clamp(min=0.0) * _COST


def _angles(way: NDArray[np.float64], intrinsics: NDArray[np.float64], size: tuple[int, int]) -> Tensor:
    """Return the angle [h, w] (rad) between each pixel's ray and the line of the way."""
    height, width = size
    a = np.linalg.inv(intrinsics)
    u, v = torch.arange(width, dtype=torch.float32)[None], torch.arange(height, dtype=torch.float32)[:, None]
    rows = [*a.tolist(), (way / np.linalg.norm(way) @ a).tolist()]
    x, y, z, along = (row[0] * u + row[1] * v + row[2] for row in rows)
    cosine: Tensor = along.abs() / (x.square() + y.square() + z.square()).sqrt()
    return cosine.clamp_(max=1.0).acos_()
