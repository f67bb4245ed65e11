# SPDX-License-Identifier: Apache-2.0
"""How well the sky is told from what has depth, where the truth tells either."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.view import PicturePart
from cvcdepth_core.scoring.ground_truth import sample_prediction
from cvcdepth_core.scoring.sparse_depth import SparseDepth


class SkyCounts(NamedTuple):
    """Numbers of pixels; those of several images add up."""

    pixels: int = 0
    """That show the sky, with a depth."""
    far: int = 0
    """Among them, those taken for sky, or whose depth is far."""
    found: int = 0
    """That show the sky and were taken for it."""
    missed: int = 0
    """That show the sky and were not."""
    invented: int = 0
    """That have a true depth and were taken for sky."""
    solid: int = 0
    """That have a true depth."""

    def __add__(self, other: object) -> SkyCounts:
        """Return the sums."""
        if not isinstance(other, SkyCounts):
            return NotImplemented
        return SkyCounts(*(a + b for a, b in zip(self, other, strict=True)))

    @property
    def iou(self) -> float | None:
        """Intersection over union of the sky; None where the truth knows no sky."""
        if not self.found + self.missed:
            return None
        return self.found / (self.found + self.missed + self.invented)

    def to_json(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {**self._asdict(), "iou": self.iou}


def sky_counts(
    truth: SparseDepth, depth: NDArray[np.float32], seen: NDArray[np.bool_], part: PicturePart, far: float
) -> SkyCounts:
    """Count one image; `depth` [h, w] and what is taken for sky [h, w] show a `part` of the truth's picture."""
    rows, columns = truth.sky.T
    sky = SparseDepth(rows, columns, np.zeros(len(rows)), truth.height, truth.width)
    sky_depth = sample_prediction(depth, sky, part)
    in_sky, in_solid = (sample_prediction(seen.astype(np.float32), places, part) for places in (sky, truth))
    return SkyCounts(
        pixels=int((~np.isnan(sky_depth)).sum()),
        far=int(((sky_depth > far) | (in_sky > 0.5) & ~np.isnan(sky_depth)).sum()),
        found=int((in_sky > 0.5).sum()),
        missed=int((in_sky <= 0.5).sum()),
        invented=int((in_solid > 0.5).sum()),
        solid=int((~np.isnan(in_solid)).sum()),
    )
