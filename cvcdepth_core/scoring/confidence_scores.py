# SPDX-License-Identifier: Apache-2.0
"""The scores of confidence over many images: per camera, and how well it is calibrated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.files import nan_to_null
from cvcdepth_core.rig.view import PicturePart
from cvcdepth_core.scoring.confidence import CalibrationTable, Sparsification, confidence_samples, sparsification
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_core.surround_depth import SurroundDepth


@dataclass(frozen=True, eq=False)
class ConfidenceScores:
    """How good confidence is in one recording, or in several."""

    images: Mapping[str, NDArray[np.float64]]
    """By camera, [S, 4] each set's `Sparsification`; NaN without truth."""
    calibration: CalibrationTable
    """Of all pixels together."""

    @classmethod
    def merged(cls, parts: Iterable[ConfidenceScores]) -> ConfidenceScores:
        """Join the scores of several recordings."""
        images: dict[str, list[NDArray[np.float64]]] = {}
        calibration = CalibrationTable.empty()
        for part in parts:
            calibration = calibration + part.calibration
            for name, rows in part.images.items():
                images.setdefault(name, []).append(rows)
        return cls({name: np.concatenate(rows) for name, rows in images.items()}, calibration)

    @property
    def cameras(self) -> dict[str, Sparsification]:
        """The mean over each camera's images that have truth; NaN where none has."""
        return {name: _mean(rows) for name, rows in self.images.items()}

    @property
    def mean(self) -> Sparsification:
        """The mean over the cameras."""
        return _mean(np.array([list(found) for found in self.cameras.values()]).reshape(-1, 4))

    def to_json(self) -> dict[str, Any]:
        """Return the content for JSON, NaN as null."""
        table = self.calibration
        columns = ("predicted", "actual", "median_log_error")
        return {
            "mean": nan_to_null(self.mean._asdict()),
            "cameras": {name: nan_to_null(found._asdict()) for name, found in self.cameras.items()},
            "calibration": {
                "pixels": table.pixels.tolist(),
                **{name: [_or_null(number) for number in getattr(table, name).tolist()] for name in columns},
                "expected_error": _or_null(table.expected_error),
            },
        }

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything as arrays, the cameras' names in the keys."""
        table = self.calibration
        parts = {"confidence": table.confidence, "right": table.right, "errors": table.errors}
        return {f"image {name}": rows for name, rows in self.images.items()} | parts

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> ConfidenceScores:
        """Undo `to_arrays`; KeyError where the arrays are others."""
        table = CalibrationTable(arrays["confidence"], arrays["right"], arrays["errors"])
        images = {name.removeprefix("image "): rows for name, rows in arrays.items() if name.startswith("image ")}
        return cls(images, table)


class ConfidenceScorer:
    """Measures the confidence of a recording's sets, in order."""

    def __init__(self, cameras: Sequence[str], min_depth: float, max_depth: float) -> None:
        """Begin without sets; truth outside of the limits (metres) is left out."""
        self._limits = (min_depth, max_depth)
        self._rows: dict[str, list[Sparsification]] = {name: [] for name in cameras}
        self._calibration = CalibrationTable.empty()

    def add(self, surround: SurroundDepth, truth: Sequence[SparseDepth], parts: Sequence[PicturePart]) -> None:
        """Measure one set; one without confidence is passed over.

        Truth, and what of its picture the depth shows, are in the order of the cameras.
        """
        if surround.confidence is None:
            return
        for rows, depth, sure, known, part in zip(
            self._rows.values(), surround.depth, surround.confidence, truth, parts, strict=True
        ):
            samples = confidence_samples(depth, sure, known, *self._limits, part)
            rows.append(sparsification(samples))
            self._calibration = self._calibration + CalibrationTable.from_samples(samples)

    def scores(self) -> ConfidenceScores | None:
        """Return the scores of the sets so far; None where none had confidence."""
        if not any(self._rows.values()):
            return None
        return ConfidenceScores({name: np.array(rows) for name, rows in self._rows.items()}, self._calibration)


def _or_null(number: float) -> float | None:
    return None if math.isnan(number) else number


def _mean(rows: NDArray[np.float64]) -> Sparsification:
    known = rows[~np.isnan(rows).any(axis=1)]
    return Sparsification(*(known.mean(axis=0).tolist() if len(known) else [np.nan] * 4))
