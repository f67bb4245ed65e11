# SPDX-License-Identifier: Apache-2.0
"""Obstacles as a robot feels them: found or not, and free space kept free, in a grid seen from above.

Ground is removed from prediction and truth alike, each by its own fit. What counts is what cameras and truth both see:
an obstacle that is predicted where the truth tells nothing is neither right nor wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.obstacles.ground import GroundPlane, fit_ground
from cvcdepth_core.obstacles.separation import ObstacleLimits
from cvcdepth_core.pointcloud import CloudLimits, merged_cloud
from cvcdepth_core.rig.pinhole import rays_through
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.scoring.driven_space import DrivenSpace
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_core.surround_depth import SurroundDepth

Points = NDArray[np.floating]

RANGES = (5.0, 10.0, 20.0)
"""Metres around the base frame within which obstacles are counted."""
THRESHOLDS = (0.0, 0.2, 0.4, 0.6, 0.8)
"""Confidences below which pixels make no points; without confidence the first alone."""
HIGH = 4.0
"""Metres above the ground: higher points are of no use to a vehicle."""

_CELL = 0.5  # metres
_LEAST_POINTS = 2  # in a square that is taken
_TOLERANCE, _TOLERANCE_SHARE = 0.5, 0.05  # metres, and share of the distance, that a square may be off
_BEARINGS = 720  # of the rays along which truth tells free space
_SECTORS = 72
_MOST_TRUTH = 40000  # points of a camera
_CLOUD = CloudLimits(stride=2, min_range=0.5, max_range=60.0)
_COUNTS = ("truth", "found", "predicted", "correct")


class SectorCounts(NamedTuple):
    """How many of the directions all around agree about the nearest obstacle within the largest range."""

    both: int = 0
    """Truth and prediction have one."""
    missed: int = 0
    """Only the truth has one."""
    invented: int = 0
    """Only the prediction has one, where the truth tells that there is none."""


@dataclass(frozen=True, eq=False)
class ObstacleScores:
    """Obstacles of one recording, or of several."""

    counts: NDArray[np.int64]
    """[T, R, 4] by threshold and range: taken squares of the truth, those found, predicted squares, those correct."""
    sectors: NDArray[np.int64]
    """[3] `SectorCounts`."""
    errors: NDArray[np.float32]
    """[K] metres by which the nearest obstacle of a direction is too far, where both have one."""
    high: NDArray[np.int64]
    """[2, 2] points of prediction and truth, and those of them that lie above `HIGH`."""
    driven: NDArray[np.int64]
    """[R, 2] places that the vehicle came to later, by distance, and those of them that were said to be taken."""

    @classmethod
    def empty(cls) -> ObstacleScores:
        """Return scores of nothing."""
        counts = np.zeros((len(THRESHOLDS), len(RANGES), len(_COUNTS)), np.int64)
        two = np.zeros((2, 2), np.int64)
        return cls(counts, np.zeros(3, np.int64), np.zeros(0, np.float32), two, np.zeros((len(RANGES), 2), np.int64))

    @classmethod
    def merged(cls, parts: Iterable[ObstacleScores]) -> ObstacleScores:
        """Join the scores of several recordings."""
        total = cls.empty()
        for part in parts:
            total = cls(
                total.counts + part.counts,
                total.sectors + part.sectors,
                np.concatenate([total.errors, part.errors]),
                total.high + part.high,
                total.driven + part.driven,
            )
        return total

    @property
    def has_truth(self) -> bool:
        """Whether there was any truth to compare with."""
        return bool(self.high[1, 0])

    @property
    def told_thresholds(self) -> list[int]:
        """Which of `THRESHOLDS` anything was counted at."""
        return [i for i, counts in enumerate(self.counts) if counts.any()]

    def recall(self) -> NDArray[np.float64]:
        """Return the share of the truth's obstacles that were found [T, R], NaN without any."""
        return _share(self.counts[..., 1], self.counts[..., 0])

    def precision(self) -> NDArray[np.float64]:
        """Return the share of the predicted obstacles that are there [T, R], NaN without any."""
        return _share(self.counts[..., 3], self.counts[..., 2])

    def to_json(self) -> dict[str, Any]:
        """Return the content for JSON, NaN as null."""
        recall, precision, driven = self.recall(), self.precision(), _share(self.driven[:, 1], self.driven[:, 0])
        high = _share(self.high[:, 1], self.high[:, 0]).tolist()
        within = {
            f"{metres:g}": {
                "recall": _or_null(recall[0, i]),
                "precision": _or_null(precision[0, i]),
                **dict(zip(_COUNTS, self.counts[0, i].tolist(), strict=True)),
                "driven_places": int(self.driven[i, 0]),
                "driven_places_taken": _or_null(driven[i]),
            }
            for i, metres in enumerate(RANGES)
        }
        curve = [
            {"min_confidence": t, "recall": _or_null(recall[i, -1]), "precision": _or_null(precision[i, -1])}
            for i, t in enumerate(THRESHOLDS)
            if i in self.told_thresholds
        ]
        errors = np.abs(self.errors)
        nearest = {
            **SectorCounts(*self.sectors.tolist())._asdict(),
            "median_error": float(np.median(errors)) if errors.size else None,
            "median_bias": float(np.median(self.errors)) if errors.size else None,
        }
        points_above = {"predicted": _or_null(high[0]), "truth": _or_null(high[1])}
        return {"within": within, "nearest": nearest, "by_confidence": curve, "points_above_4_m": points_above}

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything as arrays."""
        return {name: getattr(self, name) for name in ("counts", "sectors", "errors", "high", "driven")}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> ObstacleScores:
        """Undo `to_arrays`; KeyError where the arrays are others."""
        return cls(*(arrays[name] for name in ("counts", "sectors", "errors", "high", "driven")))


class ObstacleScorer:
    """Measures the obstacles of a recording's sets, in order."""

    def __init__(self, limits: ObstacleLimits | None = None) -> None:
        """Begin without sets."""
        self._limits = limits or ObstacleLimits(max_range=RANGES[-1] * 1.5)
        self._total = ObstacleScores.empty()
        self._errors: list[NDArray[np.float32]] = []
        self._driven = DrivenSpace(RANGES)

    def add(
        self,
        surround: SurroundDepth,
        rig: Rig,
        truth: Sequence[SparseDepth],
        world_T_base: NDArray[np.float64] | None,
        time_ns: int,
    ) -> None:
        """Measure one set; truth is that of each camera at the moment of its picture, in its rectified picture.

        `world_T_base` [4, 4] is where the vehicle was at `time_ns`; None where that is not known.
        """
        cloud = merged_cloud(surround, rig, _CLOUD)
        seen = TrueSpace.of(rig, truth, self._limits)
        plane = fit_ground(cloud, rig.ground_z)
        heights = plane.heights(cloud)
        self._total.high[0] += (len(cloud), int((heights > HIGH).sum()))
        self._total.high[1] += seen.high
        squares = _taken(self._obstacles(cloud, heights))
        if seen.high[0]:
            self._compare(squares, seen, 0)
            self._compare_nearest(self._obstacles(cloud, heights), seen)
            self._add_curve(surround, rig, plane, seen)
        if world_T_base is not None:
            self._driven.add(world_T_base, squares, time_ns)

    def scores(self) -> ObstacleScores:
        """Return the scores of the sets so far."""
        errors = np.concatenate(self._errors) if self._errors else np.zeros(0, np.float32)
        total = self._total
        return ObstacleScores(total.counts, total.sectors, errors, total.high, self._driven.counts())

    def _obstacles(self, cloud: Points, heights: NDArray[np.float32]) -> Points:
        inside = (heights >= self._limits.min_height) & (heights <= self._limits.max_height)
        return cloud[inside & (np.hypot(cloud[:, 0], cloud[:, 1]) <= self._limits.max_range)]

    def _add_curve(self, surround: SurroundDepth, rig: Rig, plane: GroundPlane, seen: TrueSpace) -> None:
        if surround.confidence is None:
            return
        for i, least in enumerate(THRESHOLDS[1:], 1):
            limits = CloudLimits(_CLOUD.stride, _CLOUD.min_range, _CLOUD.max_range, min_confidence=least)
            cloud = merged_cloud(surround, rig, limits)
            self._compare(_taken(self._obstacles(cloud, plane.heights(cloud))), seen, i)

    def _compare(self, predicted: NDArray[np.float64], seen: TrueSpace, threshold: int) -> None:
        found, right = _near(seen.squares, predicted), _near(predicted, seen.squares)
        counted = right | seen.is_free(predicted)
        own, others = (np.hypot(*squares.T) for squares in (seen.squares, predicted))
        for i, metres in enumerate(RANGES):
            near, told = own <= metres, counted & (others <= metres)
            numbers = (near.sum(), (near & found).sum(), told.sum(), (told & right).sum())
            self._total.counts[threshold, i] += np.array(numbers, np.int64)

    def _compare_nearest(self, obstacles: Points, seen: TrueSpace) -> None:
        far = RANGES[-1]
        predicted, true = nearest_by_sector(obstacles), nearest_by_sector(seen.obstacles)
        both = (predicted <= far) & (true <= far)
        missed = (true <= far) & (predicted > far * (1 + _TOLERANCE_SHARE) + _TOLERANCE)
        is_clear = (true > far) & (predicted <= far)
        middles = (np.arange(_SECTORS) + 0.5) / _SECTORS * 2 * np.pi - np.pi
        places = np.stack([np.cos(middles), np.sin(middles)], axis=1) * np.minimum(predicted, far)[:, None]
        invented = is_clear & seen.is_free(places)
        self._total.sectors[:] += (int(both.sum()), int(missed.sum()), int(invented.sum()))
        self._errors.append((predicted[both] - true[both]).astype(np.float32))


@dataclass(frozen=True, eq=False)
class TrueSpace:
    """What truth tells of the space around a vehicle."""

    obstacles: Points
    """[M, 3] metres, base frame."""
    squares: NDArray[np.float64]
    """[K, 2] the middles of those that are taken."""
    origins: NDArray[np.float64]
    """[N, 2] where the cameras are."""
    reach: NDArray[np.float64]
    """[N, B] metres from each camera, by bearing, up to which nothing hides what stands on the ground."""
    high: tuple[int, int]
    """Points, and those of them that lie above `HIGH`."""

    @classmethod
    def of(cls, rig: Rig, truth: Sequence[SparseDepth], limits: ObstacleLimits) -> TrueSpace:
        """Return what the true depth of a rig's cameras tells."""
        views = [_points(camera.rectified_view.intrinsics, camera.base_T_camera, known)
                 for camera, known in zip(rig.cameras, truth, strict=True)]  # fmt: skip
        points = np.concatenate(views)
        plane = fit_ground(points, rig.ground_z)
        heights = plane.heights(points)
        is_low, is_near = heights <= limits.max_height, np.hypot(points[:, 0], points[:, 1]) <= limits.max_range
        obstacles = points[is_low & is_near & (heights >= limits.min_height)]
        origins = np.stack([camera.base_T_camera[:2, 3] for camera in rig.cameras])
        low = np.split(is_low, np.cumsum([len(view) for view in views])[:-1])
        reach = [_reach(view[kept, :2], origin) for view, kept, origin in zip(views, low, origins, strict=True)]
        high = (len(points), int((heights > HIGH).sum()))
        return cls(obstacles, _taken(obstacles), origins, np.stack(reach), high)

    def is_free(self, places: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return past which places [K, 2] some camera's truth looks, not higher than obstacles are."""
        free = np.zeros(len(places), dtype=np.bool_)
        for origin, reach in zip(self.origins, self.reach, strict=True):
            offsets = places - origin
            distances = np.hypot(*offsets.T)
            free |= distances + _tolerance(distances) < reach[_bearing(offsets)]
        return free


def nearest_by_sector(obstacles: Points) -> NDArray[np.float64]:
    """Return how far the nearest obstacle is in each of the directions around the base frame, inf without any.

    A single point does not count: the second nearest is taken.
    """
    distances = np.hypot(obstacles[:, 0], obstacles[:, 1]).astype(np.float64)
    share = np.arctan2(obstacles[:, 1], obstacles[:, 0]) / (2 * np.pi) + 0.5
    sector = np.minimum((share * _SECTORS).astype(np.int64), _SECTORS - 1)
    order = np.lexsort((distances, sector))
    numbers, first, count = np.unique(sector[order], return_index=True, return_counts=True)
    nearest = np.full(_SECTORS, np.inf)
    enough = count >= _LEAST_POINTS
    nearest[numbers[enough]] = distances[order][first[enough] + _LEAST_POINTS - 1]
    return nearest


def _points(
    intrinsics: NDArray[np.float64], base_T_camera: NDArray[np.float64], truth: SparseDepth
) -> NDArray[np.float64]:
    """Return the points [M, 3] of a camera's true depth in the base frame; of dense truth, a part."""
    step = max(len(truth) // _MOST_TRUTH, 1)
    pixels = np.stack([truth.columns[::step], truth.rows[::step]], axis=1)
    in_camera = rays_through(pixels, intrinsics) * truth.depth[::step, None]
    points: NDArray[np.float64] = in_camera @ base_T_camera[:3, :3].T + base_T_camera[:3, 3]
    return points


def _taken(obstacles: Points) -> NDArray[np.float64]:
    """Return the middles [K, 2] of the squares with enough points."""
    if not len(obstacles):
        return np.zeros((0, 2))
    squares, count = np.unique(np.floor(obstacles[:, :2] / _CELL).astype(np.int64), axis=0, return_counts=True)
    middles: NDArray[np.float64] = (squares[count >= _LEAST_POINTS] + 0.5) * _CELL
    return middles


def _near(places: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which places [K, 2] have one of `others` [L, 2] within the tolerance."""
    if not len(places) or not len(others):
        return np.zeros(len(places), dtype=np.bool_)
    squared = ((places[:, None] - others[None]) ** 2).sum(axis=2).min(axis=1)
    near: NDArray[np.bool_] = np.sqrt(squared) <= _tolerance(np.hypot(*places.T)) + _CELL / 2
    return near


def _tolerance(distances: NDArray[np.float64]) -> NDArray[np.float64]:
    tolerance: NDArray[np.float64] = _TOLERANCE + _TOLERANCE_SHARE * distances
    return tolerance


def _reach(points: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far from `origin` the farthest of `points` [M, 2] lies, by bearing [B]; 0 without any."""
    offsets = points - origin
    reach = np.zeros(_BEARINGS)
    np.maximum.at(reach, _bearing(offsets), np.hypot(*offsets.T))
    return reach


def _bearing(offsets: NDArray[np.float64]) -> NDArray[np.int64]:
    share = np.arctan2(offsets[:, 1], offsets[:, 0]) / (2 * np.pi) + 0.5
    return np.minimum((share * _BEARINGS).astype(np.int64), _BEARINGS - 1)


def _share(part: NDArray[np.int64], whole: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.where(whole > 0, part / np.maximum(whole, 1), np.nan)


def _or_null(number: float) -> float | None:
    return None if np.isnan(number) else float(number)
