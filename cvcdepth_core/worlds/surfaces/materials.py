# SPDX-License-Identifier: Apache-2.0
"""What surfaces are made of: each material is a pattern with colours and two layers of noise, evaluated anywhere."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from cvcdepth_core.worlds.shapes.meshes import Floats, Ints
from cvcdepth_core.worlds.surfaces.noise import Noise, noise

Colour = tuple[float, float, float]
"""Linear reflectance, red, green, blue, 0 to 1."""


class Pattern(IntEnum):
    """How a material's colours are laid out over its texture coordinates; the numbers are its `parameters`."""

    PLAIN = 0
    """One colour with noise."""
    MOTTLED = 1
    """Two colours mixed by the noise: grass, earth, leaves."""
    SLABS = 2
    """Slabs with joints: length, width, joint width (metres), offset of every other row (0 to 1)."""
    BRICK = 3
    """Courses of bricks with mortar of the second colour: length, height, joint width."""
    STRIPES = 4
    """Two colours in turn: period, 1 for stripes along v, share of the first, slant."""
    PLANKS = 5
    """Boards with gaps: width, 1 for upright boards."""
    FACADE = 6
    """Wall with windows: see `FacadeParameters`."""
    MARKING = 7
    """Paint of the first colour, worn down to the second: wear (0 to 1)."""
    SIGN = 8
    """First colour with a border and bars of the second: width, height, border."""
    ROAD = 9
    """Asphalt or concrete with repairs and worn tracks: lane width, distance of the first lane's middle, wear."""


class FacadeParameters(NamedTuple):
    """Numbers of `Pattern.FACADE`; lengths in metres."""

    storey: float = 3.2
    bay: float = 3.0
    window_width: float = 0.45
    """Share of the bay."""
    window_height: float = 0.5
    """Share of the storey."""
    style: float = 0.0
    """0 single windows, 1 divided windows, 2 bands of windows, 3 glass from floor to floor."""
    ground_height: float = 3.6
    """Height of the ground floor."""
    ground_kind: float = 0.0
    """0 as above, 1 shop windows, 2 doors and gates, 3 blind."""
    wall: float = 0.0
    """0 plaster, 1 bricks, 2 panels, 3 boards, 4 corrugated metal."""
    seed: float = 0.0
    lit: float = 0.0
    """Share of the windows that are lit."""


@dataclass(frozen=True)
class Layer:
    """A layer of noise that lightens and darkens a material."""

    kind: Noise = Noise.ROUGH
    texels: float = 20.0
    """Texels per metre."""
    amplitude: float = 0.1
    """Standard deviation as a share of the colour."""


@dataclass(frozen=True)
class Material:
    """One surface."""

    colour: Colour
    second: Colour = (0.0, 0.0, 0.0)
    pattern: Pattern = Pattern.PLAIN
    coarse: Layer = Layer(Noise.CLOUDY, 8.0, 0.1)
    fine: Layer = Layer(Noise.ROUGH, 90.0, 0.08)
    gloss: float = 0.0
    """Strength of mirror-like reflection, 0 to 1."""
    ripple: float = 0.0
    """Unevenness that bends reflections and leaves dry places, as of a wet road; 0 is a mirror."""
    leafy: float = 0.0
    """How much light passes through, 0 to 1."""
    emission: float = 0.0
    """Light of its own, as a multiple of its colour."""
    parameters: tuple[float, ...] = ()


_PARAMETERS = 10
_COMMON = 22  # columns that every pattern has; the parameters follow
_COLUMNS = _COMMON + _PARAMETERS


class MaterialTable:
    """The materials of a world, by number."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._known: dict[Material, int] = {}

    def add(self, material: Material) -> int:
        """Return the material's number; equal ones have the same."""
        if material not in self._known:
            self._known[material] = len(self._rows)
            self._rows.append(_row(material, len(self._rows)))
        return self._known[material]

    def array(self) -> Floats:
        """All of them, float32 [M, columns], for `evaluate`."""
        return np.array(self._rows, np.float32).reshape(-1, _COLUMNS)


def _row(material: Material, number: int) -> tuple[float, ...]:
    m = material
    parameters = (*m.parameters, *([0.0] * (_PARAMETERS - len(m.parameters))))
    # Each material begins elsewhere in the tiles, so that like ones side by side do not look alike.
    offset = np.random.default_rng([7, number]).uniform(0.0, 256.0, 2).tolist()
    layers = (m.coarse.kind, m.coarse.texels, m.coarse.amplitude, m.fine.kind, m.fine.texels, m.fine.amplitude)
    return (
        m.pattern,
        *m.colour,
        *m.second,
        *layers,
        m.gloss,
        m.leafy,
        m.emission,
        *offset,
        m.ripple,
        0,
        0,
        0,
        *parameters,
    )


class Surface(NamedTuple):
    """What `evaluate` finds at N places."""

    colour: Floats
    """[3, N] linear reflectance."""
    gloss: Floats
    """[N]"""
    leafy: Floats
    """[N]"""
    emission: Floats
    """[3, N] linear light."""
    ripple: Floats
    """[N] by how much reflections are bent."""


class _Place(NamedTuple):
    """Places of one pattern while they are evaluated; [N] each."""

    rows: Floats
    u: Floats
    v: Floats
    footprint: Floats
    coarse: Floats
    fine: Floats

    def parameter(self, number: int) -> Floats:
        found: Floats = self.rows[_COMMON + number]
        return found

    def sharpness(self, size: Floats | np.float32 | float) -> Floats:
        """1 where details of this size (metres) can be seen, 0 where they are far below a pixel."""
        return np.clip(size / np.maximum(self.footprint, 1e-6) - 0.3, 0.0, 1.0).astype(np.float32)


def evaluate(table: Floats, materials: Ints, u: Floats, v: Floats, footprint: Floats) -> Surface:
    """Colours and more at the texture coordinates u, v [N], seen with pixels `footprint` [N] wide, all in metres."""
    columns = np.ascontiguousarray(table.T)
    rows = columns[:_COMMON].take(materials, axis=1)
    coarse = _layer(rows, 7, u, v, footprint)
    fine = _layer(rows, 10, u, v, footprint)
    shade = np.clip(1.0 + coarse + fine, 0.15, 2.2)
    wet = np.clip(0.65 + 0.5 * coarse / np.maximum(rows[9], 1e-3), 0.1, 1.0)
    gloss = rows[13] * np.where(rows[18] > 0, wet, 1.0)
    surface = Surface(
        rows[1:4] * shade, gloss, rows[14], rows[1:4] * rows[15], rows[18] * fine / np.maximum(rows[12], 1e-3)
    )
    place = _Place(rows, u, v, footprint, coarse, fine)
    pattern = rows[0].astype(np.int32)
    for number, apply in _PATTERNS.items():
        chosen = np.flatnonzero(pattern == number)
        if len(chosen):
            own = columns.take(materials[chosen], axis=1)
            apply(surface, chosen, _Place(own, *(values.take(chosen) for values in place[1:])))
    np.clip(surface.colour, 0.0, 0.95, out=surface.colour)
    return surface


def _layer(rows: Floats, first: int, u: Floats, v: Floats, footprint: Floats) -> Floats:
    kind, texels, amplitude = rows[first], rows[first + 1], rows[first + 2]
    found: Floats = amplitude * noise(
        kind.astype(np.int32), u * texels + rows[16], v * texels + rows[17], footprint * texels
    )
    return found


def _mottled(surface: Surface, chosen: Ints, place: _Place) -> None:
    amplitude = np.maximum(place.rows[9] + place.rows[12], 1e-6)
    share = np.clip(0.5 + 0.7 * (place.coarse + place.fine) / amplitude, 0.0, 1.0)
    mixed = place.rows[1:4] * share + place.rows[4:7] * (1.0 - share)
    surface.colour[:, chosen] = mixed * np.clip(1.0 + 0.5 * place.fine + 0.3 * place.coarse, 0.3, 2.0)


def _slabs(surface: Surface, chosen: Ints, place: _Place) -> None:
    length, width, joint, shift = (place.parameter(i) for i in range(4))
    row = np.floor(place.v / width)
    along = place.u / length + shift * np.mod(row, 2.0)
    in_joint = _lines(along, joint / length) | _lines(place.v / width, joint / width)
    own = 1.0 + 0.16 * (_hash(np.floor(along), row) - 0.5) * place.sharpness(length / 2)
    surface.colour[:, chosen] *= own * (1.0 - 0.4 * in_joint * place.sharpness(joint * 1.5))


def _brick(surface: Surface, chosen: Ints, place: _Place) -> None:
    surface.colour[:, chosen] = _brick_colour(place, surface.colour[:, chosen], place.parameter(0), place.parameter(1))


def _brick_colour(place: _Place, colour: Floats, length: Floats | np.float32, height: Floats | np.float32) -> Floats:
    row = np.floor(place.v / height)
    along = place.u / length + 0.5 * np.mod(row, 2.0)
    joint = np.float32(0.011)
    in_joint = (_lines(along, joint / length) | _lines(place.v / height, joint / height)) * place.sharpness(0.02)
    own = 1.0 + 0.5 * (_hash(np.floor(along), row) - 0.5) * place.sharpness(height)
    found: Floats = colour * own * (1.0 - in_joint) + place.rows[4:7] * in_joint
    return found


def _stripes(surface: Surface, chosen: Ints, place: _Place) -> None:
    period, upright, share, slant = (place.parameter(i) for i in range(4))
    across = np.where(upright > 0.5, place.u + slant * place.v, place.v + slant * place.u)
    first = np.mod(across / period, 1.0) < share
    sharp = place.sharpness(period / 2)
    amount = first * sharp + share * (1.0 - sharp)
    shade = 1.0 + place.coarse + place.fine
    surface.colour[:, chosen] = (place.rows[1:4] * amount + place.rows[4:7] * (1.0 - amount)) * shade


def _planks(surface: Surface, chosen: Ints, place: _Place) -> None:
    width, upright = place.parameter(0), place.parameter(1)
    surface.colour[:, chosen] *= _plank_shade(place, width, upright)


def _plank_shade(place: _Place, width: Floats | np.float32, upright: Floats | np.float32) -> Floats:
    across = np.where(upright > 0.5, place.u, place.v) / width
    gap = _lines(across, np.float32(0.012) / width) * place.sharpness(0.02)
    return (1.0 + 0.3 * (_hash(np.floor(across), 0.0 * across) - 0.5) * place.sharpness(width)) * (1.0 - 0.65 * gap)


def _marking(surface: Surface, chosen: Ints, place: _Place) -> None:
    wear = place.parameter(0)
    worn = np.clip((0.9 * place.coarse + 0.9 * place.fine) * 4.0 + 2.2 * wear - 1.3, 0.0, 0.92)
    under = place.rows[4:7] * (1.0 + place.fine)
    surface.colour[:, chosen] = surface.colour[:, chosen] * (1.0 - worn) + under * worn


def _sign(surface: Surface, chosen: Ints, place: _Place) -> None:
    width, height, border = (place.parameter(i) for i in range(3))
    x, y = np.abs(place.u) / width * 2.0, place.v / height
    at_border = (x > 1.0 - 2 * border / width) | (y < border / height) | (y > 1.0 - border / height)
    line = np.floor(y * 5.0)
    reach = 0.25 + 0.6 * _hash(line, place.rows[16])
    in_bar = (np.mod(line, 2.0) == 1.0) & (x < reach) & (np.mod(y * 5.0, 1.0) < 0.75)
    bars = in_bar & (_hash(np.floor(place.u * 9.0), line) > 0.25)
    second = (at_border | bars) * place.sharpness(0.08)
    surface.colour[:, chosen] = surface.colour[:, chosen] * (1.0 - second) + place.rows[4:7] * second


def _road(surface: Surface, chosen: Ints, place: _Place) -> None:
    """Apply it; u runs along the road, v to its left from its middle."""
    lane, first, wear = (place.parameter(i) for i in range(3))
    patched = noise(Noise.BLOTCHES, place.u * 5.0 + place.rows[16], place.v * 9.0, place.footprint * 7.0)
    repair = np.clip(1.5 * (patched - 2.4 + 1.7 * wear), 0.0, 1.0)
    tracks = 0.5 + 0.5 * np.cos((place.v - first) / np.maximum(lane, 0.1) * np.float32(4 * np.pi))
    track_shade = 1.0 - 0.1 * wear * tracks * (lane > 0.1)
    cracks = noise(Noise.CRACKS, place.u * 28.0, place.v * 28.0 + place.rows[17], place.footprint * 28.0)
    seams = 1.0 + 0.09 * np.clip(cracks, -4.0, 0.5) * wear
    surface.colour[:, chosen] *= track_shade * seams * (1.0 - 0.28 * repair)


def _facade(surface: Surface, chosen: Ints, place: _Place) -> None:
    f = FacadeParameters._make(place.parameter(i) for i in range(_PARAMETERS))  # each an array of all places
    cell = _facade_cell(place, f)
    wall = _wall_colour(place, surface.colour[:, chosen], f) * cell.relief
    sharp = place.sharpness(np.asarray(f.bay) * 0.25)
    window = cell.window * sharp + cell.share * (1.0 - sharp)
    frame = cell.frame * sharp * (1.0 - cell.window)
    colour = wall * (1.0 - frame) + 0.55 * frame
    glass = place.rows[4:7] * cell.darkness
    glass = np.where(cell.curtain, (0.32 + 0.25 * cell.random)[None], glass)
    surface.colour[:, chosen] = colour * (1.0 - window) + glass * window
    surface.gloss[chosen] = np.where(cell.curtain, 0.35, 0.75) * window
    lit = (_hash(cell.random * 91.0, np.asarray(f.seed)) < np.asarray(f.lit)) & (cell.window > 0)
    surface.emission[:, chosen] = np.where(lit, np.array([[1.0], [0.72], [0.4]]) * (0.25 + 0.9 * cell.random), 0.0)


class _FacadeCell(NamedTuple):
    window: Floats
    frame: Floats
    relief: Floats
    """Shade of sills, bands and the plinth on the wall."""
    curtain: Floats
    darkness: Floats
    random: Floats
    """Of this window, 0 to 1."""
    share: Floats
    """Of the wall that is window, for what is too far to be told apart."""


def _facade_cell(place: _Place, f: FacadeParameters) -> _FacadeCell:
    u, v = place.u, place.v
    ground = v < f.ground_height
    kind = np.where(ground, f.ground_kind, 0.0)
    storey = np.where(ground, f.ground_height, f.storey)
    level = np.where(ground, -1.0, np.floor((v - f.ground_height) / f.storey))
    fv = np.where(ground, v / f.ground_height, np.mod((v - f.ground_height) / f.storey, 1.0))
    bay = np.where(kind > 0.5, f.bay * 1.7, f.bay)
    column, fu = np.floor(u / bay), np.abs(np.mod(u / bay, 1.0) - 0.5)
    random = _hash(column + 17.0 * f.seed, level)
    shape = _opening(kind, f, random)
    dx, dy = (shape.width / 2 - fu) * bay, (shape.height / 2 - np.abs(fv - shape.middle)) * storey
    window = (dx > 0) & (dy > 0) & (v > 0.0) & ~shape.blind
    frame = (dx > -0.07) & (dy > -0.07) & ~window & ~shape.blind & (kind < 1.5)
    divided = (
        (f.style > 0.5) & (f.style < 1.5) & ((fu * bay < 0.035) | (np.abs(fv - shape.middle - 0.08) * storey < 0.03))
    )
    mullion = (f.style > 1.5) & ((np.abs(np.mod(u / 1.4, 1.0) - 0.5) > 0.475) | (dy < 0.05))
    frame = frame | (window & (divided | mullion) & (kind < 0.5))
    window = window & ~frame
    # The reveal throws a shadow on the upper edge of the glass, the sill catches light.
    sill = (dx > -0.1) & (dy < -0.07) & (dy > -0.2) & (fv < shape.middle) & (kind < 0.5) & ~shape.blind
    relief = 1.0 + 0.3 * sill - 0.25 * (v < 0.5) - 0.14 * (np.abs(v - f.ground_height) < 0.12)
    drawn = (random > 0.62) & (fv > shape.middle + shape.height * (0.5 - 1.6 * (random - 0.62))) & (kind < 0.5)
    darkness = (0.35 + 1.3 * random) * np.where(dy > 0.1, 1.0, 0.6)
    share = np.where(shape.blind, 0.0, shape.width * shape.height)
    return _FacadeCell(window * 1.0, frame * 1.0, relief, drawn, darkness, random, share)


class _Opening(NamedTuple):
    width: Floats
    height: Floats
    middle: Floats
    blind: Floats


def _opening(kind: Floats, f: FacadeParameters, random: Floats) -> _Opening:
    """Width, height (shares of the cell) and middle of the window or door in each cell."""
    shop, gate, blind = kind == 1.0, kind == 2.0, kind == 3.0
    band, glass = (f.style > 1.5) & (kind < 0.5), (f.style > 2.5) & (kind < 0.5)
    width = np.where(shop, 0.86, np.where(gate, 0.3 + 0.4 * random, np.where(band, 1.1, f.window_width)))
    height = np.where(shop, 0.66, np.where(gate, 0.72, np.where(glass, 0.9, f.window_height)))
    middle = np.where(shop, 0.48, np.where(gate, 0.36, 0.53))
    return _Opening(width, height, middle, blind | ((random < 0.05) & (kind < 0.5) & ~band))


def _wall_colour(place: _Place, colour: Floats, f: FacadeParameters) -> Floats:
    streaks = noise(Noise.STREAKS, place.u * 30.0, place.v * 9.0 + place.rows[16], place.footprint * 30.0)
    colour = colour * (1.0 + 0.05 * streaks)
    for number, shade in _WALLS.items():
        chosen = np.flatnonzero(np.asarray(f.wall) == number)
        if len(chosen):
            part = _Place(place.rows.take(chosen, axis=1), *(values.take(chosen) for values in place[1:]))
            colour[:, chosen] = shade(part, colour.take(chosen, axis=1))
    return colour


def _brick_wall(place: _Place, colour: Floats) -> Floats:
    mortar = 0.75 * place.rows[1:4] + 0.12
    rows = np.concatenate([place.rows[:4], mortar, place.rows[7:]])
    return _brick_colour(place._replace(rows=rows), colour, np.float32(0.24), np.float32(0.077))


def _panel_wall(place: _Place, colour: Floats) -> Floats:
    storey, bay, ground = place.parameter(0), place.parameter(1), place.parameter(5)
    joint = _lines(place.u / bay, 0.02 / bay) | _lines((place.v - ground) / storey, 0.02 / storey)
    found: Floats = colour * (1.0 - 0.35 * joint * place.sharpness(0.03))
    return found


def _board_wall(place: _Place, colour: Floats) -> Floats:
    return colour * _plank_shade(place, np.float32(0.16), np.float32(0.0))


def _metal_wall(place: _Place, colour: Floats) -> Floats:
    found: Floats = colour * (1.0 + 0.28 * np.sin(place.u * np.float32(2 * np.pi / 0.22)) * place.sharpness(0.11))
    return found


_WALLS = {1.0: _brick_wall, 2.0: _panel_wall, 3.0: _board_wall, 4.0: _metal_wall}


def _lines(position: Floats, width: Floats) -> Floats:
    """Whether a place lies in the line, `width` wide, at the beginning of every unit."""
    return np.mod(position, 1.0) < width


def _hash(a: Floats, b: Floats) -> Floats:
    """Random number in [0, 1) of two numbers."""
    x = np.sin(np.asarray(a, np.float64) * 12.9898 + np.asarray(b, np.float64) * 78.233) * 43758.5453
    return (x - np.floor(x)).astype(np.float32)


_PATTERNS = {
    Pattern.MOTTLED: _mottled,
    Pattern.SLABS: _slabs,
    Pattern.BRICK: _brick,
    Pattern.STRIPES: _stripes,
    Pattern.PLANKS: _planks,
    Pattern.FACADE: _facade,
    Pattern.MARKING: _marking,
    Pattern.SIGN: _sign,
    Pattern.ROAD: _road,
}
