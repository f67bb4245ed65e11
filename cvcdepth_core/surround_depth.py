# SPDX-License-Identifier: Apache-2.0
"""The result of one surround set, as data."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class SurroundDepth:
    """Estimated depth of one surround set, with the pictures that it belongs to; cameras in the rig's order."""

    depth: NDArray[np.float32]
    """[N, H, W] metres along each camera's optical axis, NaN where unknown (REP 118)."""
    pictures: NDArray[np.uint8]
    """[N, H, W, 3] RGB, rectified: pixel by pixel what `depth` describes."""
    intrinsics: NDArray[np.float64]
    """[N, 3, 3] of those pictures, pixel centres at the integers."""
    present: NDArray[np.bool_]
    """[N] False for a camera without a picture: its depth is NaN and its picture black."""
