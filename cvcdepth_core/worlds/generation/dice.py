# SPDX-License-Identifier: Apache-2.0
"""Random choices in the words of a world's description."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from cvcdepth_core.worlds.description import Colour

T = TypeVar("T")

# Linear reflectances of common things.
_NATURAL: dict[str, Colour] = {
    "asphalt": (0.085, 0.085, 0.09),
    "concrete": (0.3, 0.29, 0.27),
    "plaster": (0.5, 0.45, 0.37),
    "brick": (0.26, 0.11, 0.075),
    "leaf": (0.07, 0.115, 0.028),
    "grass": (0.085, 0.13, 0.035),
    "dry_grass": (0.22, 0.18, 0.08),
    "dirt": (0.2, 0.145, 0.095),
    "gravel": (0.27, 0.25, 0.22),
    "wood": (0.2, 0.13, 0.075),
    "tiles": (0.2, 0.075, 0.05),
    "slate": (0.07, 0.072, 0.08),
    "metal": (0.3, 0.3, 0.31),
    "sand": (0.42, 0.34, 0.22),
    "snow": (0.8, 0.82, 0.85),
}
_PAINTS: tuple[tuple[float, Colour], ...] = (
    (0.22, (0.62, 0.62, 0.61)),
    (0.2, (0.012, 0.012, 0.013)),
    (0.16, (0.09, 0.092, 0.097)),
    (0.14, (0.3, 0.305, 0.31)),
    (0.08, (0.02, 0.04, 0.14)),
    (0.07, (0.25, 0.015, 0.015)),
    (0.03, (0.12, 0.1, 0.07)),
    (0.03, (0.02, 0.06, 0.035)),
    (0.02, (0.5, 0.3, 0.02)),
    (0.05, (0.05, 0.15, 0.3)),
)


class Dice:
    """A random generator that speaks of lengths, chances and colours."""

    def __init__(self, *seed: int) -> None:
        self._rng = np.random.default_rng(list(seed))

    def between(self, low: float, high: float, digits: int = 2) -> float:
        """Return A number between two, evenly; rounded, so that descriptions stay short."""
        return round(float(self._rng.uniform(low, high)), digits)

    def scale(self, low: float, high: float, digits: int = 3) -> float:
        """Return A number between two, as often in each octave."""
        return round(float(np.exp(self._rng.uniform(math.log(low), math.log(high)))), digits)

    def normal(self, deviation: float, digits: int = 2) -> float:
        """Return A number around 0."""
        return round(float(self._rng.normal(0.0, deviation)), digits)

    def chance(self, probability: float) -> bool:
        """Return True so often."""
        return bool(self._rng.random() < probability)

    def whole(self, low: int, high: int) -> int:
        """Return A whole number, both ends included."""
        return int(self._rng.integers(low, high + 1))

    def pick(self, *choices: T) -> T:
        """One of them."""
        return choices[int(self._rng.integers(len(choices)))]

    def weighted(self, weights: Mapping[T, float]) -> T:
        """One of the keys, as often as its weight says."""
        keys: Sequence[T] = list(weights)
        shares = np.array([weights[key] for key in keys])
        return keys[int(self._rng.choice(len(keys), p=shares / shares.sum()))]

    def seed(self) -> int:
        """Return A seed for something's details."""
        return int(self._rng.integers(10_000))

    def natural(self, kind: str, spread: float = 0.35, odd: float = 0.04) -> Colour:
        """Return the colour of such a thing, lighter or darker, and, as often as `odd` says, quite another."""
        if self.chance(odd):
            return self.any_colour()
        factor = np.exp(self._rng.normal(0.0, spread)) * np.exp(self._rng.normal(0.0, 0.045, 3))
        return _colour(np.array(_NATURAL[kind]) * factor)

    def any_colour(self, saturation: float = 0.8, dark: float = 0.04, bright: float = 0.6) -> Colour:
        """Any colour."""
        hue = self._rng.random(3)
        mixed = 1 - self._rng.uniform(0, saturation) * (1 - hue / hue.max())
        return _colour(np.exp(self._rng.uniform(math.log(dark), math.log(bright))) * mixed)

    def paint(self) -> Colour:
        """Colour of a car."""
        if self.chance(0.08):
            return self.any_colour()
        number = self.weighted({i: weight for i, (weight, _) in enumerate(_PAINTS)})
        return _colour(np.array(_PAINTS[number][1]) * np.exp(self._rng.normal(0, 0.25)))


def _colour(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Colour:
    r, g, b = np.round(np.clip(values, 0.004, 0.92), 3).tolist()
    return r, g, b
