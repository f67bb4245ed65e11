# SPDX-License-Identifier: Apache-2.0
"""What it means that a camera's calibration has changed."""

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rig.calibration import Calibration

# Below, of focal lengths and centres in pixels and of coefficients, it is rounding, or a driver that estimates on.
_PIXELS, _COEFFICIENTS = 0.5, 1e-3


def describe_change(before: Calibration, after: Calibration) -> str | None:
    """Say what of a calibration changed; None where it is the same but for rounding."""
    if before.image_size != after.image_size:
        return "images of {}x{}, then of {}x{}".format(*before.image_size, *after.image_size)
    names = (("raw_intrinsics", "K"), ("rectified_intrinsics", "P"))
    for attribute, name in names:
        old, new = getattr(before, attribute), getattr(after, attribute)
        if np.abs(old - new).max() > _PIXELS:
            return f"fx {old[0, 0]:.1f}, cx {old[0, 2]:.1f}, then fx {new[0, 0]:.1f}, cx {new[0, 2]:.1f} in {name}"
    if before.distortion_model != after.distortion_model or _differ(before.distortion, after.distortion):
        return f"d = {before.d} ({before.distortion_model}), then d = {after.d} ({after.distortion_model})"
    return "R, the rectifying rotation" if _differ(before.rotation, after.rotation) else None


def _differ(before: NDArray[np.float64], after: NDArray[np.float64]) -> bool:
    return before.shape != after.shape or bool(np.abs(before - after).max() > _COEFFICIENTS)
