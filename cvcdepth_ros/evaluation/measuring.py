# SPDX-License-Identifier: Apache-2.0
"""One recording's scores: every set's depth, by the node's own path, against LiDAR and against itself."""

from __future__ import annotations

import json
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.estimator import DepthPredictor, is_told_its_rig
from cvcdepth_core.rendering.agreement import PosedDepth
from cvcdepth_core.rig.poses import Pose
from cvcdepth_core.rig.view import PicturePart
from cvcdepth_core.scoring.confidence_scores import ConfidenceScorer, ConfidenceScores
from cvcdepth_core.scoring.consistency import AgreementTable, spatial_rows, temporal_rows
from cvcdepth_core.scoring.ground_truth import overlap_pixels, sample_prediction
from cvcdepth_core.scoring.obstacles import ObstacleScorer, ObstacleScores
from cvcdepth_core.scoring.scorer import DepthSamples, SurroundScorer
from cvcdepth_core.scoring.scores import Scores
from cvcdepth_core.scoring.sky import SkyCounts, sky_counts
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.surround_depth import SkyChoice
from cvcdepth_core.visualization import Points
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.evaluation.job import EvaluationJob
from cvcdepth_ros.evaluation.pose_scores import PoseScoring
from cvcdepth_ros.evaluation.references import ReferenceScores, ReferenceScoring
from cvcdepth_ros.messages.cloud_sources import describe_left_out_clouds
from cvcdepth_ros.recordings.ground import RecordedGround, with_ground
from cvcdepth_ros.recordings.replay import DepthReplay, RecordedImage, SurroundReplay
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.true_depth import RecordedDepthImages
from cvcdepth_ros.recordings.truth import RecordedTruth
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet

Progress = Callable[[float], None]
"""Called with the share of the recording that is done."""

_CONFIDENCE, _OBSTACLES = "confidence_", "obstacles_"  # before the names of their arrays
_REFINED_BY_NS = 4 * NANOSECONDS  # of earlier sets, those that depth is refined with and one more second
_LONGEST_STEP_NS = NANOSECONDS  # between two sets that are compared along the vehicle's way


@dataclass(frozen=True, eq=False)
class MeasuredSet:
    """One set's depth and the recording's ground truth for it."""

    estimated: EstimatedSet[RecordedImage]
    truth: Sequence[SparseDepth]
    """Of each camera, in the rig's order, at its picture's full size; empty where there is none."""
    world_T_base: Sequence[Pose] | None
    """The vehicle's pose at each camera's moment; None where it is not recorded."""
    lidar: Points | None
    """[M, 3] metres in the base frame at the anchor's moment."""
    sky_choice: SkyChoice = "keep"
    """How depth is scored in the sky."""

    @property
    def stamp_ns(self) -> int:
        """The anchor's stamp."""
        return self.estimated.surround_set.stamp_ns

    @property
    def log_time(self) -> int:
        """When the set's last image was recorded, ns."""
        return _log_time(self.estimated)

    @property
    def posed(self) -> PosedDepth:
        """The depth with the cameras' places."""
        return PosedDepth.from_rig(self.estimated.result, self.estimated.rig, self.world_T_base)

    @property
    def parts(self) -> list[PicturePart]:
        """What of each camera's picture the depth shows."""
        size = self.estimated.result.depth.shape[1:]
        return [camera.network_part(*size) for camera in self.estimated.rig.cameras]

    def samples(self) -> list[DepthSamples]:
        """Return what is scored of each camera."""
        rig, depth = self.estimated.rig, self.estimated.result.depth
        views = {camera.name: camera.rectified_view for camera in rig.cameras}
        found = []
        for name, truth, prediction, sky, part in zip(rig.names, self.truth, depth, self._sky, self.parts, strict=True):
            others = [views[other] for other in rig.neighbours[name]]
            overlap = overlap_pixels(truth, views[name], others)
            sampled = sample_prediction(prediction, truth, part)
            if self.sky_choice != "keep":
                in_sky = sample_prediction(sky.astype(np.float32), truth, part) > 0.5
                sampled[in_sky] = np.inf if self.sky_choice == "far" else np.nan
            found.append(DepthSamples(sampled, truth.depth, overlap, truth.parts))
        return found

    def sky(self, far: float) -> SkyCounts:
        """Return how the sky was seen; depth of it is far beyond `far` metres."""
        counts = SkyCounts()
        for truth, depth, sky, part in zip(self.truth, self.estimated.result.depth, self._sky, self.parts, strict=True):
            counts += sky_counts(truth, depth, sky, part, far)
        return counts

    @property
    def _sky(self) -> NDArray[np.bool_]:
        """[N, H, W]; nowhere, where nobody looked for it."""
        result = self.estimated.result
        return np.zeros(result.depth.shape, np.bool_) if result.sky is None else result.sky


@dataclass(frozen=True, eq=False)
class RecordingScores:
    """The scores of one recording."""

    name: str
    summary: dict[str, Any]
    """Counts and sources of what was read and used, with JSON's types."""
    scores: Scores
    agreement: AgreementTable
    log_times: NDArray[np.int64]
    """[S] when each set was recorded, ns."""
    references: Mapping[str, ReferenceScores]
    """What looks at no picture, by `REFERENCES`; flat ground is missing where the ground is not below every camera."""
    confidence: ConfidenceScores | None = None
    """None where it was not computed."""
    obstacles: ObstacleScores | None = None
    """None where it was not computed."""

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything as arrays that numpy stores without pickling."""
        described = {
            "name": self.name,
            "summary": self.summary,
            "scores": self.scores.to_json(),
            "pairs": self.agreement.pairs,
            "references": {
                name: {"scores": found.scores.to_json(), "pairs": found.agreement.pairs}
                for name, found in self.references.items()
            },
        }
        text = np.frombuffer(json.dumps(described).encode(), dtype=np.uint8)
        arrays = {f"agreement_{name}": found.agreement.columns for name, found in self.references.items()}
        if self.confidence is not None:
            arrays |= {f"{_CONFIDENCE}{name}": found for name, found in self.confidence.to_arrays().items()}
        if self.obstacles is not None:
            arrays |= {f"{_OBSTACLES}{name}": found for name, found in self.obstacles.to_arrays().items()}
        return {"described": text, "agreement": self.agreement.columns, "log_times": self.log_times, **arrays}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> RecordingScores:
        """Undo `to_arrays`; KeyError, ValueError or ConfigError where the arrays are others."""
        described = json.loads(arrays["described"].tobytes())
        references = {
            name: ReferenceScores(
                Scores.from_json(found["scores"]),
                AgreementTable(map(tuple, found["pairs"]), arrays[f"agreement_{name}"]),
            )
            for name, found in described["references"].items()
        }
        return cls(
            described["name"],
            described["summary"],
            Scores.from_json(described["scores"]),
            AgreementTable(map(tuple, described["pairs"]), arrays["agreement"]),
            arrays["log_times"],
            references,
            ConfidenceScores.from_arrays(confidence) if (confidence := _named(arrays, _CONFIDENCE)) else None,
            ObstacleScores.from_arrays(obstacles) if (obstacles := _named(arrays, _OBSTACLES)) else None,
        )


def _named(arrays: Mapping[str, NDArray[Any]], before: str) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(before): array for name, array in arrays.items() if name.startswith(before)}


class RecordingEvaluation:
    """One opened recording, ready to be measured; make it with `open_evaluation`."""

    def __init__(
        self,
        job: EvaluationJob,
        recorded: RecordedRig,
        predictor: DepthPredictor | None = None,
        ground: RecordedGround | None = None,
    ) -> None:
        """`predictor` and `ground` are the job's and the rig's where they are known; else they are looked for here."""
        self.job = job
        if predictor is None and job.settings.predictor is None:
            predictor = job.settings.build_estimator()
        if ground is None:
            recorded, ground = _with_ground(job, recorded, predictor)
        self.ground = ground
        self.replay = SurroundReplay(recorded, job.settings)
        self.truth = _truth(job, recorded)
        self.depths = DepthReplay(
            self.replay,
            predictor or job.settings.build_predictor(self.replay.rig),
            settings=job.settings.replayed,
            wants_confidence=job.settings.confidence,
        )

    @property
    def window(self) -> tuple[int, int]:
        """First and last (exclusive) log time, ns."""
        start = self.replay.recording.start + round(self.job.start * NANOSECONDS)
        end = self.replay.recording.end + 1
        return start, end if self.job.duration is None else min(end, start + round(self.job.duration * NANOSECONDS))

    def sets(self, start: int, stop: int, stamp_ns: int | None = None) -> Iterator[MeasuredSet]:
        """Yield the sets of start <= log_time < stop (ns), in order; with a stamp, the set of that stamp only."""
        ahead = self.truth.ahead_ns
        self.truth.read(start - ahead, start)
        pending: deque[EstimatedSet[RecordedImage]] = deque()
        for estimated in self.depths.sets(start, stop, self.truth.handlers, stamp_ns):
            pending.append(estimated)
            while _log_time(pending[0]) + ahead < _log_time(estimated):
                yield self._measured(pending.popleft())
        self.truth.read(stop, stop + ahead)
        yield from map(self._measured, pending)

    def scores(self, progress: Progress | None = None) -> RecordingScores:
        """Score every set of the job's part. Raises RecordingError, saying why, when there is none."""
        start, stop = self.window
        spec = self.depths.estimator.spec
        references = ReferenceScoring(
            self.job, self.replay.rig, (spec.height, spec.width), is_without_truth=not self.truth.topics
        )
        scoring = _Scoring(self.job, self.replay.rig.names, references, self.latencies)
        for measured in self.sets(start, stop):
            scoring.add(measured)
            if progress is not None:
                progress(min(1.0, (measured.log_time - start) / (stop - start)))
        if not scoring.sets:
            raise RecordingError(f"{self.job.path}: no set: {self.depths.why_no_set(*self.window)}")
        return scoring.result(_summary(self, scoring))

    def measured_set(self, stamp_ns: int, log_time: int) -> MeasuredSet:
        """Measure a single set, which is known by its stamp and log time (ns); RecordingError when it is not there.

        It is matched anew from shortly before it, by the rig and the network of this evaluation.
        """
        anew = RecordingEvaluation(self.job, self.replay.recorded, self.depths.estimator, self.ground)
        before = _REFINED_BY_NS if self.depths.refinement.is_active else 2 * NANOSECONDS
        for measured in anew.sets(log_time - before, log_time + NANOSECONDS, stamp_ns):
            return measured
        raise RecordingError(f"{self.job.path}: no set at {stamp_ns} ns")

    @property
    def latencies(self) -> StageLatencies:
        """Durations of the stages."""
        return self.depths.latencies

    def _measured(self, estimated: EstimatedSet[RecordedImage]) -> MeasuredSet:
        surround_set, rig = estimated.surround_set, estimated.rig
        with self.latencies.measure("truth"):
            truth = self.truth.camera_depth(rig, surround_set.times_ns, self.job.settings.occlusion)
            poses = self.truth.base_poses(rig, surround_set.times_ns)
            lidar = self.truth.points(surround_set.time_ns)
            self.truth.forget_before(min(surround_set.times_ns.values()))
        return MeasuredSet(estimated, truth, poses, lidar, self.job.settings.sky)


def _with_ground(
    job: EvaluationJob, recorded: RecordedRig, network: DepthPredictor | None
) -> tuple[RecordedRig, RecordedGround]:
    """Look for the ground; in pictures, which takes seconds, only for depth that depends on it."""
    depends = job.settings.predictor == "ground_plane" or (network is not None and is_told_its_rig(network))
    return with_ground(recorded, job.lidar, job.settings.ground_height, with_pictures=depends)


def _truth(job: EvaluationJob, recorded: RecordedRig) -> RecordedTruth | RecordedDepthImages:
    if job.settings.truth == "depth":
        return RecordedDepthImages(recorded)
    return RecordedTruth(recorded, job.lidar, job.settings.lidar_tolerance)


@contextmanager
def open_evaluation(job: EvaluationJob) -> Iterator[RecordingEvaluation]:
    """Open the job's recording; the errors of the family name what is missing.

    The network runs in as many CPU threads as the settings name; torch's former number is restored at the end.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(job.settings.threads)
    try:
        with open_recording(job.path) as recording:
            yield RecordingEvaluation(job, RecordedRig.from_recording(recording, job.layout, job.base_frame))
    finally:
        torch.set_num_threads(threads)


def evaluate_recording(job: EvaluationJob, progress: Progress | None = None) -> RecordingScores:
    """Score every set of a recording. Raises RecordingError, saying why, when there is none."""
    with open_evaluation(job) as evaluation:
        return evaluation.scores(progress)


class Remeasuring:
    """Measures single sets again; the recording that was asked for last stays open, with its rig and its network.

    Use it as a context manager.
    """

    def __init__(self) -> None:
        self._opened = ExitStack()
        self._evaluation: RecordingEvaluation | None = None

    def __enter__(self) -> Remeasuring:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def measured_set(self, job: EvaluationJob, stamp_ns: int, log_time: int) -> MeasuredSet:
        """Measure a set of a job's recording; see `RecordingEvaluation.measured_set`."""
        if self._evaluation is None or self._evaluation.job != job:
            self._evaluation = None
            self._opened.close()
            self._evaluation = self._opened.enter_context(open_evaluation(job))
        return self._evaluation.measured_set(stamp_ns, log_time)


class _Scoring:
    """Adds up one recording's sets."""

    def __init__(
        self, job: EvaluationJob, cameras: Sequence[str], references: ReferenceScoring, latencies: StageLatencies
    ) -> None:
        self._job = job
        self.references = references
        self._latencies = latencies
        self._scorer = SurroundScorer(job.name, cameras, job.settings.scores)
        self._confidence = ConfidenceScorer(cameras, job.settings.min_depth, job.settings.max_depth)
        self._obstacles = ObstacleScorer()
        self._agreement = AgreementTable()
        self._earlier: tuple[int, PosedDepth] | None = None
        self.poses = PoseScoring(job.settings.checkpoint_path)
        self._log_times = array("q")
        self.sets_with_truth = 0
        self.truth_points = 0
        self.sky = SkyCounts()

    def add(self, measured: MeasuredSet) -> None:
        """Score one set; sets come in order."""
        with self._latencies.measure("score"):
            samples = measured.samples()
            points = self._scorer.add(measured.stamp_ns, samples)
            self.references.add(measured.stamp_ns, samples, measured.truth)
            self._confidence.add(measured.estimated.result, measured.truth, measured.parts)
        with self._latencies.measure("obstacles"):
            self._add_obstacles(measured)
        self.truth_points += points
        if points:
            self.sky += measured.sky(self._job.settings.max_depth)
        self.sets_with_truth += points > 0
        with self._latencies.measure("label-free"), torch.inference_mode():
            self._compare(measured)
        with self._latencies.measure("pose network"):
            self.poses.add(measured)
        self._log_times.append(measured.log_time)

    @property
    def sets(self) -> int:
        """Sets that were scored."""
        return len(self._log_times)

    def result(self, summary: dict[str, Any]) -> RecordingScores:
        """Return what was found."""
        log_times = np.array(self._log_times, dtype=np.int64)
        scores, references = self._scorer.scores(), self.references.result()
        confidence, obstacles = self._confidence.scores(), self._obstacles.scores()
        return RecordingScores(
            self._job.name, summary, scores, self._agreement, log_times, references, confidence, obstacles
        )

    def _add_obstacles(self, measured: MeasuredSet) -> None:
        estimated, poses = measured.estimated, measured.world_T_base
        surround_set, rig = estimated.surround_set, estimated.rig
        pose = None if poses is None else poses[rig.names.index(surround_set.anchor)]
        self._obstacles.add(estimated.result, rig, measured.truth, pose, surround_set.time_ns)

    def _compare(self, measured: MeasuredSet) -> None:
        stamp, rig, posed = measured.stamp_ns, measured.estimated.rig, measured.posed
        limit = self._job.settings.max_depth
        earlier = self._earlier[1] if self._earlier and stamp - self._earlier[0] <= _LONGEST_STEP_NS else None
        if measured.world_T_base is None:
            earlier = None
        self._agreement.add(self.sets, spatial_rows(rig, posed, limit))
        if earlier is not None:
            self._agreement.add(self.sets, temporal_rows(rig, posed, earlier, limit))
        self.references.compare(self.sets, rig, posed, earlier)
        self._earlier = None if measured.world_T_base is None else (stamp, posed)


def _summary(evaluation: RecordingEvaluation, scoring: _Scoring) -> dict[str, Any]:
    replay, depths, truth = evaluation.replay, evaluation.depths, evaluation.truth
    recording, statistics = replay.recording, replay.statistics
    return {
        "name": evaluation.job.name,
        "path": evaluation.job.path,
        "model": depths.estimator.model_id,
        "cameras": replay.layout.names,
        "anchor": replay.layout.anchor_camera,
        "seconds": (recording.end - recording.start) / NANOSECONDS,
        "lidar": list(truth.topics),
        "clouds_of_cameras": list(truth.left_out),
        "why_no_lidar": describe_left_out_clouds(truth.left_out) if truth.left_out else "",
        "motion": truth.motion.topic if truth.motion else None,
        "refinement": depths.refinement.summary(),
        "sets": {
            "scored": scoring.sets,
            "with_truth": scoring.sets_with_truth,
            "matched": statistics.sets,
            "incomplete": sum(statistics.cameras[replay.layout.anchor_camera].dropped.values()),
            "refused": depths.refused.count,
        },
        "truth_points": scoring.truth_points,
        "pose_network": scoring.poses.result(),
        "why_no_pose_network": scoring.poses.problem or None,
        "sky": scoring.sky.to_json(),
        "ground": {**evaluation.ground.to_json(), "told_to_network": is_told_its_rig(depths.estimator)},
        "no_flat_ground": scoring.references.problem or None,
        "refused": depths.refused.reasons + replay.unreadable.reasons,
        "truth_refused": {"count": truth.refused.count, "reasons": truth.refused.reasons[:10]},
        "damage": recording.damage,
        "notes": replay.notes,
    }


def _log_time(estimated: EstimatedSet[RecordedImage]) -> int:
    return max(image.log_time for image in estimated.surround_set.images.values())
