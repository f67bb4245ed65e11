# SPDX-License-Identifier: Apache-2.0
"""What the geometric refinement looks for, and how closely.

The sweep's numbers were chosen on sets 14 to 29 of the sample recording, whose depth was spoilt by smooth random
factors before, because the default model knows those sets by heart; none was chosen on the held-out quarter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cvcdepth_core.errors import ConfigError


@dataclass(frozen=True)
class RefinementSettings:
    """Grid, hypotheses, sources and smoothness of the plane sweep."""

    max_grid_width: int = 160
    """Columns of the grid that is matched on, at most: pictures are halved until they are no wider."""
    bins: int = 17
    """Depth hypotheses of each pixel; odd, so that the prior itself is one."""
    largest_log_ratio: float = 0.8
    """Natural logarithm of the largest factor by which a hypothesis differs from the prior."""
    distances: tuple[float, ...] = (0.3, 1.2, 4.0)
    """Metres that a camera has moved, at least, since each of the earlier pictures that it is compared with."""
    use_neighbours: bool = True
    """Whether cameras are also compared with their neighbours' pictures of the same set."""
    prior_weight: float = 0.15
    """Cost of a hypothesis per unit of its log ratio's magnitude."""
    step_penalty: float = 0.15
    """Cost of each bin by which neighbouring pixels differ."""
    smoothing: float = 0.03
    """Edge of the square over which the regularised costs are averaged, as a share of the grid's width."""
    temperature: float = 0.2
    """Difference of cost that makes a hypothesis e times less likely."""

    def __post_init__(self) -> None:
        if self.bins < 5 or self.bins % 2 == 0:
            raise ConfigError(f"refinement: bins is {self.bins}, must be odd and at least 5")
        positive = ("max_grid_width", "largest_log_ratio", "step_penalty", "smoothing", "temperature")
        for name in positive:
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"refinement: {name} is {getattr(self, name)}, must be positive")
        if not all(0 < distance < math.inf for distance in self.distances):
            raise ConfigError(f"refinement: distances are {self.distances}, must be positive")

    @property
    def bin_width(self) -> float:
        """Log ratio between one hypothesis and the next."""
        return self.largest_log_ratio / (self.bins // 2)

    def log_ratios(self, device: torch.device | str = "cpu") -> Tensor:
        """Return the hypotheses' log ratios [bins] to the prior, ascending, the middle one exactly 0."""
        half = self.bins // 2
        return torch.arange(-half, half + 1, dtype=torch.float32, device=device) * self.bin_width
