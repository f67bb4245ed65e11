# SPDX-License-Identifier: Apache-2.0
"""How much of its lens each camera of a rig shows, and what that costs in overlaps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cvcdepth_core.rig.lens import field_of_view
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig.rig_file import CameraEntry, RigLayout
from cvcdepth_core.rig.wide_lenses import from_left_to_right, with_views, without_views

_LEAST_LOSS_DEG, _LEAST_LOSS = 5.0, 0.1


class LensUse(NamedTuple):
    """One lens; all angles in degrees along the image's width."""

    cameras: tuple[str, ...]
    """The camera, or those that are views of it."""
    lens: float
    """What its images show."""
    used: float
    """What the views show of that."""
    overlap: float
    """The widest overlap with another lens's camera."""
    possible_overlap: float
    """The same if all views showed the whole of their lenses."""

    @property
    def is_wasted(self) -> bool:
        """Whether enough of the lens is lost to be worth a word."""
        return self.used < min(self.lens - _LEAST_LOSS_DEG, (1 - _LEAST_LOSS) * self.lens)

    def __str__(self) -> str:
        """One line for people."""
        overlap = f"overlap {self.overlap:.0f} of {self.possible_overlap:.0f}"
        return f"{', '.join(self.cameras)}: lens {self.lens:.0f}, used {self.used:.0f} degrees, {overlap}"


def lens_uses(layout: RigLayout) -> list[LensUse]:
    """Return how the lenses of a complete layout are used, in its order."""
    lenses = without_views(layout)
    hfov = {entry.name: _lens_of(entry) for entry in lenses.cameras}
    whole = with_views(lenses, {entry.name: hfov[entry.name] for entry in lenses.cameras if not entry.rectified})
    now, possible = (_widest_overlaps(found) for found in (layout, whole))
    return [
        LensUse(
            from_left_to_right(layout, names),
            hfov[entry.name],
            _used(layout, names, hfov[entry.name]),
            now[topic],
            possible[topic],
        )
        for (topic, names), entry in zip(layout.views_by_image.items(), lenses.cameras, strict=True)
    ]


def _lens_of(entry: CameraEntry) -> float:
    if entry.calibration is None:
        raise ValueError(f"camera {entry.name}: not complete")
    return field_of_view(entry.calibration, entry.rectified).horizontal


def _used(layout: RigLayout, names: list[str], lens: float) -> float:
    """Return the degrees from the leftmost to the rightmost side of a lens's views."""
    entries = {entry.name: entry for entry in layout.cameras}
    edges = []
    for camera in layout.complete().cameras:
        if camera.name in names:
            view = entries[camera.name].view
            shown = field_of_view(camera.calibration, rectified=True)
            yaw = view.yaw if view else 0.0
            edges += [yaw + shown.left, yaw - shown.right]
    return float(min(np.ptp(edges), lens))


def _widest_overlaps(layout: RigLayout) -> dict[str, float]:
    """Return each image topic's widest overlap with a camera of another one."""
    rig: Rig = layout.complete()
    topics = {entry.name: entry.image_topic for entry in layout.cameras}
    widest = dict.fromkeys(layout.views_by_image, 0.0)
    for overlap in rig.overlaps:
        topic = topics[overlap.camera]
        if topics[overlap.neighbour] != topic:
            widest[topic] = max(widest[topic], overlap.angle)
    return widest
