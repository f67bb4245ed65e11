# SPDX-License-Identifier: Apache-2.0
"""Plane curves of straights, arcs and easements: the centre lines of roads and the ways of vehicles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cvcdepth_core.worlds.shapes.meshes import Floats

_STEP = 0.25  # metres; between them the curve is an arc to 1e-6 m
_SEARCH_STEP = 4  # samples: the spacing at which the nearest place is first looked for


class Path:
    """A curve whose curvature changes linearly within each segment.

    Beyond its ends it goes on straight. Distances s are metres from its start, l metres to its left.
    """

    def __init__(self, start: tuple[float, float, float], segments: Sequence[tuple[float, float, float]]) -> None:
        """`start`: x, y, heading (radians); `segments`: length, curvature at its start and at its end (1/m, left > 0).

        Lengths are rounded to whole steps of 0.25 m.
        """
        curvatures = [np.linspace(a, b, max(1, round(length / _STEP)) + 1) for length, a, b in segments]
        self._lay(start, np.concatenate([np.zeros(0), *((c[1:] + c[:-1]) / 2 for c in curvatures)]))

    @classmethod
    def from_curvatures(cls, start: tuple[float, float, float], curvatures: Floats) -> Path:
        """Build it from the curvature of each step of 0.25 m."""
        path = cls(start, ())
        path._lay(start, curvatures)
        return path

    def _lay(self, start: tuple[float, float, float], middle: Floats) -> None:
        self._curvature = np.r_[middle, middle[-1:] if len(middle) else 0.0]
        self._heading = start[2] + np.r_[0.0, np.cumsum(middle * _STEP)]
        half = self._heading[:-1] + middle * _STEP / 2
        # The chord of an arc, not its length.
        turn = middle * _STEP / 2
        chord = _STEP * np.sinc(turn / math.pi)
        steps = np.stack([np.cos(half), np.sin(half)], axis=1) * chord[:, None]
        self._points = np.r_[[start[:2]], np.array(start[:2]) + np.cumsum(steps, axis=0)]
        self.length = _STEP * len(middle)
        """Metres."""

    def heading(self, s: Floats | float) -> Floats:
        """Direction of travel at s, radians."""
        i, ds = self._sample(s)
        found: Floats = self._heading[i] + np.where(self._inside(s), self._curvature[i], 0.0) * ds
        return found

    def curvature(self, s: Floats | float) -> Floats:
        """1/m at s, positive to the left; 0 beyond the ends."""
        middles = (np.arange(len(self._curvature)) + 0.5) * _STEP
        return np.where(self._inside(s), np.interp(s, middles, self._curvature), 0.0)

    def points(self, s: Floats | float, lateral: Floats | float = 0.0) -> Floats:
        """x, y [..., 2] at s along the curve and l to its left."""
        s, left = np.broadcast_arrays(np.asarray(s, np.float64), np.asarray(lateral, np.float64))
        i, ds = self._sample(s)
        turn = np.where(self._inside(s), self._curvature[i], 0.0) * ds / 2
        heading = self._heading[i] + turn
        chord = ds * np.sinc(turn / math.pi)
        normal = self._heading[i] + 2 * turn
        x = self._points[i, 0] + chord * np.cos(heading) - left * np.sin(normal)
        y = self._points[i, 1] + chord * np.sin(heading) + left * np.cos(normal)
        return np.stack([x, y], axis=-1)

    def locate(self, points: Floats) -> tuple[Floats, Floats]:
        """Return s and l of points [N, 2], by the nearest place on the curve; s may lie beyond its ends."""
        coarse = self._points[::_SEARCH_STEP]
        nearest = np.empty(len(points), np.int64)
        for first in range(0, len(points), 4096):
            block = points[first : first + 4096]
            squared = (block[:, :1] - coarse[:, 0]) ** 2 + (block[:, 1:] - coarse[:, 1]) ** 2
            nearest[first : first + 4096] = squared.argmin(axis=1)
        s = np.minimum(nearest * _SEARCH_STEP * _STEP, self.length)
        left = np.zeros(len(points))
        for _ in range(3):
            heading, base, curvature = self.heading(s), self.points(s), self.curvature(s)
            dx, dy = (points - base).T
            ahead = np.cos(heading) * dx + np.sin(heading) * dy
            left = -np.sin(heading) * dx + np.cos(heading) * dy
            s = s + ahead / np.clip(1 - curvature * left, 0.2, 5.0)
        return s, left

    def offset(self, left: float) -> Path:
        """Return the curve that keeps `left` metres to this one's left; must not reach its centres of curvature."""
        i = np.arange(len(self._points) - 1)
        k = self._curvature[i]
        shift = 1 - k * left
        x, y = self.points(0.0, left).tolist()
        lengths, curvatures = _STEP * shift, k / np.where(np.abs(shift) > 0.05, shift, 0.05)
        return _resampled((x, y, float(self._heading[0])), lengths, curvatures)

    def reversed(self) -> Path:
        """Return the same curve from its end to its beginning."""
        x, y = self.points(self.length).tolist()
        count = len(self._points) - 1
        return _resampled(
            (x, y, float(self._heading[-1]) + math.pi), np.full(count, _STEP), -self._curvature[:count][::-1]
        )

    def _inside(self, s: Floats | float) -> Floats:
        return (np.asarray(s) >= 0.0) & (np.asarray(s) <= self.length)

    def _sample(self, s: Floats | float) -> tuple[Floats, Floats]:
        s = np.asarray(s, np.float64)
        i = np.clip(np.floor(s / _STEP), 0, max(0, len(self._points) - 2)).astype(np.int64)
        past_end = s > self.length
        i = np.where(past_end, len(self._points) - 1, i)
        return i, s - _STEP * i


def _resampled(start: tuple[float, float, float], lengths: Floats, curvatures: Floats) -> Path:
    """Build a path from many short arcs, at its own spacing."""
    ends = np.r_[0.0, np.cumsum(lengths)]
    headings = np.r_[0.0, np.cumsum(lengths * curvatures)]
    count = max(1, round(ends[-1] / _STEP))
    turned = np.interp(np.arange(count + 1) * _STEP, ends, headings)
    return Path.from_curvatures(start, np.diff(turned) / _STEP)


def eased(segments: Sequence[tuple[float, float]], easement: float = 6.0) -> list[tuple[float, float, float]]:
    """Join arcs (length, curvature) by easements, over which a steering wheel is turned, of at most this length."""
    joined: list[tuple[float, float, float]] = []
    before = 0.0
    for length, curvature in segments:
        ease = min(easement, length / 2) if curvature != before else 0.0
        if ease:
            joined.append((ease, before, curvature))
        joined.append((length - ease, curvature, curvature))
        before = curvature
    return joined
