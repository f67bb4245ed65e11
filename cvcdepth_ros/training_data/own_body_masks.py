# SPDX-License-Identifier: Apache-2.0
"""Masks of the vehicle's own body, made from the recordings of a rig. No ROS here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.rig_health.own_body import MIN_TRAVEL, SelfOcclusionFinder
from cvcdepth_core.training.config import RecordingsConfig
from cvcdepth_ros.training_data.index import RecordingIndex
from cvcdepth_ros.training_data.sample_choice import change_between
from cvcdepth_ros.training_data.samples import SampleReader

_MAX_PAIRS = 60
_MIN_IMAGE_CHANGE = 4.0  # grey levels of the small pictures, where no motion is recorded: half a metre in a street
_MAX_INTERVAL_NS = 3_000_000_000
_LEAST_SHARE = 0.002


def find_self_occlusion(index: RecordingIndex) -> dict[str, NDArray[np.uint8]]:
    """Return a mask, uint8 [h, w] of the raw image's size, 0 on the vehicle, for each camera that sees the vehicle.

    Cameras that have a mask already are left out. Nothing is found where the vehicle hardly moves (fewer than
    `self_occlusion.MIN_PAIRS` pairs of pictures).
    """
    finder = SelfOcclusionFinder(index.layout.complete())
    height, width = finder.preprocessor.valid.shape[1:]
    reader = SampleReader([index], [], height, width, RecordingsConfig(cache_mb=0))
    for earlier, later in _pairs(index):
        try:
            finder.add(list(reader.pictures(0, earlier)), list(reader.pictures(0, later)))
        except ImageError:  # one damaged picture shows nothing of the vehicle
            continue
    scene = finder.scene()
    return {
        entry.name: finder.raw_mask(camera, scene[camera])
        for camera, entry in enumerate(index.layout.cameras)
        if entry.mask is None and not entry.mask_polygons and (~scene[camera]).mean() > _LEAST_SHARE
    }


def save_masks(layout: RigLayout, masks: dict[str, NDArray[np.uint8]], directory: Path) -> RigLayout:
    """Write the masks as `<camera>.png` into `directory` and return the layout that names them."""
    paths = {}
    for name, mask in masks.items():
        paths[name] = directory / f"{name}.png"
        directory.mkdir(parents=True, exist_ok=True)
        write_atomically(paths[name], cv2.imencode(".png", mask)[1].tobytes())
    cameras = tuple(
        camera.model_copy(update={"mask": paths[camera.name]}) if camera.name in paths else camera
        for camera in layout.cameras
    )
    return layout.model_copy(update={"cameras": cameras})


def _pairs(index: RecordingIndex) -> list[tuple[int, int]]:
    """Return pairs of sets between which the vehicle has moved far enough, spread over the recording."""
    pairs = [(row, later) for row in range(len(index)) if (later := _later(index, row)) is not None]
    return (
        [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, _MAX_PAIRS).round().astype(int))] if pairs else []
    )


def _later(index: RecordingIndex, row: int) -> int | None:
    """Return the first set after `row` from which the vehicle has moved far enough, None when it takes too long."""
    stamps = index.stamps[:, index.anchor]
    needed = MIN_TRAVEL if index.poses is not None else _MIN_IMAGE_CHANGE
    for later in range(row + 1, len(index)):
        if stamps[later] - stamps[row] > _MAX_INTERVAL_NS:
            return None
        if change_between(index, row, later) >= needed:
            return later
    return None
