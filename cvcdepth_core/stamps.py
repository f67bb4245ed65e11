# SPDX-License-Identifier: Apache-2.0
"""Stamps: whole nanoseconds since the epoch, as cameras' clocks tell them, and what they mean in time."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Stamps = TypeVar("Stamps", int, NDArray[np.int64])

NANOSECONDS = 1_000_000_000
"""In a second."""


def to_nanoseconds(seconds: float) -> int:
    """Return a number of seconds as stamps are counted, rounded to the nearest nanosecond."""
    return round(seconds * NANOSECONDS)


def exposure_times(stamps: Stamps, offsets_ns: Stamps | int) -> Stamps:
    """Return when images were taken, ns, by the clock of poses and LiDAR: their stamps without their cameras' offsets.

    Single numbers, or arrays that broadcast. An offset is by how much a camera's stamps are too late
    (`CameraEntry.stamp_offset_ns`).
    """
    return stamps - offsets_ns
