# SPDX-License-Identifier: Apache-2.0
"""Depth metrics (Eigen et al., 2014) of one group of pixels, as sums that can be added up, and flip fusion."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

METRIC_NAMES = ("abs_rel", "sq_rel", "rmse", "rmse_log", "delta_1", "delta_2", "delta_3")

Sums = NDArray[np.void]
"""`ErrorSums` as elements of an array, of dtype `SUMS`."""


class ErrorSums(NamedTuple):
    """The errors of some pixels with known depth, added up."""

    truth: int
    """Pixels with known depth."""
    predicted: int
    """Those among them with a prediction, over which all that follows is summed."""
    abs_rel: float
    """|prediction - truth| / truth."""
    sq_rel: float
    """(prediction - truth)^2 / truth."""
    squared: float
    """(prediction - truth)^2, square metres."""
    squared_log: float
    """(ln prediction - ln truth)^2."""
    delta_1: int
    """Pixels whose ratio, the greater of prediction / truth and its inverse, is below 1.25."""
    delta_2: int
    """... below 1.25^2."""
    delta_3: int
    """... below 1.25^3."""


_COUNTED = ("truth", "predicted", "delta_1", "delta_2", "delta_3")
SUMS = np.dtype([(name, "<u4" if name in _COUNTED else "<f8") for name in ErrorSums._fields])
"""How arrays hold `ErrorSums`: 52 bytes each."""


def metrics_of(sums: Sums) -> NDArray[np.float64]:
    """Return the numbers of `METRIC_NAMES` [..., 7] of sums [...]; NaN where nothing was predicted."""
    n = np.where(sums["predicted"] > 0, sums["predicted"], np.nan)
    roots = (np.sqrt(sums["squared"] / n), np.sqrt(sums["squared_log"] / n))
    shares = (sums[f"delta_{power}"] / n for power in (1, 2, 3))
    return np.stack([sums["abs_rel"] / n, sums["sq_rel"] / n, *roots, *shares], axis=-1)


def sum_errors(prediction: NDArray[np.float64], truth: NDArray[np.float64]) -> ErrorSums:
    """Add up the errors of positive depths [M] in metres; `prediction` is NaN where there is none."""
    known = ~np.isnan(prediction)
    p, t = prediction[known], truth[known]
    ratio = np.maximum(p / t, t / p)
    difference = p - t
    return ErrorSums(
        len(truth),
        len(p),
        float((np.abs(difference) / t).sum()),
        float((difference**2 / t).sum()),
        float((difference**2).sum()),
        float((np.log(p / t) ** 2).sum()),
        *(int((ratio < 1.25**power).sum()) for power in (1, 2, 3)),
    )


def median_ratio(prediction: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Return median(truth) / median(prediction) over the pixels [M] that have both; NaN for none.

    Of an even number of values it is the lower of the middle two, as in the published evaluation.
    """
    known = ~np.isnan(prediction)
    if not known.any():
        return math.nan
    return _lower_median(truth[known]) / _lower_median(prediction[known])


def _lower_median(values: NDArray[np.float64]) -> float:
    middle = (len(values) - 1) // 2
    return float(np.partition(values, middle)[middle])
