# SPDX-License-Identifier: Apache-2.0
"""How good confidence is: does it rank errors (sparsification), does it say how often depth is right (calibration).

Sparsification removes the least certain pixels first and looks at the mean error of the rest (Ilg et al., 2018). AUSE
is the area between that curve and the one of an oracle that removes the largest errors first; AURG is the area that is
won over removal at random. Both are divided by the error of all pixels: 0 would be the oracle's AUSE.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.view import PicturePart
from cvcdepth_core.scoring.ground_truth import sample_prediction
from cvcdepth_core.scoring.sparse_depth import SparseDepth

_STEPS = 100
_RIGHT_WITHIN = math.log(1.25)
_CLASSES = 10
_ERROR_BINS, _LARGEST_ERROR = 400, 2.0  # of |ln z|, for medians that can be merged


class ConfidenceSamples(NamedTuple):
    """Depth and confidence of one image where the truth is known."""

    prediction: NDArray[np.float64]
    """[M] metres."""
    confidence: NDArray[np.float64]
    """[M] in [0, 1]."""
    truth: NDArray[np.float64]
    """[M] metres."""


class Sparsification(NamedTuple):
    """How well confidence ranks one image's errors; NaN without pixels."""

    abs_rel: float
    """Mean relative error of all pixels."""
    surest_half: float
    """The same of the half with the largest confidence."""
    ause: float
    """Area between the curve of confidence and the oracle's, over `abs_rel`."""
    aurg: float
    """Area between `abs_rel` and the curve of confidence, over `abs_rel`; negative when worse than random."""


def confidence_samples(
    depth: NDArray[np.floating],
    confidence: NDArray[np.floating],
    truth: SparseDepth,
    min_depth: float = 0.0,
    max_depth: float = 80.0,
    part: PicturePart | None = None,
) -> ConfidenceSamples:
    """Sample depth and confidence [h, w] at the truth's pixels; predictions are clamped to the range as scores are.

    `part` is what of the truth's picture they show, as for `sample_prediction`. Left out are pixels without prediction
    and truth outside of the range (metres).
    """
    prediction, sure = (sample_prediction(picture, truth, part) for picture in (depth, confidence))
    counted = ~np.isnan(prediction) & ~np.isnan(sure) & (truth.depth > min_depth) & (truth.depth < max_depth)
    clamped = np.clip(prediction[counted], min_depth, max_depth)
    return ConfidenceSamples(clamped, sure[counted], truth.depth[counted])


def sparsification(samples: ConfidenceSamples) -> Sparsification:
    """Return how well one image's confidence ranks its errors; of equal confidence all orders count alike."""
    if not len(samples.truth):
        return Sparsification(math.nan, math.nan, math.nan, math.nan)
    error = np.abs(samples.prediction - samples.truth) / samples.truth
    whole = float(error.mean())
    curve = _curve(_tied_means(error, samples.confidence))
    if whole == 0:
        return Sparsification(0.0, 0.0, 0.0, 0.0)
    oracle = _curve(np.sort(error))
    ause, aurg = float((curve - oracle).mean()) / whole, float((whole - curve).mean()) / whole
    return Sparsification(whole, float(curve[_STEPS // 2]), ause, aurg)


def _tied_means(error: NDArray[np.float64], confidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the errors, most certain first, each the mean of those with the same confidence."""
    _, group = np.unique(-confidence, return_inverse=True)
    means = np.bincount(group, weights=error) / np.bincount(group)
    return np.asarray(means[np.sort(group)])


def _curve(error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of what is left after 0, 1, ... 99 percent of `error` [M] were removed from its end."""
    left = np.maximum(1, np.round(len(error) * (1 - np.arange(_STEPS) / _STEPS))).astype(np.int64)
    return np.asarray(np.cumsum(error)[left - 1] / left)


@dataclass(frozen=True, eq=False)
class CalibrationTable:
    """Counts by class of confidence, which can be added up over images and recordings."""

    confidence: NDArray[np.float64]
    """[10] sum of the confidence of each class's pixels."""
    right: NDArray[np.int64]
    """[10] pixels whose depth is right within a factor of 1.25."""
    errors: NDArray[np.int64]
    """[10, 401] pixels by |ln(prediction / truth)|, in steps of 0.005; the last column holds all larger ones."""

    @classmethod
    def empty(cls) -> CalibrationTable:
        """Return a table without pixels."""
        return cls(np.zeros(_CLASSES), np.zeros(_CLASSES, np.int64), np.zeros((_CLASSES, _ERROR_BINS + 1), np.int64))

    @classmethod
    def from_samples(cls, samples: ConfidenceSamples) -> CalibrationTable:
        """Count the pixels of one image."""
        of_class = np.clip((samples.confidence * _CLASSES).astype(np.int64), 0, _CLASSES - 1)
        log_error = np.abs(np.log(samples.prediction / samples.truth))
        step = np.minimum(log_error / _LARGEST_ERROR * _ERROR_BINS, _ERROR_BINS).astype(np.int64)
        errors = np.bincount(of_class * (_ERROR_BINS + 1) + step, minlength=_CLASSES * (_ERROR_BINS + 1))
        return cls(
            np.bincount(of_class, weights=samples.confidence, minlength=_CLASSES).astype(np.float64),
            np.bincount(of_class[log_error < _RIGHT_WITHIN], minlength=_CLASSES),
            errors.reshape(_CLASSES, _ERROR_BINS + 1),
        )

    def __add__(self, other: CalibrationTable) -> CalibrationTable:
        return CalibrationTable(
            self.confidence + other.confidence, self.right + other.right, self.errors + other.errors
        )

    @property
    def pixels(self) -> NDArray[np.int64]:
        """[10] pixels of each class: confidence 0 to 0.1, ... 0.9 to 1."""
        return np.asarray(self.errors.sum(axis=1))

    @property
    def predicted(self) -> NDArray[np.float64]:
        """[10] mean confidence, which is the predicted share of right pixels; NaN for an empty class."""
        return _ratio(self.confidence, self.pixels)

    @property
    def actual(self) -> NDArray[np.float64]:
        """[10] share of pixels that are right; NaN for an empty class."""
        return _ratio(self.right.astype(np.float64), self.pixels)

    @property
    def median_log_error(self) -> NDArray[np.float64]:
        """[10] median of |ln(prediction / truth)|, to 0.005; NaN for an empty class."""
        reached = self.errors.cumsum(axis=1) * 2 >= np.maximum(self.pixels, 1)[:, None]
        medians = (reached.argmax(axis=1) + 0.5) * (_LARGEST_ERROR / _ERROR_BINS)
        return np.where(self.pixels > 0, medians, np.nan)

    @property
    def expected_error(self) -> float:
        """Mean difference between predicted and actual share over the pixels; NaN without any."""
        if not self.pixels.sum():
            return math.nan
        gaps = np.abs(np.nan_to_num(self.predicted - self.actual))
        return float((gaps * self.pixels).sum() / self.pixels.sum())


def _ratio(sums: NDArray[np.float64], counts: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
