# SPDX-License-Identifier: Apache-2.0
"""Tells while driving, without labels, that a camera's mount has moved or its lens is dirty.

Neighbouring cameras see some of the same things. Three quantities are followed over time, each against what is usual
for the same pair or camera:

* misalignment: the small turn of one camera that makes its picture agree best with the neighbour's, rendered into it
  through the depth; the search correlates a few hundred points of the pictures' fine structure for every turn of a
  grid, and the correlations of some seconds are averaged before the best turn is taken;
* disagreement: the relative difference of the two depths in the overlap (`consistency.disagreement`);
* sharpness: how much of a picture's fine structure is left compared with its coarser structure. Rain and dusk take it
  from all cameras alike; the median change of all cameras is therefore left out.

A moved camera shows in all of its pairs, a healthy one only in those with the moved one: the camera all of whose pairs
are bad is named, and where that is not decided, both. A camera without a wide enough overlap cannot be judged by pairs.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from cvcdepth_core.rendering.agreement import PosedDepth, disagreement
from cvcdepth_core.rig.pinhole import rays_through, scale_intrinsics
from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.surround_depth import SurroundDepth

Quantity = Literal["misalignment", "disagreement", "sharpness"]

NANOSECONDS = 10**9
_WORKING_WIDTH = 320
_POINTS = 200
_CANDIDATES = 4000  # enough for _POINTS in an overlap of a tenth of the picture
_LEAST_POINTS = 60
_TURNS_DEG = np.arange(-8, 9) * 0.25
_MARGIN = 3
_LEAST_CORRELATION = 0.3
_CONTRAST = 0.5
_NOISE = 1.5  # grey levels that count as no structure
_FLATNESS = 0.2
_COARSE_WIDTH = 64
_LEAST_OVERLAP_DEG = 8.0
_SHIFTS = range(-6, 7)  # steps of the grid by which two correlations are compared


@dataclass(frozen=True)
class MonitorLimits:
    """What is reported."""

    misalignment: float = 0.5
    """Degrees by which the best turn of a pair differs from its usual one."""
    calibration: float = 1.5
    """Degrees by which the best turn of a pair may differ from none; more is reported also when it is usual."""
    disagreement: float = 0.1
    """Relative depth difference of a pair above its usual one."""
    sharpness: float = 0.35
    """Loss of fine structure, as the natural logarithm of the ratio to the usual one."""
    confirmation: float = 1.0
    """Seconds for which a pair must be bad before cameras are named; by then the others of the same camera are too."""
    window: float = 2.0
    """Seconds over which a quantity is averaged before it is judged."""
    usual: float = 60.0
    """Seconds over which the usual is learnt."""
    learning: float = 5.0
    """Seconds of a pair's or camera's measurements before it is judged at all."""


class Finding(NamedTuple):
    """Something that is not as usual."""

    quantity: Quantity
    cameras: tuple[str, ...]
    """Whose it is: one camera, or two of which one is meant."""
    value: float
    """By how much the quantity differs from the usual, in its unit (see `MonitorLimits`); the worst of the pairs."""
    since_ns: int
    """Stamp of the set from which on it was found."""

    def __str__(self) -> str:
        """One line for a diagnostic."""
        who = " or ".join(self.cameras)
        texts = {
            "misalignment": f"{who} seems turned by {self.value:.1f} degrees against its calibration",
            "disagreement": f"depth of {who} differs from its neighbours' by {self.value:.0%} more than usual",
            "sharpness": f"{who} has lost {1 - math.exp(self.value):.0%} of its fine structure: dirty or out of focus",
        }
        return texts[self.quantity]


class PairState(NamedTuple):
    """What is known of one pair of neighbours; NaN while unknown."""

    misalignment: float
    """Degrees by which the turn that makes the pictures agree best has changed against the usual."""
    calibration: float
    """Degrees of the usual turn itself, which is 0 for right calibration and depth."""
    disagreement: float
    """Relative depth difference now."""
    usual_disagreement: float


class OverlapMonitor:
    """Follows the overlaps of one rig. Each update takes only the next steps of a round, so that it stays cheap.

    A round correlates every pair in both directions, compares the depths of every pair, and measures the sharpness of
    every camera; with six cameras and two steps in each of ten sets a second it takes about a second.
    """

    def __init__(self, rig: Rig, limits: MonitorLimits | None = None, steps_per_update: int = 2) -> None:
        """Find the rig's pairs of neighbours."""
        self._limits = limits or MonitorLimits()
        self._names = rig.names
        self._poses = np.stack([camera.base_T_camera for camera in rig.cameras])
        self._pairs = sorted({(min(pair), max(pair)) for pair in rig.neighbour_indices})
        wide = {frozenset((o.camera, o.neighbour)) for o in rig.overlaps if o.angle >= _LEAST_OVERLAP_DEG}
        directed = [(i, j) for i, j in rig.neighbour_indices if frozenset((self._names[i], self._names[j])) in wide]
        self._correlations = {pair: _Trend(self._limits) for pair in directed}
        self._disagreements = {pair: _Trend(self._limits) for pair in self._pairs}
        self._sharpness = {camera: _Trend(self._limits) for camera in range(len(rig.cameras))}
        self._trends = (*self._correlations.values(), *self._disagreements.values(), *self._sharpness.values())
        self._steps = self._schedule()
        self._steps_per_update = steps_per_update
        self._updates_per_round = math.ceil(len(self._steps) / steps_per_update)
        self._step = 0
        self._last_stamp: int | None = None
        self._findings: tuple[Finding, ...] = ()
        self._bad_since: dict[Quantity, dict[tuple[int, int], _Begin]] = {"misalignment": {}, "disagreement": {}}

    def update(self, surround: SurroundDepth, stamp_ns: int) -> None:
        """Take the next steps in one surround set. A stamp that goes back begins the recent seconds anew."""
        if self._last_stamp is not None and stamp_ns < self._last_stamp:
            for trend in self._trends:
                trend.forget_recent()
            self._bad_since = {"misalignment": {}, "disagreement": {}}
        self._last_stamp = stamp_ns
        for _ in range(self._steps_per_update):
            quantity, cameras = self._steps[self._step]
            self._step = (self._step + 1) % len(self._steps)
            if surround.present[list(cameras)].all():
                self._measure(quantity, cameras, surround, stamp_ns)
        for trend in self._trends:
            trend.age(stamp_ns, 2 * self._updates_per_round)
        self._findings = tuple(self._judged(stamp_ns))

    def findings(self) -> tuple[Finding, ...]:
        """Return what is not as usual at the moment."""
        return self._findings

    def pairs(self) -> dict[tuple[str, str], PairState]:
        """Return the state of every pair, by the cameras' names."""
        names = self._names
        return {(names[i], names[j]): self._pair_state((i, j)) for i, j in self._pairs}

    def sharpness_changes(self) -> dict[str, float]:
        """Return by how much each camera is sharper than usual (negative: blurred), without all cameras' common change.

        It is the natural logarithm of a ratio; NaN while unknown.
        """
        changes = np.array([_difference(trend) for trend in self._sharpness.values()])
        known = changes[~np.isnan(changes)]
        common = float(np.median(known)) if known.size > 2 else 0.0
        return {name: float(change) - common for name, change in zip(self._names, changes, strict=True)}

    def _schedule(self) -> list[tuple[Quantity, tuple[int, ...]]]:
        """Return the steps of a round; every camera of a correlated pair has its sharpness measured with it."""
        correlations: list[tuple[Quantity, tuple[int, ...]]] = [("misalignment", pair) for pair in self._correlations]
        depths: list[tuple[Quantity, tuple[int, ...]]] = [("disagreement", pair) for pair in self._disagreements]
        others = self._sharpness.keys() - {camera for pair in self._correlations for camera in pair}
        lonely: list[tuple[Quantity, tuple[int, ...]]] = [("sharpness", (camera,)) for camera in sorted(others)]
        return [*correlations, *depths, *lonely]

    def _measure(self, quantity: Quantity, cameras: tuple[int, ...], surround: SurroundDepth, stamp: int) -> None:
        suspects = {name for finding in self._findings for name in finding.cameras}
        usual = not any(self._names[camera] in suspects for camera in cameras)
        if quantity == "disagreement":
            pair = (cameras[0], cameras[1])
            difference = _disagreement(surround, self._poses, pair)
            if not math.isnan(difference):
                self._disagreements[pair].add(stamp, np.array(difference), usual)
            return
        views = [_View.of(surround, camera) for camera in cameras]
        for camera, view in zip(cameras, views, strict=True):
            self._sharpness[camera].add(stamp, np.array(view.sharpness), usual)
        if quantity == "misalignment":
            pair = (cameras[0], cameras[1])
            correlation = _correlations(views[0], views[1], inverse(self._poses[pair[1]]) @ self._poses[pair[0]])
            if correlation is not None:
                self._correlations[pair].add(stamp, correlation, usual)

    def _pair_state(self, pair: tuple[int, int]) -> PairState:
        both = [trend for trend in self._trends_of("misalignment", pair) if trend.is_learnt and trend.now is not None]
        difference = self._disagreements[pair]
        now, usual = difference.now, difference.usual
        return PairState(
            _mean([_change_of_turn(trend) for trend in both]),
            _mean([float(np.hypot(*_best_turn(trend.usual))) for trend in both]),
            math.nan if now is None else float(now),
            math.nan if usual is None or not difference.is_learnt else float(usual),
        )

    def _trends_of(self, quantity: Quantity, pair: tuple[int, int]) -> list[_Trend]:
        """Return the pair's trends: of its correlations there is one for each direction that is judged."""
        if quantity == "disagreement":
            return [self._disagreements[pair]]
        return [self._correlations[way] for way in (pair, pair[::-1]) if way in self._correlations]

    def _judged(self, stamp: int) -> Iterable[Finding]:
        states = {pair: self._pair_state(pair) for pair in self._pairs}
        limits = self._limits
        turned = {pair: _excess(state, limits) for pair, state in states.items()}
        apart = {pair: state.disagreement - state.usual_disagreement for pair, state in states.items()}
        yield from self._named("misalignment", turned, limits.misalignment, stamp)
        yield from self._named("disagreement", apart, limits.disagreement, stamp)
        for name, change in self.sharpness_changes().items():
            if change < -limits.sharpness:
                yield self._finding("sharpness", (name,), change, stamp)

    def _named(
        self, quantity: Quantity, values: dict[tuple[int, int], float], limit: float, stamp: int
    ) -> Iterable[Finding]:
        """Name the cameras all of whose judged pairs are above the limit; both of a pair that no camera explains.

        One pair that is confirmed confirms them; another camera's pair does not.
        """
        judged = {pair: value for pair, value in values.items() if not math.isnan(value)}
        bad = {pair: value for pair, value in judged.items() if value > limit}
        confirmed = self._confirmed(quantity, bad, stamp)
        suspects = {c for pair in bad for c in pair if all(other in bad for other in judged if c in other)}
        while bad:
            # The camera that explains most is named first; its pairs then need no other explanation.
            counts = {c: sum(c in pair for pair in bad) for pair in bad for c in pair if c in suspects}
            most = max(counts.values(), default=0)
            pair, value = max(bad.items(), key=lambda item: item[1])
            named = sorted(c for c, count in counts.items() if count == most and (most > 1 or c in pair)) or list(pair)
            named = named if len(named) == 1 or most == 1 else named[:1]
            explained = {other: v for other, v in bad.items() if set(other) & set(named)} or {pair: value}
            names = tuple(self._names[c] for c in named)
            if confirmed & explained.keys():
                yield self._finding(quantity, names, max(explained.values()), stamp)
            bad = {other: v for other, v in bad.items() if other not in explained}

    def _confirmed(self, quantity: Quantity, bad: Iterable[tuple[int, int]], stamp: int) -> set[tuple[int, int]]:
        """Return the pairs that have been bad for long enough, and were measured again since they became so."""
        measured = {pair: sum(trend.measurements for trend in self._trends_of(quantity, pair)) for pair in bad}
        before = self._bad_since[quantity]
        since = {pair: before.get(pair, _Begin(stamp, count)) for pair, count in measured.items()}
        self._bad_since[quantity] = since
        least = self._limits.confirmation * NANOSECONDS
        return {p for p, begin in since.items() if stamp - begin.stamp >= least and measured[p] > begin.measurements}

    def _finding(self, quantity: Quantity, names: tuple[str, ...], value: float, stamp: int) -> Finding:
        before = (found.since_ns for found in self._findings if (found.quantity, found.cameras) == (quantity, names))
        return Finding(quantity, names, value, next(before, stamp))


class _Begin(NamedTuple):
    """When a pair became bad: stamp, and how often it had been measured until then."""

    stamp: int
    measurements: int


class _Trend:
    """A quantity's mean over the last seconds, and its usual value: a slow mean that stands still while it is off."""

    def __init__(self, limits: MonitorLimits) -> None:
        self._limits = limits
        self._recent: deque[tuple[int, NDArray[np.float64]]] = deque()
        self._learnt = 0.0  # seconds
        self._updates_without = 0
        self.measurements = 0
        self.now: NDArray[np.float64] | None = None
        self.usual: NDArray[np.float64] | None = None

    @property
    def is_learnt(self) -> bool:
        """Whether it was measured for long enough to say what is usual."""
        return self._learnt >= self._limits.learning

    def add(self, stamp: int, value: NDArray[np.float64], is_usual: bool) -> None:
        """Take in one measurement; `is_usual` says whether the usual may learn from it."""
        self.measurements += 1
        self._updates_without = 0
        seconds = (stamp - self._recent[-1][0]) / NANOSECONDS if self._recent else 0.0
        self._recent.append((stamp, value))
        while stamp - self._recent[0][0] > self._limits.window * NANOSECONDS:
            self._recent.popleft()
        self.now = np.mean([recent for _, recent in self._recent], axis=0)
        if is_usual or not self.is_learnt:
            self._learn(value, min(seconds, self._limits.window))

    def age(self, stamp: int, updates: int) -> None:
        """Forget the recent seconds when they are over and so many updates brought no measurement: that is not now."""
        self._updates_without += 1
        is_over = self._recent and stamp - self._recent[-1][0] > self._limits.window * NANOSECONDS
        if is_over and self._updates_without > updates:
            self.forget_recent()

    def forget_recent(self) -> None:
        """Begin the recent seconds anew."""
        self._recent.clear()
        self.now = None

    def _learn(self, value: NDArray[np.float64], seconds: float) -> None:
        """Renew the usual: a plain mean at first, which becomes a slow one."""
        self._learnt += seconds
        share = 1.0 if self.usual is None else min(1.0, seconds / min(self._limits.usual, max(self._learnt, 1e-9)))
        self.usual = value if self.usual is None else (1 - share) * self.usual + share * value


@dataclass(frozen=True, eq=False)
class _View:
    """One camera's picture as the monitor sees it."""

    structure: NDArray[np.float32]
    """[h, w] fine structure, locally normalised, at the working size."""
    depth: NDArray[np.float32]
    """[h, w] metres."""
    intrinsics: NDArray[np.float64]
    """[3, 3] at the working size."""
    sharpness: float
    """Logarithm of the ratio of fine to coarser structure."""

    @classmethod
    def of(cls, surround: SurroundDepth, camera: int) -> _View:
        grey = cv2.cvtColor(surround.pictures[camera], cv2.COLOR_RGB2GRAY)
        height, width = grey.shape
        size = (min(width, _WORKING_WIDTH), round(height * min(1.0, _WORKING_WIDTH / width)))
        scale = (size[0] / width, size[1] / height)
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        depth = cv2.resize(surround.depth[camera], size, interpolation=cv2.INTER_NEAREST)
        return cls(_structure(small), depth, scale_intrinsics(surround.intrinsics[camera], scale), _sharpness(grey))


def _structure(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    detail = cv2.blur(grey, (3, 3)) - cv2.blur(grey, (13, 13))
    deviation = np.sqrt(cv2.blur(detail * detail, (13, 13))) + _NOISE
    normalised: NDArray[np.float32] = detail / deviation
    return normalised


def _sharpness(grey: NDArray[np.uint8]) -> float:
    """Logarithm of what a small blur takes away, over what a wider one takes away then."""
    once, twice = cv2.blur(grey, (3, 3)), cv2.blur(grey, (7, 7))
    fine, coarse = cv2.mean(cv2.absdiff(grey, once))[0], cv2.mean(cv2.absdiff(once, twice))[0]
    return math.log((fine + _FLATNESS) / (coarse + _FLATNESS))


def _correlations(view: _View, other: _View, other_T_view: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Correlate the view with the other one for every small turn of that: [pitch, yaw]; None for too few points."""
    points, structure = _overlapping_points(view, other, other_T_view)
    if len(points) < _LEAST_POINTS:
        return None
    pixels = points @ (_TURNS @ other.intrinsics.T.astype(np.float32))  # [turns, M, 3], homogeneous
    u, v = (np.ascontiguousarray(pixels[..., axis]) / pixels[..., 2] for axis in (0, 1))
    seen = cv2.remap(other.structure, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    norm = np.sqrt((seen * seen).sum(axis=1) * (structure @ structure)) + 1e-6
    correlation: NDArray[np.float64] = (seen @ structure / norm).astype(np.float64)
    return correlation.reshape(len(_TURNS_DEG), len(_TURNS_DEG))


def _overlapping_points(
    view: _View, other: _View, other_T_view: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return points [M, 3] of the view that the other one sees, in metres in its frame, and their structure [M]."""
    contrasts = np.flatnonzero(np.abs(view.structure) > _CONTRAST)
    v, u = np.divmod(contrasts[:: max(1, len(contrasts) // _CANDIDATES)], view.structure.shape[1])
    z = view.depth[v, u]
    rays = rays_through(np.stack([u, v], axis=1), view.intrinsics)
    points = (rays * z[:, None]) @ other_T_view[:3, :3].T + other_T_view[:3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        pixels = (points @ other.intrinsics.T)[:, :2] / points[:, 2:]
    height, width = other.structure.shape
    inside = (pixels >= _MARGIN).all(axis=1) & (pixels[:, 0] < width - _MARGIN) & (pixels[:, 1] < height - _MARGIN)
    chosen = np.flatnonzero(inside & (points[:, 2] > 0))
    chosen = chosen[:: max(1, len(chosen) // _POINTS)]
    return points[chosen].astype(np.float32), view.structure[v[chosen], u[chosen]]


def _disagreement(surround: SurroundDepth, poses: NDArray[np.float64], pair: tuple[int, int]) -> float:
    """Median relative difference of the two depths where they overlap, on a coarse grid; NaN where they do not."""
    stride = max(1, surround.depth.shape[2] // _COARSE_WIDTH)
    chosen = list(pair)
    coarse = SurroundDepth(
        np.ascontiguousarray(surround.depth[chosen, ::stride, ::stride]),
        np.ascontiguousarray(surround.pictures[chosen, ::stride, ::stride]),
        surround.intrinsics[chosen] / [[stride], [stride], [1.0]],
        surround.present[chosen],
    )
    posed = PosedDepth(coarse, poses[chosen])
    both = np.concatenate([disagreement(posed, 0, posed, 1).ravel(), disagreement(posed, 1, posed, 0).ravel()])
    known = both[~np.isnan(both)]
    return float(np.median(known)) if known.size >= _LEAST_POINTS else math.nan


def _best_turn(correlation: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the turn (pitch, yaw; degrees) at the peak, between the grid's steps; NaN where nothing correlates."""
    if correlation is None or correlation.max() < _LEAST_CORRELATION:
        return np.full(2, np.nan)
    row, column = np.unravel_index(int(correlation.argmax()), correlation.shape)
    offsets = (_peak_offset(correlation[:, column], int(row)), _peak_offset(correlation[row], int(column)))
    turn: NDArray[np.float64] = _TURNS_DEG[[row, column]] + (_TURNS_DEG[1] - _TURNS_DEG[0]) * np.array(offsets)
    return turn


def _peak_offset(values: NDArray[np.float64], peak: int) -> float:
    """Place of the top of the parabola through the peak and its neighbours, in steps from the peak."""
    if not 0 < peak < len(values) - 1:
        return 0.0
    before, at, after = values[peak - 1 : peak + 2]
    bend = before - 2 * at + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0


def _change_of_turn(trend: _Trend) -> float:
    """Degrees by which the correlations must be shifted to be most like the usual ones; NaN where nothing correlates.

    The whole course around the peak counts: where streets make it a ridge, its top wanders though nothing has moved.
    """
    now, usual = trend.now, trend.usual
    if now is None or usual is None or min(now.max(), usual.max()) < _LEAST_CORRELATION:
        return math.nan
    likeness = _likeness(now, usual)
    row, column = np.unravel_index(int(likeness.argmax()), likeness.shape)
    offsets = (_peak_offset(likeness[:, column], int(row)), _peak_offset(likeness[row], int(column)))
    steps = np.hypot(_SHIFTS[row] + offsets[0], _SHIFTS[column] + offsets[1])
    return float(steps * (_TURNS_DEG[1] - _TURNS_DEG[0]))


def _likeness(now: NDArray[np.float64], usual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for every shift of `now` (rows, columns) how like `usual` it is: their mean squared difference, negated.

    Only what both show at that shift counts, without its mean.
    """
    a, b = _shifted(now), usual.ravel()
    count = _SHOWN.sum(axis=1)
    squares = np.square(a).sum(axis=1) + _SHOWN @ np.square(b) - 2 * a @ b
    differences = squares - np.square(a.sum(axis=1) - _SHOWN @ b) / count
    likeness: NDArray[np.float64] = -(differences / count).reshape(len(_SHIFTS), len(_SHIFTS))
    return likeness


def _shifted(grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the grid [S, S] under every shift, a row each [shifts, S * S]; 0 where it shows nothing."""
    padded = np.pad(grid, _SHIFTS[-1])
    return sliding_window_view(padded, grid.shape).reshape(-1, grid.size)


def _excess(state: PairState, limits: MonitorLimits) -> float:
    """Degrees by which a pair is misaligned: against its usual or, where that is more than it may be, against zero."""
    wrong_from_the_start = state.calibration - limits.calibration + limits.misalignment
    known = [value for value in (state.misalignment, wrong_from_the_start) if not math.isnan(value)]
    return max(known, default=math.nan)


def _difference(trend: _Trend) -> float:
    now, usual = trend.now, trend.usual
    if now is None or usual is None or not trend.is_learnt:
        return math.nan
    return float(now - usual)


def _mean(values: list[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def _turn(pitch: float, yaw: float) -> NDArray[np.float32]:
    """Rotation [3, 3] about a camera's x and y axes by small angles in degrees, for row vectors."""
    rotation, _ = cv2.Rodrigues(np.radians([pitch, yaw, 0.0]))
    turn: NDArray[np.float32] = np.array(rotation.T, dtype=np.float32)
    return turn


_SHOWN = _shifted(np.ones((len(_TURNS_DEG), len(_TURNS_DEG))))
_TURNS = np.stack([_turn(pitch, yaw) for pitch, yaw in product(_TURNS_DEG, _TURNS_DEG)])
