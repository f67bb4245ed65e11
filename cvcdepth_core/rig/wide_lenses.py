# SPDX-License-Identifier: Apache-2.0
"""Views of lenses that see more than one pinhole picture can show: two or three virtual cameras in one place."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.lens import field_of_view
from cvcdepth_core.rig.rig_file import CameraEntry, RigLayout
from cvcdepth_core.rig.view import WIDEST_PINHOLE_DEG, View

_SHARED_DEG = 20.0  # by which neighbouring views of a lens overlap
_WIDEST_OF_TWO_DEG = 140.0  # above it there are three views, and one of them looks straight ahead
_MOST_DEG = 245.0  # three views of 95 degrees
_SUFFIXES = {2: ("_l", "_r"), 3: ("_l", "_m", "_r")}


def wide_lenses(layout: RigLayout, calibrations: Mapping[str, Calibration]) -> dict[str, float]:
    """Return the degrees that those lenses see which one pinhole picture cannot show, by the cameras' names.

    Without the cameras of which a view is chosen, and those whose images are rectified already.
    """
    lenses = {
        entry.name: field_of_view(calibrations[entry.name]).horizontal
        for entry in layout.cameras
        if entry.view is None and not entry.rectified and entry.name in calibrations
    }
    return {name: hfov for name, hfov in lenses.items() if hfov > WIDEST_PINHOLE_DEG}


def views_of(hfov: float) -> tuple[View, ...]:
    """Return the views, from left to right, that show `hfov` degrees of a lens together: one up to 120 degrees."""
    if hfov <= WIDEST_PINHOLE_DEG:
        return (View(hfov=round(hfov, 2)),)
    whole = min(hfov, _MOST_DEG)
    count = 2 if whole <= _WIDEST_OF_TWO_DEG else 3
    part = math.ceil(10 * (whole + (count - 1) * _SHARED_DEG) / count) / 10
    outermost = round((whole - part) / 2, 2)
    step = 2 * outermost / (count - 1)
    return tuple(View(hfov=part, yaw=round(outermost - step * i, 2)) for i in range(count))


def split(entry: CameraEntry, hfov: float) -> tuple[CameraEntry, ...]:
    """Return the cameras that show `hfov` degrees of the entry's lens: itself, or `<name>_l`, `_m` and `_r`.

    Where the entry names neighbours, its other views are among them too.
    """
    views = views_of(hfov)
    if len(views) == 1:
        return (entry.model_copy(update={"view": views[0]}),)
    names = [entry.name + suffix for suffix in _SUFFIXES[len(views)]]
    return tuple(
        entry.model_copy(update={"name": name, "view": view, "neighbours": _neighbours(entry, name, names)})
        for name, view in zip(names, views, strict=True)
    )


def _neighbours(entry: CameraEntry, name: str, names: list[str]) -> tuple[str, ...] | None:
    if entry.neighbours is None:
        return None
    return (*(other for other in names if other != name), *entry.neighbours)


def with_views(layout: RigLayout, hfov: Mapping[str, float]) -> RigLayout:
    """Return the layout with so many degrees shown of the named cameras' lenses, see `split`; the others as they are.

    Anchor and neighbours that are split become the middle view (of two, the left one), and all views. RigError where a
    view would be called as another camera is.
    """
    parts = {c.name: split(c, hfov[c.name]) if c.name in hfov else (c,) for c in layout.cameras}
    names = {name: [part.name for part in found] for name, found in parts.items()}
    cameras = tuple(_renamed(part, names) for found in parts.values() for part in found)
    for name, views in names.items():
        taken = {*views} & {other for lens, others in names.items() if lens != name for other in others}
        if taken:
            raise RigError(
                f"camera {name}: its lens would be shown by {', '.join(views)}, but there is a camera "
                f"{', '.join(sorted(taken))}; a rig file gives it another name, or a view of up to 120 degrees"
            )
    anchor = layout.anchor and names[layout.anchor][(len(names[layout.anchor]) - 1) // 2]
    return layout.model_copy(update={"cameras": cameras, "anchor": anchor})


def _renamed(entry: CameraEntry, names: Mapping[str, Sequence[str]]) -> CameraEntry:
    if entry.neighbours is None:
        return entry
    others = tuple(new for old in entry.neighbours for new in names.get(old, (old,)))
    return entry.model_copy(update={"neighbours": others})


def without_views(layout: RigLayout, images: Collection[str] | None = None) -> RigLayout:
    """Return the layout with one camera for each lens and no view chosen: the inverse of `with_views`.

    Of those image topics only, where they are given; the others stay as they are. Of several views' masks and other
    fields the first one's are kept.
    """
    wanted = layout.views_by_image if images is None else {t: layout.views_by_image[t] for t in images}
    lens_names = {name: lens_name(names) for names in wanted.values() for name in names}
    cameras = tuple(
        entry.model_copy(update={"name": lens_names[entry.name], "view": None})
        if entry.image_topic in wanted
        else entry
        for entry in layout.cameras
        if entry.image_topic not in wanted or entry.name == wanted[entry.image_topic][0]
    )
    renamed = {old: [new] for old, new in lens_names.items()}
    kept = tuple(_without_itself(_renamed(entry, renamed)) for entry in cameras)
    return layout.model_copy(
        update={"cameras": kept, "anchor": layout.anchor and lens_names.get(layout.anchor, layout.anchor)}
    )


def from_left_to_right(layout: RigLayout, cameras: Collection[str]) -> tuple[str, ...]:
    """Return the views of one lens in their order."""
    yaws = {entry.name: entry.view.yaw if entry.view else 0.0 for entry in layout.cameras}
    return tuple(sorted(cameras, key=lambda name: -yaws[name]))


def lens_name(cameras: Sequence[str]) -> str:
    """Return what the views of one lens are called together: `front` for front_l, front_m and front_r, else the first.

    A single camera's name is its own.
    """
    suffixes = _SUFFIXES.get(len(cameras), ())
    stems = {name.removesuffix(suffix) for name, suffix in zip(sorted(cameras), suffixes, strict=False)}
    is_split = len(stems) == 1 and all(map(str.endswith, sorted(cameras), suffixes))
    return stems.pop() if is_split else cameras[0]


def _without_itself(entry: CameraEntry) -> CameraEntry:
    if entry.neighbours is None:
        return entry
    others = tuple(dict.fromkeys(other for other in entry.neighbours if other != entry.name))
    return entry.model_copy(update={"neighbours": others})
