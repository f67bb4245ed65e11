# SPDX-License-Identifier: Apache-2.0
"""Rigs whose pictures have another size."""

from __future__ import annotations

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.calibration import Calibration, RegionOfInterest, calibration_from_fields
from cvcdepth_core.rig.rig_file import CameraEntry, RigLayout
from cvcdepth_core.rig.wide_lenses import without_views


def complete_layout(layout: RigLayout, where: str) -> RigLayout:
    """Return the layout if every camera has its calibration and mount; RigError says `where` which is missing.

    What is simulated is the lenses' images, whatever views are taken from them.
    """
    for camera in layout.cameras:
        for field in ("calibration", "base_T_camera"):
            if getattr(camera, field) is None:
                raise RigError(f"{where}: camera {camera.name}: no {field}; a rig needs both to be simulated")
    return without_views(layout)


def layout_at_size(layout: RigLayout, size: tuple[int, int] | None, usual_width: int) -> RigLayout:
    """Return a rig whose pictures are `size` (width, height) in pixels; None: `usual_width` wide, in their own shape.

    Each camera keeps its horizontal view and its square pixels: where the shape differs, rows are added or taken away
    evenly above and below. Binning and regions of interest are applied, masks are left out: they belong to the former
    pictures.
    """
    cameras = tuple(_resized(camera, size, usual_width) for camera in layout.cameras)
    return layout.model_copy(update={"cameras": cameras})


def _resized(camera: CameraEntry, size: tuple[int, int] | None, usual_width: int) -> CameraEntry:
    if camera.calibration is None:
        return camera
    width, height = camera.calibration.image_size
    calibration = _at_size(camera.name, camera.calibration, size or (usual_width, round(usual_width * height / width)))
    return camera.model_copy(update={"calibration": calibration, "mask": None, "mask_polygons": ()})


def _at_size(name: str, calibration: Calibration, size: tuple[int, int]) -> Calibration:
    width, height = calibration.image_size
    scale = size[0] / width
    rows = (size[1] - height * scale) / 2
    fields = calibration.model_dump()
    for key, values in (("k", calibration.raw_intrinsics), ("p", calibration.rectified_intrinsics)):
        if key == "p" and not any(calibration.p):
            continue
        K = values.copy()
        K[:2] *= scale
        K[0, 2] = (values[0, 2] + 0.5) * scale - 0.5
        K[1, 2] = (values[1, 2] + 0.5) * scale - 0.5 + rows
        flat = K.ravel().tolist()
        fields[key] = flat if key == "k" else [*flat[:3], 0.0, *flat[3:6], 0.0, *flat[6:], 0.0]
    fields |= {"width": size[0], "height": size[1], "binning_x": 1, "binning_y": 1, "roi": RegionOfInterest()}
    return calibration_from_fields(name, fields)
