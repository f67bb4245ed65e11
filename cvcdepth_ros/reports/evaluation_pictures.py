# SPDX-License-Identifier: Apache-2.0
"""One set to look at: depth, the scene from above, and camera by camera the LiDAR and the error at its points."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_core.pointcloud import CloudLimits, merged_cloud
from cvcdepth_core.rig.rig import Camera
from cvcdepth_core.scoring.ground_truth import sample_prediction
from cvcdepth_core.scoring.sparse_depth import SparseDepth
from cvcdepth_core.visualization import (
    ColouredPoints,
    DepthScale,
    SurroundPictures,
    contact_sheet,
    viewing_rows,
)
from cvcdepth_ros.evaluation.measuring import MeasuredSet
from cvcdepth_ros.messages.conversion import picture_from_message
from cvcdepth_ros.reports.style import to_jpeg

GREATEST_ERROR = 0.5
"""Relative error at which the colours of error maps end."""

_TILE_WIDTH = 800
_DOT_RADIUS = 2
_DIMMED = 0.6
_CLOUD = CloudLimits(stride=2, min_range=0.5)

Colours = NDArray[np.uint8]  # [M, 3] RGB


class Tile(NamedTuple):
    """One camera's picture."""

    camera: str
    jpeg: bytes
    width: int
    height: int


class SetPictures(NamedTuple):
    """All pictures of one set."""

    sheet: bytes
    """JPEG: every camera's picture and depth, and the scene from above, with the LiDAR."""
    errors: list[list[Tile]]
    """The error at the truth's pixels, in rows as one looks at the cameras; empty without truth."""
    lidar: list[list[Tile]]
    """The truth's pixels in the colours of depth; empty without truth."""


def draw_set(measured: MeasuredSet, title: str, far: float) -> SetPictures:
    """Draw one set; colours of depth end at `far` metres."""
    scale = DepthScale(far=far)
    estimated = measured.estimated
    xyzc = merged_cloud(estimated.result, estimated.rig, CloudLimits(_CLOUD.stride, _CLOUD.min_range, far))
    shown = SurroundPictures(
        estimated.result.pictures,
        estimated.result.depth,
        ColouredPoints(xyzc[:, :3], _unpacked_rgb(xyzc[:, 3])),
        measured.lidar,
        title,
        [f"Right: the scene from above, grid 10 m; estimated points in their own colours{_lidar_note(measured)}"],
    )
    sheet = to_jpeg(contact_sheet(estimated.rig, shown, scale))
    if not any(len(truth) for truth in measured.truth):
        return SetPictures(sheet, [], [])
    return SetPictures(
        sheet,
        _tiles(measured, _error_colours),
        _tiles(measured, lambda truth, _: scale.colours(truth.depth.astype(np.float32))),
    )


def error_colours(relative: NDArray[np.float64]) -> Colours:
    """Colour signed relative errors [M]: blue too near, grey right, red too far."""
    share = np.clip(0.5 + relative / (2 * GREATEST_ERROR), 0.0, 1.0)
    colours: Colours = colormaps["coolwarm"](share, bytes=True)[:, :3]
    return colours


def _error_colours(truth: SparseDepth, prediction: NDArray[np.float64]) -> Colours:
    relative = prediction / truth.depth - 1
    return np.where(np.isnan(relative)[:, None], np.uint8(0), error_colours(np.nan_to_num(relative)))


def _tiles(measured: MeasuredSet, colours: Callable[[SparseDepth, NDArray[np.float64]], Colours]) -> list[list[Tile]]:
    rig, depth = measured.estimated.rig, measured.estimated.result.depth
    rows = []
    for names in viewing_rows(rig):
        tiles = []
        for index in map(rig.names.index, names):
            picture = _dimmed(_rectified(measured, rig.cameras[index]))
            truth = measured.truth[index]
            part = rig.cameras[index].network_part(*depth[index].shape)
            _dot(picture, truth, colours(truth, sample_prediction(depth[index], truth, part)))
            tiles.append(Tile(rig.names[index], to_jpeg(picture), picture.shape[1], picture.shape[0]))
        rows.append(tiles)
    return rows


def _rectified(measured: MeasuredSet, camera: Camera) -> Picture:
    """Return the camera's picture, rectified, at a size to look at, whatever the network's size is."""
    width, height = camera.calibration.image_size
    tile_height = round(_TILE_WIDTH * height / width)
    rectifier = Rectifier(camera.calibration, tile_height, _TILE_WIDTH, camera.rectified)
    message = measured.estimated.surround_set.images[camera.name].message
    return rectifier(picture_from_message(message, camera.name), camera.name)


def _dimmed(picture: Picture) -> Picture:
    """Return it darker and in grey, so that coloured dots stand out."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) * _DIMMED
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


def _dot(picture: Picture, truth: SparseDepth, colours: Colours) -> None:
    """Draw each pixel of `truth` as a dot, the nearest last."""
    farthest_first = np.argsort(-truth.depth, kind="stable")
    columns = (truth.columns + 0.5) * picture.shape[1] / truth.width - 0.5
    rows = (truth.rows + 0.5) * picture.shape[0] / truth.height - 0.5
    for i in farthest_first.tolist():
        centre = (round(float(columns[i])), round(float(rows[i])))
        cv2.circle(picture, centre, _DOT_RADIUS, colours[i].tolist(), cv2.FILLED)


def _unpacked_rgb(packed: NDArray[np.float32]) -> Colours:
    bits = np.ascontiguousarray(packed).view(np.uint32)
    return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=-1).astype(np.uint8)


def _lidar_note(measured: MeasuredSet) -> str:
    return ", LiDAR in cyan" if measured.lidar is not None else ", no LiDAR"
