# SPDX-License-Identifier: Apache-2.0
"""Watches the overlaps while driving, without labels: finds a camera whose mount has moved or whose lens is dirty.

Neighbouring cameras see some of the same things. Three quantities are followed over time, each against its
baseline, which is what is normal for the same pair or camera:

* misalignment: the small turn of one camera that makes its picture agree best with the neighbour's, rendered into it
  through the depth; the search correlates a few hundred points of the pictures' fine structure for every turn of a
  grid, and the correlations of some seconds are averaged before the best turn is taken;
* disagreement: the relative difference of the two depths in the overlap (`rendering.agreement`);
* sharpness: how much of a picture's fine structure is left compared with its coarser structure. Rain and dusk take it
  from all cameras alike; the median change of all cameras is therefore left out.

A moved camera shows in all of its pairs, a healthy one only in those with the moved one: the camera all of whose pairs
are bad is named, and where that is not decided, both. A camera without a wide enough overlap cannot be judged by pairs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.overlap_views import (
    OverlapView,
    best_turn,
    change_of_turn,
    correlations,
    depth_disagreement,
)
from cvcdepth_core.rig_health.trend import Trend
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.surround_depth import SurroundDepth

Quantity = Literal["misalignment", "disagreement", "sharpness"]

_LEAST_OVERLAP_DEG = 8.0


@dataclass(frozen=True)
class MonitorLimits:
    """How far a quantity may be from its baseline before it is reported, and how long it is averaged."""

    misalignment: float = 0.5
    """Degrees by which the best turn of a pair differs from its baseline."""
    calibration: float = 1.5
    """Degrees by which the best turn of a pair may differ from none; more is reported even of the baseline."""
    disagreement: float = 0.1
    """Relative depth difference of a pair above its baseline."""
    sharpness: float = 0.35
    """Loss of fine structure, as the natural logarithm of the ratio to the baseline."""
    confirmation: float = 1.0
    """Seconds for which a pair must be bad before cameras are named; by then the others of the same camera are too."""
    window: float = 2.0
    """Seconds over which a quantity is averaged before it is judged."""
    baseline: float = 60.0
    """Seconds over which the baseline is learnt: what is normal for a pair or camera."""
    learning: float = 5.0
    """Seconds of a pair's or camera's measurements before it is judged at all."""


class Finding(NamedTuple):
    """A quantity that has left its baseline."""

    quantity: Quantity
    cameras: tuple[str, ...]
    """The camera that has changed, or two of which one has."""
    value: float
    """By how much it differs from the baseline, in its unit (see `MonitorLimits`); the worst of the pairs."""
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
    """Measurements of one pair of neighbours; NaN while unknown."""

    misalignment: float
    """Degrees by which the turn that makes the pictures agree best has changed against the baseline."""
    calibration: float
    """Degrees of the baseline turn itself, which is 0 for right calibration and depth."""
    disagreement: float
    """Relative depth difference now."""
    baseline_disagreement: float
    """What it normally is."""


class OverlapMonitor:
    """Monitor of one rig's overlaps. Each update takes only the next steps of a round, so that it stays cheap.

    A round correlates every pair in both directions, compares the depths of every pair, and measures the sharpness of
    every camera; with six cameras and two steps in each of ten sets a second it takes about a second.
    """

    def __init__(self, rig: Rig, limits: MonitorLimits | None = None, steps_per_update: int = 2) -> None:
        """Begin without measurements; each update does `steps_per_update` steps of a round."""
        self._limits = limits or MonitorLimits()
        self._names = rig.names
        self._poses = np.stack([camera.base_T_camera for camera in rig.cameras])
        # Views of one lens move together and are dirty together: that they agree says nothing.
        lens = {camera: number for number, cameras in enumerate(rig.lenses) for camera in cameras}
        neighbours = [(i, j) for i, j in rig.neighbour_indices if lens[i] != lens[j]]
        self._pairs = sorted({(min(pair), max(pair)) for pair in neighbours})
        wide = {frozenset((o.camera, o.neighbour)) for o in rig.overlaps if o.angle >= _LEAST_OVERLAP_DEG}
        directed = [(i, j) for i, j in neighbours if frozenset((self._names[i], self._names[j])) in wide]
        self._correlations = {pair: self._trend() for pair in directed}
        self._disagreements = {pair: self._trend() for pair in self._pairs}
        self._sharpness = {camera: self._trend() for camera in range(len(rig.cameras))}
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
        """Return the quantities that are off their baselines at the moment."""
        return self._findings

    def pairs(self) -> dict[tuple[str, str], PairState]:
        """Return the state of every pair, by the cameras' names."""
        names = self._names
        return {(names[i], names[j]): self._pair_state((i, j)) for i, j in self._pairs}

    def sharpness_changes(self) -> dict[str, float]:
        """Return by how much each camera is sharper than its baseline (negative: blurred), without the common change.

        It is the natural logarithm of a ratio; NaN while unknown.
        """
        changes = np.array([_difference(trend) for trend in self._sharpness.values()])
        known = changes[~np.isnan(changes)]
        common = float(np.median(known)) if known.size > 2 else 0.0
        return {name: float(change) - common for name, change in zip(self._names, changes, strict=True)}

    def _trend(self) -> Trend:
        return Trend(self._limits.window, self._limits.baseline, self._limits.learning)

    def _schedule(self) -> list[tuple[Quantity, tuple[int, ...]]]:
        """Return the steps of a round; every camera of a correlated pair has its sharpness measured with it."""
        turns: list[tuple[Quantity, tuple[int, ...]]] = [("misalignment", pair) for pair in self._correlations]
        depths: list[tuple[Quantity, tuple[int, ...]]] = [("disagreement", pair) for pair in self._disagreements]
        others = self._sharpness.keys() - {camera for pair in self._correlations for camera in pair}
        lonely: list[tuple[Quantity, tuple[int, ...]]] = [("sharpness", (camera,)) for camera in sorted(others)]
        return [*turns, *depths, *lonely]

    def _measure(self, quantity: Quantity, cameras: tuple[int, ...], surround: SurroundDepth, stamp: int) -> None:
        suspects = {name for finding in self._findings for name in finding.cameras}
        is_normal = not any(self._names[camera] in suspects for camera in cameras)
        if quantity == "disagreement":
            pair = (cameras[0], cameras[1])
            difference = depth_disagreement(surround, self._poses, pair)
            if not math.isnan(difference):
                self._disagreements[pair].add(stamp, np.array(difference), is_normal)
            return
        views = [OverlapView.from_surround(surround, camera) for camera in cameras]
        for camera, view in zip(cameras, views, strict=True):
            self._sharpness[camera].add(stamp, np.array(view.sharpness), is_normal)
        if quantity == "misalignment":
            pair = (cameras[0], cameras[1])
            correlation = correlations(views[0], views[1], inverse(self._poses[pair[1]]) @ self._poses[pair[0]])
            if correlation is not None:
                self._correlations[pair].add(stamp, correlation, is_normal)

    def _pair_state(self, pair: tuple[int, int]) -> PairState:
        both = [trend for trend in self._trends_of("misalignment", pair) if trend.is_learnt and trend.now is not None]
        difference = self._disagreements[pair]
        now, baseline = difference.now, difference.baseline
        return PairState(
            _mean([change_of_turn(trend.now, trend.baseline) for trend in both]),
            _mean([float(np.hypot(*best_turn(trend.baseline))) for trend in both]),
            math.nan if now is None else float(now),
            math.nan if baseline is None or not difference.is_learnt else float(baseline),
        )

    def _trends_of(self, quantity: Quantity, pair: tuple[int, int]) -> list[Trend]:
        """Return the pair's trends: of its correlations there is one for each direction that is judged."""
        if quantity == "disagreement":
            return [self._disagreements[pair]]
        return [self._correlations[way] for way in (pair, pair[::-1]) if way in self._correlations]

    def _judged(self, stamp: int) -> Iterable[Finding]:
        states = {pair: self._pair_state(pair) for pair in self._pairs}
        limits = self._limits
        turned = {pair: _excess(state, limits) for pair, state in states.items()}
        apart = {pair: state.disagreement - state.baseline_disagreement for pair, state in states.items()}
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


def _excess(state: PairState, limits: MonitorLimits) -> float:
    """Return the degrees of a pair's misalignment: against its baseline or, where that itself is too far off, zero."""
    wrong_from_the_start = state.calibration - limits.calibration + limits.misalignment
    known = [value for value in (state.misalignment, wrong_from_the_start) if not math.isnan(value)]
    return max(known, default=math.nan)


def _difference(trend: Trend) -> float:
    now, baseline = trend.now, trend.baseline
    if now is None or baseline is None or not trend.is_learnt:
        return math.nan
    return float(now - baseline)


def _mean(values: list[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
