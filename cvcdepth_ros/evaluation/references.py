# SPDX-License-Identifier: Apache-2.0
"""What looks at no picture, scored beside the model at the same pixels: any model that is of use beats it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.rendering.agreement import PosedDepth
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.scoring.consistency import AgreementTable, spatial_rows, temporal_rows
from cvcdepth_core.scoring.ground_truth import sample_prediction
from cvcdepth_core.scoring.references import best_constant, ground_plane_depth
from cvcdepth_core.scoring.scorer import DepthSamples, SurroundScorer
from cvcdepth_core.scoring.scores import Scores, ScoreSettings
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_ros.evaluation.job import EvaluationJob

CONSTANT, BEST_CONSTANT, GROUND = "constant", "best_constant", "ground_plane"
REFERENCES = (CONSTANT, BEST_CONSTANT, GROUND)
"""The same depth everywhere; for each image the constant with the least Abs Rel, which only the truth tells; flat
ground."""


@dataclass(frozen=True, eq=False)
class ReferenceScores:
    """One reference's scores on one recording."""

    scores: Scores
    """Against truth, all pixels together (no ranges)."""
    agreement: AgreementTable
    """Label-free comparisons; empty where there is truth, or the reference needs truth."""


class ReferenceScoring:
    """Scores every reference set by set, where the model has depth."""

    def __init__(self, job: EvaluationJob, rig: Rig, size: tuple[int, int], *, is_without_truth: bool) -> None:
        """Begin without sets; `size` is that of the model's depth (H, W).

        Comparing depth with itself costs more than comparing it with truth: that is done `is_without_truth` only.
        """
        settings = job.settings
        score_settings = ScoreSettings(min_depth=settings.min_depth, max_depth=settings.max_depth, range_edges=())
        self.problem = ""
        """Why there is no flat ground; empty where there is."""
        self._metres = settings.constant_depth
        self._limits = (settings.min_depth, settings.max_depth)
        self._with_agreement = is_without_truth
        self._ground = self._ground_depth(job, rig, size)
        self._parts = [camera.network_part(*size) for camera in rig.cameras]
        self._scorers = {name: SurroundScorer(job.name, rig.names, score_settings) for name in self._names()}
        self._tables = {name: AgreementTable() for name in self._scorers}

    def add(self, stamp_ns: int, samples: Sequence[DepthSamples], truth: Sequence[SparseDepth]) -> None:
        """Score one set's references at the pixels of the model's `samples`, both in the order of the rig."""
        for name, scorer in self._scorers.items():
            found = [
                image._replace(
                    prediction=np.where(np.isnan(image.prediction), np.nan, self._depth_at(name, i, image, t))
                )
                for i, (image, t) in enumerate(zip(samples, truth, strict=True))
            ]
            scorer.add(stamp_ns, found)

    def compare(self, number: int, rig: Rig, posed: PosedDepth, earlier: PosedDepth | None) -> None:
        """Compare the references of the set of this number with themselves, as the model's depth is.

        `earlier` is the set before, where both have poses.
        """
        if not self._with_agreement:
            return
        far = self._limits[1]
        for name in (name for name in self._tables if name != BEST_CONSTANT):
            now, table = self._in_place_of(name, posed), self._tables[name]
            table.add(number, spatial_rows(rig, now, far))
            if earlier is not None:
                table.add(number, temporal_rows(rig, now, self._in_place_of(name, earlier), far))

    def result(self) -> dict[str, ReferenceScores]:
        """Return the scores of the sets so far, by reference."""
        return {name: ReferenceScores(scorer.scores(), self._tables[name]) for name, scorer in self._scorers.items()}

    def _names(self) -> list[str]:
        return [name for name in REFERENCES if name != GROUND or self._ground is not None]

    def _ground_depth(self, job: EvaluationJob, rig: Rig, size: tuple[int, int]) -> NDArray[np.float32] | None:
        """Return flat ground's depth [N, H, W]; None where the ground is not below every camera."""
        try:
            return ground_plane_depth(rig, rig.ground_z, job.settings.max_depth, *size).depth
        except ConfigError as error:
            self.problem = str(error)
            return None

    def _depth_at(self, name: str, camera: int, image: DepthSamples, truth: SparseDepth) -> NDArray[np.float64] | float:
        if name == GROUND and self._ground is not None:
            return sample_prediction(self._ground[camera], truth, self._parts[camera])
        least, most = self._limits
        counted = image.truth[(image.truth > least) & (image.truth < most) & ~np.isnan(image.prediction)]
        return best_constant(counted) if name == BEST_CONSTANT else self._metres

    def _in_place_of(self, name: str, posed: PosedDepth) -> PosedDepth:
        """Return the set with the reference's depth wherever the model has any."""
        depth = posed.surround.depth
        full: NDArray[np.float32] | np.float32 = np.float32(self._metres)
        if name == GROUND and self._ground is not None:
            full = self._ground
        replaced = np.where(np.isnan(depth), np.float32(np.nan), full)
        return replace(posed, surround=replace(posed.surround, depth=replaced))


def reference_titles(configuration: Mapping[str, Any]) -> dict[str, str]:
    """Return each reference's title in tables, by an evaluation's configuration."""
    height = configuration["ground_height"]
    return {
        CONSTANT: f"constant {configuration['constant_depth']:g} m",
        BEST_CONSTANT: "best constant",
        GROUND: "flat ground" if height is None else f"ground at {height:g} m",
    }
