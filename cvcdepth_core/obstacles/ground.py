# SPDX-License-Identifier: Apache-2.0
"""The ground under a vehicle: a plane with slope, fitted to a cloud, near where the rig says that it lies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.floating]


class GroundPlane(NamedTuple):
    """z = slope_x x + slope_y y + height in the base frame, metres."""

    height: float
    slope_x: float = 0.0
    slope_y: float = 0.0
    is_fitted: bool = False
    """False where it is what the rig says, since the cloud shows too little ground."""

    def heights(self, points: Points) -> NDArray[np.float32]:
        """Return how high points [M, 3 or more] of the base frame are above it, [M] metres along z."""
        x, y, z = (points[:, axis] for axis in range(3))
        above: NDArray[np.float32] = z - np.float32(self.slope_x) * x - np.float32(self.slope_y) * y
        above -= np.float32(self.height)
        return above

    def describe(self) -> str:
        """Return one line for people."""
        if not self.is_fitted:
            return f"z = {self.height:.2f} m, as the rig says: too little ground in view"
        slope = 100 * float(np.hypot(self.slope_x, self.slope_y))
        return f"z = {self.height:.2f} m below the vehicle, slope {slope:.1f} %"


@dataclass(frozen=True)
class GroundSettings:
    """Where ground is looked for, and what is enough of it."""

    reach: float = 15.0
    """Metres around the vehicle; farther, depth is too rough."""
    uncertainty: float = 0.6
    """Metres by which the rig's ground height, or the wheels on a ramp, may be off."""
    steepest: float = 0.15
    """Slope, metres per metre."""
    cell: float = 1.0
    """Edge in metres of the squares of which each counts once, by its lower points."""
    tolerance: float = 0.12
    """Metres that a square may be off the plane and still belong to it."""
    least_cells: int = 25
    least_share: float = 0.3
    """Of the squares with anything at the ground's height, those that must lie on the plane."""


_MOST_POINTS = 12000
_HYPOTHESES = 200
_LEAST_POINTS = 3  # in a square
_LOW_SHARE = 0.3  # of a square's points below what counts as its height


def fit_ground(points: Points, ground_height: float, settings: GroundSettings | None = None) -> GroundPlane:
    """Return the plane through most of the ground in a cloud [M, 3 or more] of the base frame; always the same one.

    `ground_height` is where the rig has it (z, metres): what is returned, not fitted, where the cloud shows too little.
    """
    settings = settings or GroundSettings()
    cells = _low_cells(_near_ground(points, ground_height, settings), settings.cell)
    known = GroundPlane(ground_height)
    if len(cells) < settings.least_cells:
        return known
    found = _best_plane(cells, ground_height, settings)
    if found is None:
        return known
    for _ in range(3):
        close = np.abs(_residuals(cells, found)) < settings.tolerance
        if close.sum() < max(settings.least_cells, settings.least_share * len(cells)):
            return known
        found = _least_squares(cells[close])
    is_plausible = np.hypot(*found[:2]) <= settings.steepest and abs(found[2] - ground_height) <= settings.uncertainty
    return GroundPlane(float(found[2]), float(found[0]), float(found[1]), True) if is_plausible else known


def _near_ground(points: Points, ground_height: float, settings: GroundSettings) -> NDArray[np.float32]:
    """Return the points [M, 3] that can be ground, of a large cloud a part."""
    step = max(len(points) // _MOST_POINTS, 1)
    some = points[::step, :3].astype(np.float32)
    distance = np.hypot(some[:, 0], some[:, 1])
    lift = np.abs(some[:, 2] - np.float32(ground_height))
    near = (distance < settings.reach) & (lift < settings.uncertainty + settings.steepest * distance)
    return np.asarray(some[near])


def _low_cells(points: NDArray[np.float32], edge: float) -> NDArray[np.float64]:
    """Return x, y and z [K, 3] of the lower points of every square that has enough of them."""
    if not len(points):
        return np.zeros((0, 3))
    column, row = np.floor(points[:, :2].T / edge).astype(np.int64)
    number = column * 100000 + row
    order = np.lexsort((points[:, 2], number))
    _, first, count = np.unique(number[order], return_index=True, return_counts=True)
    chosen = order[first + (_LOW_SHARE * count).astype(np.int64)][count >= _LEAST_POINTS]
    return points[chosen].astype(np.float64)


def _best_plane(
    cells: NDArray[np.float64], ground_height: float, settings: GroundSettings
) -> NDArray[np.float64] | None:
    """Return slopes and height [3] of the plane through three squares that most others lie on; None without any."""
    picks = np.random.default_rng(0).integers(0, len(cells), (_HYPOTHESES, 3))
    corners = cells[picks]
    matrix = np.concatenate([corners[..., :2], np.ones((_HYPOTHESES, 3, 1))], axis=-1)
    sound = np.abs(np.linalg.det(matrix)) > 1.0  # square metres: three squares in a row tell no slope
    planes = np.linalg.solve(matrix[sound], corners[sound][..., 2:])[..., 0]
    level = np.array([[0.0, 0.0, height] for height in np.quantile(cells[:, 2], (0.1, 0.3, 0.5))])
    planes = np.concatenate([planes, level, [[0.0, 0.0, ground_height]]])
    steep = np.hypot(planes[:, 0], planes[:, 1]) > settings.steepest
    planes = planes[~steep & (np.abs(planes[:, 2] - ground_height) <= settings.uncertainty)]
    if not len(planes):
        return None
    off = np.abs(planes[:, :2] @ cells[:, :2].T + planes[:, 2:] - cells[:, 2])
    best: NDArray[np.float64] = planes[np.argmax((off < settings.tolerance).sum(axis=1))]
    return best


def _residuals(cells: NDArray[np.float64], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    off: NDArray[np.float64] = cells[:, 2] - cells[:, :2] @ plane[:2] - plane[2]
    return off


def _least_squares(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.concatenate([cells[:, :2], np.ones((len(cells), 1))], axis=1)
    plane: NDArray[np.float64] = np.linalg.lstsq(matrix, cells[:, 2], rcond=None)[0]
    return plane
