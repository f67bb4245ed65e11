# SPDX-License-Identifier: Apache-2.0
"""The points of `sensor_msgs/PointCloud2` messages, whatever their layout. Nothing here imports ROS."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import RecordingError

POINT_CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"

_FLOAT_TYPES = {7: "f4", 8: "f8"}  # sensor_msgs/PointField.FLOAT32 and FLOAT64


def points_from_message(message: Any, topic: str) -> NDArray[np.float64]:
    """Return the points [M, 3] of a PointCloud2, metres in its frame; those without a return (NaN, inf, 0) left out.

    Any layout is read: float32 or float64, any offsets, organised or not, padded rows, either byte order.
    Raises RecordingError, naming topic and field, when x, y or z is missing, no float, or outside of the bytes.
    """
    content = np.frombuffer(message.data, dtype=np.uint8)
    _check_size(message, content.size, topic)
    xyz = np.stack([_column(message, content, axis, topic) for axis in "xyz"], axis=-1)
    returned = np.isfinite(xyz).all(axis=1) & xyz.any(axis=1)
    points: NDArray[np.float64] = xyz[returned]
    return points


def _check_size(message: Any, size: int, topic: str) -> None:
    """Raise unless the rows fit the bytes; a single row needs no row_step, which some drivers leave at 0."""
    row_bytes = message.width * message.point_step
    if message.height > 1 and message.row_step < row_bytes:
        raise RecordingError(
            f"{topic}: row_step is {message.row_step} bytes, but {message.width} points of {message.point_step} need "
            f"{row_bytes}"
        )
    needed = (message.height - 1) * message.row_step + row_bytes if message.height else 0
    if size < needed:
        raise RecordingError(
            f"{topic}: data has {size} bytes, but {message.height} x {message.width} points of {message.point_step} "
            f"bytes with a row_step of {message.row_step} need {needed}"
        )


def _column(message: Any, content: NDArray[np.uint8], name: str, topic: str) -> NDArray[np.float64]:
    """Return one field of all points [M]."""
    field = next((field for field in message.fields if field.name == name), None)
    if field is None:
        raise RecordingError(
            f"{topic}: no field {name}; there are {', '.join(f.name for f in message.fields) or 'none'}"
        )
    if field.datatype not in _FLOAT_TYPES:
        raise RecordingError(f"{topic}: field {name} has datatype {field.datatype}, want 7 (FLOAT32) or 8 (FLOAT64)")
    dtype = np.dtype((">" if message.is_bigendian else "<") + _FLOAT_TYPES[field.datatype])
    if field.offset + dtype.itemsize > message.point_step:
        raise RecordingError(
            f"{topic}: field {name} at offset {field.offset} of {dtype.itemsize} bytes is outside of the point_step of "
            f"{message.point_step}"
        )
    shape, strides = (message.height, message.width), (message.row_step, message.point_step)
    if 0 in shape:
        return np.empty(0)
    column: NDArray[np.generic] = np.ndarray(shape, dtype, content, field.offset, strides)
    return column.ravel().astype(np.float64)
