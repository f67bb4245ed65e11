# SPDX-License-Identifier: Apache-2.0
"""People on foot and on two wheels. x forward, on the ground."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from cvcdepth_core.worlds.description import Person
from cvcdepth_core.worlds.shapes.meshes import Mesh, box, joined, sphere, tube
from cvcdepth_core.worlds.site import Site
from cvcdepth_core.worlds.surfaces.palette import darker, metal, paint, plain, rubber

_SKIN = (0.42, 0.27, 0.19)


def build_people(site: Site) -> None:
    """Add everybody who stands still; those who move are `person_mesh` alone."""
    for person in site.spec.people:
        if person.motion is None:
            site.stand(person.kind, person_mesh(site, person), person)


def person_mesh(site: Site, person: Person) -> Mesh:
    """Somebody in the own frame, on the ground."""
    make = _Make(site, person)
    if person.kind in ("cyclist", "parked_bicycle"):
        rider = _rider(make) if person.kind == "cyclist" else []
        return joined([*_bicycle(make), *rider])
    if person.kind == "motorcyclist":
        return joined([*_motorcycle(make), *_rider(make, seat=0.82)])
    if person.kind == "pushchair":
        return joined([*_pushchair(make), *(part.moved(-0.75) for part in _walker(make, 1.68))])
    walker = joined(_walker(make, 1.74))
    return walker.scaled(0.7, 0.74, 0.68) if person.kind == "child" else walker


class _Make:
    def __init__(self, site: Site, person: Person) -> None:
        self.rng = np.random.default_rng([site.spec.seed, person.seed, 19])
        self.upper = site.material(plain(person.colour, 1.4))
        self.lower = site.material(plain(person.second, 1.2))
        self.skin = site.material(plain(darker(_SKIN, self.rng.uniform(0.25, 1.5)), 0.6))
        self.hair = site.material(plain(darker((0.09, 0.06, 0.04), self.rng.uniform(0.2, 3.0))))
        self.black = site.material(rubber())
        self.steel = site.material(metal((0.3, 0.3, 0.3)))
        self.frame = site.material(paint(person.colour))
        self.moves = person.motion is not None


def _walker(make: _Make, height: float) -> list[Mesh]:
    h = height * make.rng.uniform(0.93, 1.08)
    stride = make.rng.uniform(0.25, 0.45) if make.moves or make.rng.random() < 0.5 else make.rng.uniform(0.0, 0.1)
    build = make.rng.uniform(0.9, 1.2)
    hip, shoulder = 0.5 * h, 0.81 * h
    parts = []
    for side in (-1.0, 1.0):
        swing = side * stride * 0.5
        knee, foot = (swing * 0.55 + 0.03, side * 0.09, 0.27 * h), (swing - 0.02, side * 0.09, 0.05 * h)
        parts.append(_limb([(0, side * 0.085, hip), knee, foot], [0.085 * build, 0.062, 0.045], make.lower))
        parts.append(
            _limb([(foot[0] - 0.05, foot[1], 0.035), (foot[0] + 0.17, foot[1], 0.03)], [0.045, 0.035], make.black)
        )
        hand = (-swing * 0.8 + 0.05, side * 0.25 * build, 0.47 * h)
        elbow = (-swing * 0.3 - 0.02, side * 0.23 * build, 0.63 * h)
        parts.append(
            _limb([(0, side * 0.19 * build, shoulder), elbow, hand], [0.055 * build, 0.045, 0.035], make.upper)
        )
        parts.append(sphere(0.045, make.skin, 1).moved(*hand))
    torso = [(0, 0, hip - 0.04), (0, 0, 0.62 * h), (0.01, 0, 0.76 * h), (0.0, 0, 0.845 * h)]
    parts.append(_limb(torso, [0.15, 0.145, 0.165, 0.07], make.upper, 10).scaled(0.78 * build, 1.12 * build, 1))
    parts += _head(make, 0.93 * h, h)
    if make.rng.random() < 0.3:
        parts.append(box(0.16, 0.28, 0.42, make.lower, 0.58 * h).moved(-0.19))
    return parts


def _head(make: _Make, z: float, h: float, x: float = 0.02) -> list[Mesh]:
    r = 0.062 * h
    head = sphere(r, make.skin, 2).scaled(1.05, 0.85, 1.2).moved(x, 0, z)
    hair = sphere(r, make.hair, 2).scaled(1.05, 0.95, 1.0).moved(x - 0.02, 0, z + 0.03)
    neck = _limb([(x - 0.02, 0, z - 0.17), (x, 0, z - 0.05)], [0.05, 0.05], make.skin)
    return [head, hair, neck]


def _limb(points: Sequence[tuple[float, float, float]], radii: list[float], material: int, sides: int = 7) -> Mesh:
    return tube(points, radii, material, sides)


def _rider(make: _Make, seat: float = 0.95) -> list[Mesh]:
    shoulder, hip = (0.12, seat + 0.5), (-0.15, seat + 0.04)
    torso = [(hip[0], 0, hip[1]), ((hip[0] + shoulder[0]) / 2 - 0.02, 0, seat + 0.28), (shoulder[0], 0, shoulder[1])]
    parts = [_limb(torso, [0.14, 0.16, 0.12], make.upper, 9)]
    for side in (-1.0, 1.0):
        knee, foot = (0.2, side * 0.12, seat - 0.25 + side * 0.1), (0.05, side * 0.12, seat - 0.62 + side * 0.15)
        parts.append(_limb([(hip[0], side * 0.09, hip[1]), knee, foot], [0.085, 0.065, 0.045], make.lower))
        arm = [
            (shoulder[0], side * 0.18, shoulder[1] - 0.04),
            (0.3, side * 0.24, seat + 0.22),
            (0.45, side * 0.25, seat + 0.12),
        ]
        parts.append(_limb(arm, [0.05, 0.042, 0.035], make.upper))
    return parts + _head(make, seat + 0.72, 1.72, x=0.18)


def _ring(radius: float, thick: float, material: int) -> Mesh:
    angle = np.linspace(0.0, 2 * math.pi, 19)
    points = np.c_[radius * np.cos(angle), np.zeros(19), radius * np.sin(angle)]
    return tube(points, np.full(19, thick), material, 4, closed=False)


def _bicycle(make: _Make) -> Iterator[Mesh]:
    r = 0.34
    for x in (-0.52, 0.55):
        yield _ring(r, 0.022, make.black).moved(x, 0, r)
        for angle in np.linspace(0, math.pi, 4, endpoint=False):
            way = np.array([math.cos(angle), 0, math.sin(angle)]) * r
            yield tube([tuple(-way), tuple(way)], [0.004, 0.004], make.steel, 3).moved(x, 0, r)
    joints = {"rear": (-0.52, r), "crank": (-0.05, 0.28), "seat": (-0.2, 0.9), "head": (0.4, 0.86), "front": (0.55, r)}
    for a, b in (
        ("rear", "crank"),
        ("rear", "seat"),
        ("crank", "seat"),
        ("seat", "head"),
        ("crank", "head"),
        ("head", "front"),
    ):
        ends = [(joints[name][0], 0.0, joints[name][1]) for name in (a, b)]
        yield tube(ends, [0.018, 0.018], make.frame, 5)
    yield box(0.26, 0.14, 0.06, make.black, 0.92).moved(-0.22)
    yield tube([(0.4, -0.28, 1.05), (0.4, 0.28, 1.05)], [0.014, 0.014], make.steel, 5)
    yield tube([(0.4, 0, 0.86), (0.4, 0, 1.05)], [0.014, 0.014], make.steel, 5)


def _motorcycle(make: _Make) -> Iterator[Mesh]:
    for x in (-0.65, 0.7):
        yield _ring(0.27, 0.06, make.black).moved(x, 0, 0.32)
    yield _limb([(-0.8, 0, 0.75), (-0.2, 0, 0.72), (0.35, 0, 0.85)], [0.1, 0.14, 0.12], make.frame, 8)
    yield box(0.6, 0.3, 0.35, make.steel, 0.3)
    yield tube([(0.7, 0, 0.32), (0.42, 0, 1.05)], [0.04, 0.04], make.steel, 5)
    yield tube([(0.42, -0.33, 1.02), (0.42, 0.33, 1.02)], [0.018, 0.018], make.black, 5)


def _pushchair(make: _Make) -> Iterator[Mesh]:
    yield box(0.7, 0.42, 0.4, make.upper, 0.45, (0.8, 0.9))
    for x in (-0.28, 0.28):
        for side in (-1.0, 1.0):
            yield _ring(0.12, 0.02, make.black).moved(x, side * 0.22, 0.14)
            yield tube([(x, side * 0.22, 0.14), (0, side * 0.2, 0.5)], [0.012, 0.012], make.steel, 4)
    yield tube([(-0.5, 0, 1.0), (-0.2, 0, 0.6)], [0.015, 0.015], make.steel, 4)
