# SPDX-License-Identifier: Apache-2.0
"""Pictures of surround depth: colour-coded depth, a view from above, and the contact sheet that holds both.

All pictures are RGB, uint8 [height, width, 3].
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.rig.rig import Camera, Rig, order_around_vehicle

Colour = tuple[int, int, int]
Points = NDArray[np.floating]

BACKGROUND: Colour = (18, 20, 24)
PANEL: Colour = (28, 31, 37)
TEXT: Colour = (235, 238, 242)
QUIET_TEXT: Colour = (150, 158, 170)
WARNING: Colour = (255, 196, 64)
GRID: Colour = (62, 68, 78)
_AXIS: Colour = (104, 112, 126)
_LIDAR: Colour = (0, 235, 255)
_VEHICLE: Colour = (245, 245, 245)

_GRID_METRES = 10
_VEHICLE_LENGTH, _VEHICLE_WIDTH = 4.6, 1.9  # metres; a symbol of a car's size, for the rig does not know its vehicle
_FIELD_OF_VIEW_METRES = 4.0
_CLOUD_GAMMA = 0.6
_TICKS = (1, 2, 5, 10, 20, 40, 80, 160)


@dataclass(frozen=True)
class DepthScale:
    """Colour scale of depth: logarithmic from `near` (red) to `far` (dark blue), both in metres."""

    near: float = 1.0
    far: float = 80.0

    def __post_init__(self) -> None:
        if not 0 < self.near < self.far < math.inf:
            raise ConfigError(f"depth scale: want 0 < near < far, found near {self.near}, far {self.far}")

    def colours(self, depth: NDArray[np.float32]) -> Picture:
        """Colour depths [...] in metres as RGB [..., 3]; what is beyond an end has the end's colour, NaN is black."""
        with np.errstate(divide="ignore", invalid="ignore"):
            farness = np.log(depth / self.near) / math.log(self.far / self.near)
        known = ~np.isnan(farness)
        entries = 255 - np.rint(255 * np.clip(np.where(known, farness, 0.0), 0.0, 1.0)).astype(np.uint8)
        colours: Picture = _turbo()[entries] * known[..., None].astype(np.uint8)
        return colours

    def ticks(self) -> list[float]:
        """Return round depths within the scale, metres."""
        return [tick for tick in _TICKS if self.near <= tick <= self.far]


@dataclass(frozen=True)
class TopDownView:
    """A map of the base frame (REP 105), x forward and up in the picture, y to the left."""

    width: int
    height: int
    pixels_per_metre: float
    centre: tuple[float, float] = (0.0, 0.0)
    """x, y in metres of the picture's centre."""

    def pixels(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return column and row [..., 2] of points [..., 2 or more] in the base frame, metres."""
        column = self.width / 2 - (points[..., 1] - self.centre[1]) * self.pixels_per_metre
        row = self.height / 2 - (points[..., 0] - self.centre[0]) * self.pixels_per_metre
        return np.stack([column, row], axis=-1).astype(np.float64)

    def grid_lines(self) -> tuple[list[int], list[int]]:
        """Return the x and the y, in whole metres, at which grid lines cross the view."""
        spans = (self.height / self.pixels_per_metre, self.width / self.pixels_per_metre)
        ends = [(middle - span / 2, middle + span / 2) for middle, span in zip(self.centre, spans, strict=True)]
        x, y = (
            list(range(math.ceil(low / _GRID_METRES) * _GRID_METRES, math.floor(high) + 1, _GRID_METRES))
            for low, high in ends
        )
        return x, y


class ColouredPoints(NamedTuple):
    """A point cloud in the base frame."""

    xyz: Points
    """[M, 3] metres."""
    rgb: NDArray[np.uint8]
    """[M, 3]."""


@dataclass(frozen=True, eq=False)
class SurroundPictures:
    """Content of one contact sheet; arrays hold the cameras in the rig's order."""

    pictures: NDArray[np.uint8]
    """[N, H, W, 3] RGB."""
    depth: NDArray[np.float32]
    """[N, H, W] metres, NaN where unknown: pixel by pixel that of `pictures`."""
    cloud: ColouredPoints
    """Point cloud of the depth."""
    lidar: Points | None
    """[M, 3] metres in the base frame at the anchor's stamp."""
    title: str
    captions: Sequence[str] = ()
    """Lines below the pictures."""
    warning: str = ""
    """Shown in the header."""


def contact_sheet(rig: Rig, shown: SurroundPictures, scale: DepthScale | None = None) -> Picture:
    """Draw one set: every camera's picture over its depth, the legend, and the scene from above; 1920 pixels wide."""
    scale = scale or DepthScale()
    tiles = _camera_tiles(rig, shown, scale)
    legend = _legend(scale, tiles.shape[1])
    left = np.concatenate([tiles, _filled(_GAP, tiles.shape[1], BACKGROUND), legend])
    view = TopDownView(_SHEET_WIDTH - 3 * _MARGIN - left.shape[1], left.shape[0], _PIXELS_PER_METRE, _VIEW_CENTRE)
    header, footer = _header(shown), _footer(shown)
    sheet = _filled(header.shape[0] + left.shape[0] + footer.shape[0], _SHEET_WIDTH, BACKGROUND)
    _paste(sheet, header, 0, 0)
    _paste(sheet, left, header.shape[0], _MARGIN)
    _paste(sheet, top_down(rig, shown.cloud, shown.lidar, view), header.shape[0], left.shape[1] + 2 * _MARGIN)
    _paste(sheet, footer, header.shape[0] + left.shape[0], 0)
    return sheet


def top_down(rig: Rig, cloud: ColouredPoints, lidar: Points | None, view: TopDownView) -> Picture:
    """Draw the scene from above: grid, cloud in its own colours, LiDAR over it, the vehicle with its cameras."""
    picture = _filled(view.height, view.width, PANEL)
    _draw_grid(picture, view)
    _plot(picture, view, cloud.xyz, _brightened(cloud.rgb), size=3)
    if lidar is not None:
        _plot(picture, view, lidar, np.broadcast_to(np.array(_LIDAR, dtype=np.uint8), lidar.shape), size=2)
    _draw_vehicle(picture, view, rig)
    _draw_grid_labels(picture, view)
    return picture


def viewing_rows(rig: Rig) -> list[list[str]]:
    """Return the cameras' names in two rows as one looks at them: ahead from left to right, then the others likewise.

    The lower row goes on around the vehicle, from the left side over the back to the right side.
    """
    around = order_around_vehicle({camera.name: camera.base_T_camera for camera in rig.cameras})
    columns = math.ceil(len(around) / 2)
    first = columns // 2
    upper = [around[-i] for i in range(-first, columns - first)]
    return [upper, [name for name in around if name not in upper]]


_SHEET_WIDTH = 1920
_MARGIN = 16
_GAP = 6
_TILES_WIDTH = 1164
_PIXELS_PER_METRE = 12.0
_LABEL_HEIGHT = 28
_VIEW_CENTRE = (8.0, 0.0)  # metres: more of what is ahead than of what lies behind


def _camera_tiles(rig: Rig, shown: SurroundPictures, scale: DepthScale) -> Picture:
    rows = viewing_rows(rig)
    width = (_TILES_WIDTH - _GAP * (len(rows[0]) - 1)) // len(rows[0])
    height = round(width * shown.depth.shape[1] / shown.depth.shape[2])
    tiles = _filled(4 * height + 4 * _GAP, _TILES_WIDTH, BACKGROUND)
    for i, names in enumerate(rows):
        top = i * (2 * height + 3 * _GAP)
        for j, name in enumerate(names):
            index, left = rig.names.index(name), j * (width + _GAP)
            tile = _resized(shown.pictures[index], width, height)
            _label(tile, name)
            _paste(tiles, tile, top, left)
            _paste(tiles, _resized(scale.colours(shown.depth[index]), width, height), top + height + _GAP // 3, left)
    return tiles


def _legend(scale: DepthScale, width: int) -> Picture:
    """Draw the colour bar over its ticks in metres."""
    legend = _filled(72, width, BACKGROUND)
    bar_left, bar_right, top, bottom = 340, width - 180, 12, 34
    span = np.linspace(0.0, 1.0, bar_right - bar_left)
    depths = scale.near * (scale.far / scale.near) ** span
    legend[top:bottom, bar_left:bar_right] = scale.colours(depths.astype(np.float32))
    for tick in scale.ticks():
        column = bar_left + round((bar_right - bar_left - 1) * math.log(tick / scale.near, scale.far / scale.near))
        cv2.line(legend, (column, bottom), (column, bottom + 6), QUIET_TEXT, 1)
        _write(legend, f"{tick:g} m", (column, bottom + 28), centred=True)
    _write(legend, "depth along each camera's axis", (0, bottom - 4), colour=TEXT)
    _write(legend, "black: unknown", (bar_right + 24, bottom - 4))
    return legend


def _header(shown: SurroundPictures) -> Picture:
    header = _filled(64, _SHEET_WIDTH, BACKGROUND)
    _write(header, shown.title, (_MARGIN, 43), size=1.0, colour=TEXT)
    if shown.warning:
        _write(header, shown.warning, (_SHEET_WIDTH - _MARGIN, 42), size=0.9, colour=WARNING, right=True)
    return header


def _footer(shown: SurroundPictures) -> Picture:
    footer = _filled(14 + 30 * len(shown.captions), _SHEET_WIDTH, BACKGROUND)
    for i, caption in enumerate(shown.captions):
        _write(footer, caption, (_MARGIN, 28 + 30 * i))
    return footer


def _draw_grid(picture: Picture, view: TopDownView) -> None:
    xs, ys = view.grid_lines()
    for x in xs:
        row = round(float(view.pixels(np.array([x, 0.0]))[1]))
        cv2.line(picture, (0, row), (view.width, row), _AXIS if x == 0 else GRID, 1)
    for y in ys:
        column = round(float(view.pixels(np.array([0.0, y]))[0]))
        cv2.line(picture, (column, 0), (column, view.height), _AXIS if y == 0 else GRID, 1)


def _draw_grid_labels(picture: Picture, view: TopDownView) -> None:
    """Write the metres of the lines ahead and to the left, as x and y of REP 105 count them."""
    xs, ys = view.grid_lines()
    for x in xs:
        row = round(float(view.pixels(np.array([x, 0.0]))[1]))
        if row > _LABEL_HEIGHT:
            _write(picture, f"{x:+d} m" if x else "0", (8, row - 6), outlined=True)
    for y in ys:
        column = round(float(view.pixels(np.array([0.0, y]))[0]))
        _write(picture, f"{y:+d}" if y else "0", (column + 6, view.height - 10), outlined=True)


def _draw_vehicle(picture: Picture, view: TopDownView, rig: Rig) -> None:
    """Draw a car's outline around the cameras, a mark at its front, and where each camera looks."""
    for camera in rig.cameras:
        edges = view.pixels(_field_of_view(camera))
        cv2.polylines(picture, [np.rint(edges).astype(np.int32)], True, _VEHICLE, 1, cv2.LINE_AA)
    x, y = np.mean([camera.base_T_camera[:2, 3] for camera in rig.cameras], axis=0)
    half_length, half_width = _VEHICLE_LENGTH / 2, _VEHICLE_WIDTH / 2
    corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) * (half_length, half_width) + (x, y)
    front = np.array([(1.0, 0.0), (0.45, 0.7), (0.45, -0.7)]) * (half_length, half_width) + (x, y)
    outline, mark = (np.rint(view.pixels(shape)).astype(np.int32) for shape in (corners, front))
    cv2.fillPoly(picture, [outline], BACKGROUND, cv2.LINE_AA)
    cv2.polylines(picture, [outline], True, _VEHICLE, 2, cv2.LINE_AA)
    cv2.fillPoly(picture, [mark], _VEHICLE, cv2.LINE_AA)


def _field_of_view(camera: Camera) -> NDArray[np.float64]:
    """Return the corners [3, 3], in the base frame, of the triangle from the camera along its picture's sides."""
    intrinsics = camera.calibration.rectified_intrinsics
    columns = np.array([-0.5, camera.calibration.image_size[0] - 0.5])
    rays = np.stack([(columns - intrinsics[0, 2]) / intrinsics[0, 0], np.zeros(2), np.ones(2)], axis=1)
    ends = _FIELD_OF_VIEW_METRES * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    corners: NDArray[np.float64] = np.concatenate([np.zeros((1, 3)), ends]) @ camera.base_T_camera[:3, :3].T
    return corners + camera.base_T_camera[:3, 3]


def _brightened(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Lift dark colours, since roads and cars would vanish on the dark ground."""
    lifted: NDArray[np.uint8] = np.rint(255.0 * (rgb / 255.0) ** _CLOUD_GAMMA).astype(np.uint8)
    return lifted


def _plot(picture: Picture, view: TopDownView, xyz: Points, rgb: NDArray[np.uint8], size: int) -> None:
    """Plot points [M, 3] as squares of `size` pixels, the highest last, so that what stands up hides the ground."""
    finite = np.isfinite(xyz).all(axis=1)
    upwards = np.argsort(xyz[finite, 2], kind="stable")
    pixels = np.floor(view.pixels(xyz[finite][upwards])).astype(np.int64)
    colours = rgb[finite][upwards]
    for shift in np.ndindex(size, size):
        column, row = (pixels + shift - size // 2).T
        inside = (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height)
        picture[row[inside], column[inside]] = colours[inside]


def _turbo() -> NDArray[np.uint8]:
    """Return OpenCV's turbo table [256, 3] as RGB, from dark blue to dark red."""
    table: NDArray[np.uint8] = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)
    return table[:, 0, ::-1]


def _resized(picture: Picture, width: int, height: int) -> Picture:
    shrinks = width < picture.shape[1]
    resized: Picture = cv2.resize(
        picture, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )
    return resized


def _filled(height: int, width: int, colour: Colour) -> Picture:
    return np.full((height, width, 3), colour, dtype=np.uint8)


def _paste(sheet: Picture, part: Picture, top: int, left: int) -> None:
    sheet[top : top + part.shape[0], left : left + part.shape[1]] = part


def _label(tile: Picture, name: str) -> None:
    """Write a camera's name into the picture's corner, on a dark ground."""
    width = _text_width(name, 0.75)
    tile[:34, : width + 20] = tile[:34, : width + 20] // 4
    _write(tile, name, (10, 25), size=0.75, colour=TEXT)


def _write(
    picture: Picture,
    text: str,
    origin: tuple[int, int],
    *,
    size: float = 0.75,
    colour: Colour = QUIET_TEXT,
    centred: bool = False,
    right: bool = False,
    outlined: bool = False,
) -> None:
    """Write with the left (or middle, or right) end of the base line at `origin`."""
    width = _text_width(text, size) if centred or right else 0
    at = (origin[0] - (width // 2 if centred else width), origin[1])
    if outlined:
        for shift in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            shadow = (at[0] + shift[0], at[1] + shift[1])
            cv2.putText(picture, text, shadow, cv2.FONT_HERSHEY_SIMPLEX, size, BACKGROUND, 1, cv2.LINE_AA)
        colour = TEXT
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _text_width(text: str, size: float) -> int:
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    return int(width)
