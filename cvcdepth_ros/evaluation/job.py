# SPDX-License-Identifier: Apache-2.0
"""An evaluation's settings and one recording's job, which can be sent to another process or machine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pydantic import Field, model_validator

from cvcdepth_core.model_choices import FlipFusion
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.settings import LIDAR_TOLERANCE, MatchingSettings, ModelSettings, SkySettings

if TYPE_CHECKING:
    from cvcdepth_core.estimator import DepthPredictor
    from cvcdepth_core.rig.rig import Rig
    from cvcdepth_core.rig.rig_file import RigLayout
    from cvcdepth_core.scoring.scores import ScoreSettings
    from cvcdepth_core.scoring.sparse_depth import OcclusionFilter


class Dependencies(NamedTuple):
    """The version and checkpoint that scores depend on, beside recording and configuration."""

    version: str
    """Of this program."""
    sha256: str | None
    """Hash of the checkpoint's bytes; None without one."""


class EvaluationSettings(SkySettings, MatchingSettings, ModelSettings):
    """Everything that decides the scores of a given recording, beside the rig and the part that is taken."""

    predictor: Literal["constant", "ground_plane"] | None = None
    """Score a reference that looks at no picture instead of a network: what any network must beat."""
    constant_depth: float = Field(10.0, gt=0, le=1e4)
    """Predictor constant only: metres."""
    ground_height: float | None = Field(None, ge=-100, le=100)
    """The ground's z in the base frame, metres (-0.4 where that is at a car's axles), for flat ground and for networks
    that are told their rig; without it the rig file's, else what LiDAR or pictures show, else 0."""
    min_depth: float = Field(0.0, ge=0, le=1e4)
    """Metres; truth at or below it is left out, predictions are clamped to it."""
    max_depth: float = Field(80.0, gt=0, le=1e4)
    """Metres; truth at or beyond it is left out, predictions are clamped to it, and label-free scores stop there."""
    flip_fusion_of: Literal["depth", "inverse_depth"] = "depth"
    """With flip-fusion: fuse depth (as CVCDepth) or inverse depth (as SurroundDepth)."""
    truth: Literal["lidar", "depth"] = "lidar"
    """What depth is scored against: LiDARs, or depth images beside the pictures, as `simulate` records them."""
    lidar_tolerance: float = Field(LIDAR_TOLERANCE, ge=0, le=10)
    """Seconds that a LiDAR sweep may be from the image that it is the truth of."""
    no_occlusion_filter: bool = False
    """Take every LiDAR point for truth, also those that the camera cannot see behind a nearer surface."""
    confidence: bool = False
    """Score how sure depth is also where it is not refined; refined depth always has its confidence."""
    threads: int = Field(1, ge=1, le=1024)
    """CPU threads of each worker's network. Results are repeatable to the last bit for the same number."""

    @model_validator(mode="after")
    def _check(self) -> EvaluationSettings:
        if self.min_depth >= self.max_depth:
            raise ValueError(f"min-depth {self.min_depth:g} must be below max-depth {self.max_depth:g}")
        return self

    @property
    def fusion(self) -> FlipFusion:
        """What is fused."""
        return self.flip_fusion_of if self.flip_fusion else "none"

    @property
    def scores(self) -> ScoreSettings:
        """Settings of the scorer."""
        from cvcdepth_core.scoring.scores import ScoreSettings

        parts = ("moving", "edges") if self.truth == "depth" else ()
        return ScoreSettings(min_depth=self.min_depth, max_depth=self.max_depth, parts=parts)

    @property
    def occlusion(self) -> OcclusionFilter | None:
        """Filter of LiDAR points that the camera cannot see; None where it is switched off."""
        from cvcdepth_core.scoring.sparse_depth import OcclusionFilter

        return None if self.no_occlusion_filter else OcclusionFilter()

    @property
    def replayed(self) -> ModelSettings:
        """What is made of the predictor's depth; a reference looks at no picture, and its depth is left as it is."""
        return self.model_copy(update={"refine": "off"}) if self.predictor else self

    @property
    def checkpoint_path(self) -> Path | None:
        """The checkpoint's file; None for a network with random weights and for a reference."""
        return None if self.predictor else super().checkpoint_path

    @property
    def notice(self) -> str:
        """Warning about the network's depth; empty where none is needed."""
        return "" if self.predictor else super().notice

    def dependencies(self) -> Dependencies:
        """Return this machine's version and checkpoint; CheckpointError says what is wrong with the checkpoint."""
        from cvcdepth_core.networks.checkpoint import load_checkpoint

        path = self.checkpoint_path
        return Dependencies(package_version(), load_checkpoint(path).sha256 if path else None)

    def build_predictor(self, rig: Rig) -> DepthPredictor:
        """Load the network, or make the reference for this rig; the errors of the family say what is wrong."""
        from cvcdepth_core.scoring.references import constant_depth, ground_plane_depth

        if self.predictor == "constant":
            return constant_depth(rig, self.constant_depth, self.height, self.width)
        if self.predictor == "ground_plane":
            return ground_plane_depth(rig, rig.ground_z, self.max_depth, self.height, self.width)
        return self.build_estimator()


@dataclass(frozen=True)
class EvaluationJob:
    """One recording to evaluate."""

    name: str
    """The recording's name in results; unique among those that are evaluated together."""
    path: str
    settings: EvaluationSettings
    layout: RigLayout | None = None
    """The rig; None: the cameras found in the recording."""
    base_frame: str = "base_link"
    """The vehicle's frame, where `layout` is None."""
    lidar: tuple[str, ...] | None = None
    """Topics of the LiDARs; none: the vehicle has none; None: all of the recording, see `RecordedRig.lidars`."""
    start: float = 0.0
    """Seconds of the recording to skip."""
    duration: float | None = None
    """Seconds of the recording to take; None: to its end."""

    def configuration(self) -> dict[str, Any]:
        """Return all that decides the scores, beside the recording and the checkpoint's content, with JSON's types."""
        return {
            **self.settings.model_dump(mode="json"),
            "start": self.start,
            "duration": self.duration,
            "lidar": None if self.lidar is None else list(self.lidar),
            "base_frame": self.layout.base_frame if self.layout else self.base_frame,
            "rig": self.layout.model_dump(mode="json", exclude_defaults=True) if self.layout else None,
        }


def unique_names(candidates: Sequence[tuple[str, str]]) -> list[str]:
    """Return each candidate's short name, with the long one in its place where several have the same short one."""
    counts = Counter(short for short, _ in candidates)
    return [short if counts[short] == 1 else long for short, long in candidates]
