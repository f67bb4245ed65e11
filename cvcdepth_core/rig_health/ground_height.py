# SPDX-License-Identifier: Apache-2.0
"""How high the ground lies in the base frame, as LiDAR sweeps show it around the vehicle.

In every sweep a plane is looked for in the lane that the vehicle stands in (RANSAC: Fischler and Bolles 1981), which
nothing may lie far below: so it is the road and neither the pavement, nor a car, nor the vehicle's own roof. The plane
is then fitted to its points, the far ones counting less, and the sweeps have to agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.rig import Rig

Floats = NDArray[np.float64]

MAX_SPREAD = 0.15
"""Metres by which the ground of half of the sweeps may differ from that of all."""

_AHEAD, _ASIDE = 15.0, 1.8  # metres from the middle of the cameras: the lane
_NEAR = 3.0  # metres: points count the same up to there, then less and less
_CELL, _PER_CELL = 0.5, 4  # metres; points of a cell that are taken: sweeps are dense near the vehicle only
_STEEPEST = math.tan(math.radians(6.0))
_THICK = 0.04  # metres from the plane within which points are the ground's
_BELOW = 0.08  # metres below the plane beyond which points deny it
_DRAWS = 400
_REFITS = 6
_USUAL_SLOPE, _POINT_NOISE = 0.05, 0.02  # of roads against vehicles, and metres: what a one-sided view does not tell
_FEWEST_CELLS, _LEAST_SHARE = 12, 0.3
_SHORTEST = 2.0  # metres that the ground's points must extend over, along or across
_LEAST_SENSOR_HEIGHT = 0.15  # metres: a scanner in one plane sees a plane that it lies in itself
_LEAST_UNCERTAINTY, _UNCERTAINTY_OF_ONE = 0.005, 0.03  # metres

_REACH = np.array([_AHEAD, _ASIDE])


@dataclass(frozen=True)
class GroundEstimate:
    """Where the ground is, and how well that is known."""

    height: float
    """Metres in the base frame, in the middle of the cameras."""
    uncertainty: float
    """Standard deviation of `height`, metres."""
    rise_ahead: float | None
    """Degrees by which the ground rises ahead against the base frame's x axis; None where that is not known."""
    rise_left: float | None
    """The same to the left."""
    source: Literal["lidar", "pictures"]
    """What it was found with."""
    evidence: str
    """How much of that, as `8 sweeps`."""

    @property
    def describes(self) -> str:
        """The evidence in words: `from LiDAR, 8 sweeps, +-0.01`."""
        of = {"lidar": "LiDAR", "pictures": "pictures"}[self.source]
        return f"from {of}, {self.evidence}, +-{max(self.uncertainty, 0.01):.2f}"


class _Plane(NamedTuple):
    """z = height + ahead * x + left * y, with x and y from the middle of the cameras."""

    height: float
    ahead: float
    left: float


class GroundFromSweeps:
    """Collects LiDAR sweeps of one vehicle, and finds the ground that they agree on."""

    def __init__(self, rig: Rig) -> None:
        """Begin without sweeps; the cameras say where the vehicle is, and that the ground is below all of them."""
        places = np.stack([camera.base_T_camera[:3, 3] for camera in rig.cameras])
        self._middle, self._top = places[:, :2].mean(axis=0), float(places[:, 2].min())
        self._planes: list[_Plane] = []
        self.sweeps = 0
        """That were added."""
        self._problem = "no sweep"

    def add(self, points: Floats, sensor: Floats) -> None:
        """Take a sweep: points [M, 3] and the LiDAR's place [3], metres in the base frame."""
        self.sweeps += 1
        near = self._candidates(points)
        rng = np.random.default_rng(self.sweeps)
        try:
            self._planes.append(self._ground_of(near, sensor - (*self._middle, 0.0), rng))
        except RigError as error:
            self._problem = str(error)

    def estimate(self) -> GroundEstimate:
        """Return the ground; RigError says why the sweeps do not tell it."""
        if 2 * len(self._planes) < self.sweeps or not self._planes:
            raise RigError(
                f"{self.sweeps - len(self._planes)} of {self.sweeps} LiDAR sweeps show no ground: {self._problem}"
            )
        planes = np.array(self._planes)
        height, ahead, left = np.median(planes, axis=0).tolist()
        spread = 1.4826 * float(np.median(abs(planes[:, 0] - height)))
        if spread > MAX_SPREAD:
            least, most = planes[:, 0].min(), planes[:, 0].max()
            raise RigError(f"the LiDAR sweeps do not agree on the ground: {least:.2f} to {most:.2f} m")
        known = max(_LEAST_UNCERTAINTY, 1.25 * spread / math.sqrt(len(planes)))
        return GroundEstimate(
            height=height,
            uncertainty=known if len(planes) > 1 else _UNCERTAINTY_OF_ONE,
            rise_ahead=math.degrees(math.atan(ahead)),
            rise_left=math.degrees(math.atan(left)),
            source="lidar",
            evidence=f"{len(planes)} sweep{'' if len(planes) == 1 else 's'}",
        )

    def _candidates(self, points: Floats) -> Floats:
        """Return the points [K, 3] of the lane that may be ground, from the middle of the cameras."""
        moved = points[np.isfinite(points).all(axis=1)] - (*self._middle, 0.0)
        inside = (abs(moved[:, :2]) < _REACH).all(axis=1)
        below = moved[:, 2] < self._top + _STEEPEST * abs(moved[:, 0])
        return np.asarray(moved[inside & below], np.float64)

    def _ground_of(self, near: Floats, sensor: Floats, rng: np.random.Generator) -> _Plane:
        points = _thinned(near, rng)
        if len(points) < _FEWEST_CELLS:
            raise RigError(f"{len(near)} points near the vehicle are below its cameras")
        weights = _NEAR / np.maximum(np.linalg.norm(points[:, :2], axis=1), _NEAR)
        plane = _fitted(_best_of_draws(points, weights, rng), points, weights)
        on_it = abs(_above(plane, points)) < _THICK
        self._refuse(plane, points, on_it, float(weights[on_it].sum() / weights.sum()), sensor)
        return plane

    def _refuse(self, plane: _Plane, points: Floats, on_it: NDArray[np.bool_], share: float, sensor: Floats) -> None:
        """Raise RigError for a plane that need not be the ground."""
        cells = len(np.unique(np.floor(points[on_it, :2] / _CELL), axis=0))
        if cells < _FEWEST_CELLS or share < _LEAST_SHARE:
            raise RigError(f"no plane: {share:.0%} of what lies near the vehicle is on the best one")
        if np.ptp(points[on_it, :2], axis=0).max() < _SHORTEST:
            raise RigError("the plane is too small to be told from the vehicle itself")
        if plane.height > self._top:
            raise RigError(f"the plane at {plane.height:.2f} m is not below the cameras")
        if float(_above(plane, sensor[None])[0]) < _LEAST_SENSOR_HEIGHT:
            raise RigError("the LiDAR lies in the plane that it sees: it scans one plane only")


def _thinned(points: Floats, rng: np.random.Generator) -> Floats:
    """Return a few points of every cell, drawn at random."""
    shuffled = points[rng.permutation(len(points))]
    cells = np.floor(shuffled[:, :2] / _CELL).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    order = np.argsort(cell.ravel(), kind="stable")
    ordered = cell.ravel()[order]
    rank = np.arange(len(ordered)) - np.searchsorted(ordered, ordered)
    return np.asarray(shuffled[order[rank < _PER_CELL]])


def _best_of_draws(points: Floats, weights: Floats, rng: np.random.Generator) -> _Plane:
    """Return the plane through three points that most others are on and few are below."""
    triples = points[rng.integers(len(points), size=(_DRAWS, 3))]
    level = np.concatenate([np.ones((_DRAWS, 3, 1)), triples[..., :2]], axis=2)
    possible = abs(np.linalg.det(level)) > _CELL**2
    planes = np.linalg.solve(level[possible], triples[possible][..., 2:])[..., 0]
    planes = planes[(abs(planes[:, 1:]) < _STEEPEST).all(axis=1)]
    if not len(planes):
        raise RigError("no level plane")
    above = points[:, 2] - (planes[:, :1] + planes[:, 1:] @ points[:, :2].T)
    votes = ((abs(above) < _THICK) * weights - (above < -_BELOW) * weights).sum(axis=1)
    return _Plane(*planes[np.argmax(votes)].tolist())


def _fitted(plane: _Plane, points: Floats, weights: Floats) -> _Plane:
    """Return the plane of the least squares of the points that are near it (biweights: Beaton and Tukey 1974)."""
    level = np.concatenate([np.ones((len(points), 1)), points[:, :2]], axis=1)
    prior = np.diag([0.0, 1.0, 1.0]) * (_POINT_NOISE / _USUAL_SLOPE) ** 2
    for _ in range(_REFITS):
        off = _above(plane, points) / _THICK
        share = weights * np.where(abs(off) < 1, (1 - off**2) ** 2, 0.0)
        normal = level.T @ (share[:, None] * level) + prior
        plane = _Plane(*np.linalg.solve(normal, level.T @ (share * points[:, 2])).tolist())
    return plane


def _above(plane: _Plane, points: Floats) -> Floats:
    """Return how far points [M, 3] are above the plane, metres."""
    return np.asarray(points[:, 2] - plane.height - points[:, :2] @ np.array([plane.ahead, plane.left]))
