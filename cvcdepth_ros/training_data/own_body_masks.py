# SPDX-License-Identifier: Apache-2.0
"""Masks of the vehicle's own body, made from the recordings of a rig. No ROS here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import ImageError
from cvcdepth_core.files import write_atomically
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.rig_health.own_body import MIN_PAIRS, MIN_TRAVEL, SelfOcclusionFinder, lane_share
from cvcdepth_core.training.config import RecordingsConfig
from cvcdepth_ros.training_data.index import RecordingIndex
from cvcdepth_ros.training_data.sample_choice import change_between
from cvcdepth_ros.training_data.samples import SampleReader

_MAX_PAIRS = 60
_MIN_IMAGE_CHANGE = 4.0  # grey levels of the small pictures, where no motion is recorded: half a metre in a street
_MAX_INTERVAL_NS = 3_000_000_000
_LEAST_SHARE = 0.002
_DOUBTFUL_SHARE, _DOUBTFUL_LANE = 0.3, 0.1
_RED = np.array([127, 0, 0], np.uint8)

OVERLAY = "_overlay.jpg"
"""After a camera's name, the file that shows its mask on a picture."""


class OwnBody(NamedTuple):
    """Where a camera sees its own vehicle."""

    mask: NDArray[np.uint8]
    """[h, w] of the raw image's size, 0 on the vehicle, 255 elsewhere."""
    overlay: Picture
    """[H, W, 3] a rectified picture, small, with the mask in red: to be looked at."""
    share: float
    """Masked share of the picture."""
    lane: float
    """Masked share of where the vehicle drives, see `lane_share`."""


class OwnBodies(NamedTuple):
    """What was found in a recording."""

    by_camera: Mapping[str, OwnBody]
    pairs: int
    """Pairs of pictures that were compared."""

    def doubts(self, directory: Path) -> Iterator[str]:
        """Yield what a person should know, or look at in the directory of `save_masks`."""
        if self.pairs < MIN_PAIRS:
            yield (
                f"no masks: {self.pairs} pairs of pictures between which the vehicle moved {MIN_TRAVEL} m, to look for "
                f"its own body {MIN_PAIRS} are needed; a longer drive has them"
            )
        for name, body in self.by_camera.items():
            taken, look = f"camera {name}: its mask takes {body.share:.0%}", f"look at {directory / (name + OVERLAY)}"
            if body.lane > _DOUBTFUL_LANE:
                yield f"{taken}, and {body.lane:.0%} of where the vehicle drives in its picture: {look}"
            elif body.share > _DOUBTFUL_SHARE:
                yield f"{taken} of the picture: {look}"


def find_self_occlusion(index: RecordingIndex) -> OwnBodies:
    """Return where each camera sees the vehicle itself; cameras that have a mask already are left out.

    Nothing is found where the vehicle hardly moves: fewer than `MIN_PAIRS` pairs of pictures.
    """
    index = replace(index, layout=index.layout.model_copy(update={"aspect": "stretch"}))  # all of each picture
    finder = SelfOcclusionFinder(index.layout.complete())
    height, width = finder.preprocessor.valid.shape[1:]
    reader = SampleReader([index], [], height, width, RecordingsConfig(cache_mb=0))
    shown: list[Picture] = []
    for earlier, later in _pairs(index):
        try:
            before, shown = list(reader.pictures(0, earlier)), list(reader.pictures(0, later))
            finder.add(before, shown)
        except ImageError:  # one damaged picture shows nothing of the vehicle
            continue
    bodies = {
        entry.name: _own_body(finder, camera, scene, shown[camera])
        for camera, (entry, scene) in enumerate(zip(index.layout.cameras, finder.scene(), strict=True))
        if entry.mask is None and not entry.mask_polygons and (~scene).mean() > _LEAST_SHARE
    }
    return OwnBodies(bodies, finder.pairs)


def _own_body(finder: SelfOcclusionFinder, camera: int, scene: NDArray[np.bool_], picture: Picture) -> OwnBody:
    overlay = picture.copy()
    overlay[~scene] = overlay[~scene] // 2 + _RED
    lane = lane_share(finder.rig.cameras[camera], scene)
    return OwnBody(finder.raw_mask(camera, scene), overlay, float((~scene).mean()), lane)


def save_masks(layout: RigLayout, found: OwnBodies, directory: Path) -> RigLayout:
    """Write the masks as `<camera>.png`, with overlays beside them, and return the layout that names the masks."""
    paths = {}
    for name, body in found.by_camera.items():
        paths[name] = directory / f"{name}.png"
        directory.mkdir(parents=True, exist_ok=True)
        write_atomically(paths[name], cv2.imencode(".png", body.mask)[1].tobytes())
        overlay = cv2.cvtColor(body.overlay, cv2.COLOR_RGB2BGR)
        write_atomically(directory / f"{name}{OVERLAY}", cv2.imencode(".jpg", overlay)[1].tobytes())
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
