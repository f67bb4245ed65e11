# SPDX-License-Identifier: Apache-2.0
"""From how a posterior looks to how often depth is right: a monotone map, found where the truth or a witness is known.

Published confidence is the probability that depth is right within a factor of 1.25; 0 where nothing could be checked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvcdepth_core.errors import ConfigError

RIGHT_WITHIN = math.log(1.25)
"""Log ratio within which depth counts as right, as in the metric delta < 1.25."""

_BY_FINENESS, _BY_LOG_RATIO = 0.05, 0.06
_LEAST_CONTRAST = 0.05
_DOUBTED, _TRUSTED = 0.3, 0.5  # probability below which no correction is made, and from which on all of it


@dataclass(frozen=True)
class ConfidenceMap:
    """Takes raw confidence to the probability that depth is right: linear between knots, constant beyond them."""

    raw: tuple[float, ...]
    """Ascending."""
    probability: tuple[float, ...]
    """Of the same length, in [0, 1], not descending."""

    def __post_init__(self) -> None:
        ascending = all(a < b for a, b in pairwise(self.raw))
        monotone = all(a <= b for a, b in pairwise(self.probability))
        if not self.raw or len(self.raw) != len(self.probability) or not ascending or not monotone:
            raise ConfigError(f"confidence map: knots {self.raw} and {self.probability} are no monotone function")

    def __call__(self, raw: Tensor) -> Tensor:
        """Return the probabilities of `raw` [...]; NaN stays NaN."""
        mapped = np.interp(raw.cpu().numpy(), self.raw, self.probability)
        return torch.from_numpy(mapped).to(raw)


# What `tools/refinement_trial.py --fit-confidence` prints: sets 13 to 29 of the sample recording, their depth spoilt so
# that it is as if never seen, LiDAR for truth. On the held-out quarter they are off by 0.02 of probability on average.
REFINED_CONFIDENCE = ConfidenceMap(
    (0.727, 0.840, 0.873, 0.892, 0.905, 0.916, 0.927, 0.937, 0.947, 0.956, 0.965, 0.973, 0.980, 0.986, 0.991, 0.996),
    (0.358, 0.421, 0.542, 0.628, 0.681, 0.712, 0.746, 0.775, 0.810, 0.847, 0.878, 0.907, 0.931, 0.945, 0.964, 0.979),
)
"""Of refined depth, from `raw_confidence`."""
PRIOR_CONFIDENCE = ConfidenceMap(
    (0.124, 0.372, 0.553, 0.676, 0.758, 0.812, 0.850, 0.878, 0.898, 0.915, 0.931, 0.947, 0.963, 0.977, 0.990, 0.998),
    (0.176, 0.226, 0.298, 0.362, 0.417, 0.492, 0.561, 0.640, 0.733, 0.792, 0.829, 0.858, 0.888, 0.913, 0.940, 0.965),
)
"""Of depth before refinement; raw: probability of the hypotheses within a factor of 1.25 of it."""


class ConfidenceMaps(NamedTuple):
    """What a checkpoint's raw confidence means."""

    refined: ConfidenceMap = REFINED_CONFIDENCE
    prior: ConfidenceMap = PRIOR_CONFIDENCE


SHIPPED_MAPS = ConfidenceMaps()


def raw_confidence(peak: Tensor, log_ratio: Tensor, fineness: Tensor) -> Tensor:
    """Return what ranks refined depth best, in [0, 1]; all arguments have the same shape.

    It is the probability of the posterior's peak, a little less where depth was moved far and where the sources were
    coarse. The two small exponents were chosen by AUSE on sets 14 to 29 of the sample recording.
    """
    return peak * fineness.clamp(min=1e-3).pow(_BY_FINENESS) * (-_BY_LOG_RATIO * log_ratio.abs()).exp()


def trusted_share(raw: Tensor) -> Tensor:
    """Return how much of a correction is made, in [0, 1]: less the likelier it is wrong; `raw` is raw confidence."""
    return ((REFINED_CONFIDENCE(raw) - _DOUBTED) / (_TRUSTED - _DOUBTED)).clamp(0.0, 1.0)


def checked_share(contrast: Tensor) -> Tensor:
    """Return how far texture allows a check, in [0, 1]: 0 where it shows nothing, 1 where it shows a little.

    `contrast` is the cost's, averaged over some pixels. What is smooth between textured places is often right, but
    nobody has looked.
    """
    return (contrast / _LEAST_CONTRAST).clamp(max=1.0)


def fit_confidence_map(raw: NDArray[np.floating], right: NDArray[np.bool_], knots: int = 12) -> ConfidenceMap:
    """Fit a map to pixels [M] with raw confidence of which it is known, or witnessed, whether depth was right.

    Pixels are put into classes of equal size; shares that descend are pooled (isotonic regression by pool adjacent
    violators; Ayer et al., 1955). Raises ConfigError for fewer pixels than `knots`.
    """
    if len(raw) < knots:
        raise ConfigError(f"confidence map: {len(raw)} pixels, at least {knots} are needed")
    order = np.argsort(raw, kind="stable")
    pools: list[tuple[float, float, int]] = []  # sums of raw and right, count
    for part in np.array_split(order, knots):
        pools.append((float(raw[part].sum()), float(right[part].sum()), len(part)))
        while len(pools) > 1 and _share(pools[-2]) >= _share(pools[-1]):
            later, earlier = pools.pop(), pools.pop()
            pools.append((earlier[0] + later[0], earlier[1] + later[1], earlier[2] + later[2]))
    ascending = [pools[0], *(b for a, b in pairwise(pools) if b[0] / b[2] > a[0] / a[2])]
    return ConfidenceMap(tuple(pool[0] / pool[2] for pool in ascending), tuple(_share(pool) for pool in ascending))


def _share(pool: tuple[float, float, int]) -> float:
    return pool[1] / pool[2]
