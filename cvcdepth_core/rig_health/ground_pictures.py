# SPDX-License-Identifier: Apache-2.0
"""How high the ground lies in the base frame, as pictures of the road from two known places show it.

A plane takes each patch of the road in one picture to where it must be in the other. The height at which the patches
look most alike (zero-mean normalised cross-correlation) is the ground's; it is told only where that height stands out,
and where parts of the pictures agree on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import RigError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.rig.pinhole import PinholeView, pixel_rays, rays_through
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.ground_height import GroundEstimate

Floats = NDArray[np.float64]
Greys = NDArray[np.float32]

FEWEST_PAIRS = 6
"""Pairs of pictures that are needed for a result."""

_AHEAD, _ASIDE = (0.8, 7.0), 1.0  # of the camera's height: where the road is looked at
_RADIUS, _COARSE = 5, 2  # pixels of a patch around its middle; deviation of the blur of the coarse search
_STRIDE, _MOST_PATCHES, _FEWEST_PATCHES = 4, 100, 15
_LEAST_TEXTURE = 2.0  # grey levels, standard deviation in a patch
_STILL = 0.8  # correlation of a patch with the very same place of the other picture: the vehicle's own body
_LOWEST, _HIGHEST = 0.2, 4.5  # metres of the cameras' mean above the ground
_COARSE_STEP, _FINE_STEP, _FINE_REACH = 0.05, 0.02, 4  # of the height; steps to each side
_LEAST_CORRELATION = 0.3
_STANDS_OUT_AT, _STANDS_OUT_BY = 0.15, 0.02  # of the height; of the correlation
_PARTS, _MOST_APART = 3, 0.08  # that have to agree, up to this share of the height
_USUAL_TILT = math.tan(math.radians(0.7))  # of mounts and vehicles against the road: what is far tells the less
_LEAST_KNOWN = 0.12  # of the height: what is less certain than that is not told


class RoadView(NamedTuple):
    """A rectified picture that shows some road."""

    picture: Picture
    """RGB [H, W, 3]."""
    scene: NDArray[np.bool_]
    """[H, W] False where it shows the vehicle itself or nothing."""
    view: PinholeView
    """Its pose is in one base frame for both pictures of a pair."""


def shows_road(view: RoadView) -> bool:
    """Say whether a picture can be of use: it shows some of the lane near the vehicle, if the ground is below it."""
    return int(_road(view).sum()) >= _FEWEST_PATCHES * (2 * _RADIUS + 1) ** 2


@dataclass(frozen=True, eq=False)
class _Pair:
    """Patches of one picture, and the picture that they are looked for in."""

    rays: Floats
    """[P, S, 3] in the base frame, S samples of each patch."""
    centre: Floats
    """[3] they start from there."""
    weights: Floats
    """[P] of the patches: what is near tells most."""
    reach: Floats
    """[P] how far ahead they are, by the camera's height."""
    greys: Greys
    """[P, S] zero mean, unit norm."""
    coarse_greys: Greys
    second: Greys
    coarse_second: Greys
    view: PinholeView

    def alike(self, height: float, is_coarse: bool) -> tuple[float, float]:
        """Return the weighted sum of the correlations of the patches that the second picture shows, and the weights."""
        along = (height - self.centre[2]) / self.rays[..., 2]
        points = self.centre + self.rays * along[..., None]
        pixels, _ = self.view.project(points.reshape(-1, 3))
        picture, greys = (self.coarse_second, self.coarse_greys) if is_coarse else (self.second, self.greys)
        found = _sampled(picture, pixels).reshape(greys.shape)
        seen = ~np.isnan(found).any(axis=1)
        correlations = (_normalised(found[seen]) * greys[seen]).sum(axis=1)
        return float((correlations * self.weights[seen]).sum()), float(self.weights[seen].sum())


class GroundFromPictures:
    """Collects pairs of pictures of the road from two places, and finds the height that makes them alike."""

    def __init__(self, rig: Rig) -> None:
        """Begin without pairs."""
        self._top = float(np.mean([camera.base_T_camera[2, 3] for camera in rig.cameras]))
        self._pairs: list[_Pair] = []
        self._without_texture = 0

    def add(self, first: RoadView, second: RoadView) -> None:
        """Take a pair; the vehicle or the camera must have been in two places, known well."""
        pair = _prepared(first, second)
        if pair is None:
            self._without_texture += 1
        else:
            self._pairs.append(pair)

    def estimate(self) -> GroundEstimate:
        """Return the ground; RigError says why the pictures do not tell it."""
        if len(self._pairs) < FEWEST_PAIRS:
            raise RigError(
                f"{len(self._pairs)} pairs of pictures show a road with texture from two places, {FEWEST_PAIRS} are "
                f"needed ({self._without_texture} without)"
            )
        rough = self._rough_height()
        height = self._refined(self._pairs, rough)
        above = self._top - height
        self._refuse_if_unclear(height)
        parts = [self._refined(self._pairs[part::_PARTS], rough) for part in range(_PARTS)]
        if max(abs(part - height) for part in parts) > _MOST_APART * above:
            told = ", ".join(f"{part:.2f}" for part in parts)
            raise RigError(f"the pictures do not agree on the ground: {told} m")
        tilted = _USUAL_TILT * self._mean_reach() * above
        uncertainty = math.hypot(float(np.std(parts, ddof=1)) / math.sqrt(_PARTS), tilted, 0.01 * above)
        if uncertainty > _LEAST_KNOWN * above:
            raise RigError(f"the pictures show the road from too far away: {height:.2f} m, +-{uncertainty:.2f}")
        return GroundEstimate(height, uncertainty, None, None, "pictures", f"{len(self._pairs)} pairs")

    def _rough_height(self) -> float:
        """Return the height that is best of all there are."""
        above = np.exp(np.arange(math.log(_LOWEST), math.log(_HIGHEST), _COARSE_STEP))
        scores = [self._score(self._pairs, self._top - height, is_coarse=True) for height in above]
        best = int(np.argmax(scores))
        if best in (0, len(above) - 1):
            raise RigError(f"the pictures fit no ground between {_LOWEST:g} and {_HIGHEST:g} m below the cameras")
        return self._top - float(above[best])

    def _refined(self, pairs: list[_Pair], rough: float) -> float:
        """Return the best height near another."""
        steps = np.arange(-_FINE_REACH, _FINE_REACH + 1) * _FINE_STEP
        heights: Floats = self._top - (self._top - rough) * (1 + steps.astype(np.float64))
        return _peak(heights, np.array([self._score(pairs, height) for height in heights]))

    def _score(self, pairs: list[_Pair], height: float, is_coarse: bool = False) -> float:
        """Return the mean correlation."""
        total, weight = np.sum([pair.alike(height, is_coarse) for pair in pairs], axis=0)
        return float(total / max(weight, 1e-9))

    def _mean_reach(self) -> float:
        """Return how far ahead the patches are, by the cameras' height, weighted."""
        weights = np.concatenate([pair.weights for pair in self._pairs])
        return float((np.concatenate([pair.reach for pair in self._pairs]) * weights).sum() / weights.sum())

    def _refuse_if_unclear(self, height: float) -> None:
        above, best = self._top - height, self._score(self._pairs, height)
        if best < _LEAST_CORRELATION:
            raise RigError(
                f"the pictures fit no ground: at {height:.2f} m they correlate by {best:.2f}, less than "
                f"{_LEAST_CORRELATION:g}"
            )
        for share in (1 - _STANDS_OUT_AT, 1 + _STANDS_OUT_AT):
            other = self._score(self._pairs, self._top - above * share)
            if best - other < _STANDS_OUT_BY:
                raise RigError(
                    f"the pictures fit the ground at {height:.2f} m hardly better ({best:.2f}) than at "
                    f"{self._top - above * share:.2f} m ({other:.2f})"
                )


def _prepared(first: RoadView, second: RoadView) -> _Pair | None:
    """Return a pair's patches; None where there are too few."""
    grey, other = _grey(first.picture), _grey(second.picture)
    middles = _textured(grey, _road(first))
    if len(middles) < _FEWEST_PATCHES:
        return None
    offsets = np.stack(np.meshgrid(*[np.arange(-_RADIUS, _RADIUS + 1)] * 2), axis=-1).reshape(-1, 2)
    pixels = (middles[:, None] + offsets).astype(np.float64)  # [P, S, 2]
    still = (_patches(grey, pixels) * _patches(other, pixels)).sum(axis=1) > _STILL
    middles, pixels = middles[~still], pixels[~still]
    if len(middles) < _FEWEST_PATCHES:
        return None
    rays = rays_through(pixels.reshape(-1, 2), first.view.intrinsics) @ first.view.base_T_camera[:3, :3].T
    rays = rays.reshape(*pixels.shape[:2], 3)
    ahead = rays[:, len(offsets) // 2]
    reach = np.hypot(ahead[:, 0], ahead[:, 1]) / -ahead[:, 2]
    other[~second.scene] = np.nan
    coarse = _blurred(grey)
    return _Pair(
        rays=rays,
        centre=first.view.base_T_camera[:3, 3],
        weights=1.0 / reach**2,
        reach=reach,
        greys=_patches(grey, pixels),
        coarse_greys=_patches(coarse, pixels),
        second=other,
        coarse_second=_blurred(other),
        view=second.view,
    )


def _patches(picture: Greys, pixels: Floats) -> Greys:
    """Return the patches at pixels [P, S, 2], normalised [P, S]."""
    return _normalised(_sampled(picture, pixels.reshape(-1, 2)).reshape(pixels.shape[:2]))


def _grey(picture: Picture) -> Greys:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.float32)


def _blurred(grey: Greys) -> Greys:
    """Return it smoother, so that what is near its place already looks alike; NaN grows."""
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _COARSE), np.float32)


def _road(view: RoadView) -> NDArray[np.bool_]:
    """Return where a picture shows the ground of the lane near the vehicle, if there is any [H, W]."""
    rays = pixel_rays(view.view.intrinsics, view.view.height, view.view.width).astype(np.float64)
    x, y, z = np.moveaxis(rays @ view.view.base_T_camera[:3, :3].T, -1, 0)
    below = z < 0
    down = np.where(below, -z, 1.0)
    near = (abs(x) > _AHEAD[0] * down) & (abs(x) < _AHEAD[1] * down) & (abs(y) < _ASIDE * down)
    inner = cv2.erode(view.scene.astype(np.uint8), np.ones((2 * _RADIUS + 1, 2 * _RADIUS + 1), np.uint8)) > 0
    inner[: _RADIUS + 1], inner[-_RADIUS - 1 :] = False, False
    inner[:, : _RADIUS + 1], inner[:, -_RADIUS - 1 :] = False, False
    return np.asarray(below & near & inner)


def _textured(grey: Greys, road: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the middles (u, v) [P, 2] of the patches of the road with the most texture."""
    size = (2 * _RADIUS + 1, 2 * _RADIUS + 1)
    variance = np.maximum(cv2.blur(grey**2, size) - cv2.blur(grey, size) ** 2, 0.0)
    on_grid = np.zeros_like(road)
    on_grid[::_STRIDE, ::_STRIDE] = True
    rows, columns = np.nonzero(road & on_grid & (variance > _LEAST_TEXTURE**2))
    best = np.argsort(-variance[rows, columns], kind="stable")[:_MOST_PATCHES]
    return np.stack([columns[best], rows[best]], axis=1)


def _sampled(picture: Greys, pixels: Floats) -> Greys:
    """Return grey levels at pixels (u, v) [M, 2], NaN outside."""
    maps = np.nan_to_num(pixels, nan=-1e4, posinf=-1e4, neginf=-1e4).clip(-1e4, 1e4).astype(np.float32)
    found = cv2.remap(picture, maps[None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=math.nan)
    return np.asarray(found[0], np.float32)


def _normalised(greys: Greys) -> Greys:
    """Return patches [P, S] with zero mean and unit norm; of one without any texture, zeros."""
    centred = greys - greys.mean(axis=1, keepdims=True)
    return np.asarray(centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-3), np.float32)


def _peak(places: Floats, scores: Floats) -> float:
    """Return where the parabola through the scores around the best is highest."""
    best = int(np.clip(np.argmax(scores), 1, len(scores) - 2))
    before, here, after = scores[best - 1 : best + 2]
    curvature = before - 2 * here + after
    shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return float(places[best] + np.clip(shift, -1, 1) * (places[best] - places[best - 1]))
