# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 messages packed by hand, in any layout."""

import struct
from types import SimpleNamespace

import numpy as np

POINTS = [(1.5, -2.25, 3.0), (10.0, 20.0, -30.0), (0.125, 0.0, 0.0), (7.0, 8.0, 9.0)]
SECOND = 1_000_000_000


def header(stamp: int = 0, frame_id: str = "lidar") -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=stamp // SECOND, nanosec=stamp % SECOND), frame_id=frame_id)


def cloud(
    points=POINTS,
    *,
    kind: str = "f",
    big_endian: bool = False,
    before: int = 0,
    after: int = 0,
    height: int = 1,
    row_padding: int = 0,
    stamp: int = 0,
) -> SimpleNamespace:
    """A PointCloud2 packed by struct: `before` and `after` strange bytes around z, y, x, rows padded."""
    size, order = struct.calcsize(f"<{kind}"), ">" if big_endian else "<"
    packed = [b"\xff" * before + struct.pack(f"{order}3{kind}", z, y, x) + b"\xfe" * after for x, y, z in points]
    width = len(points) // height
    rows = [b"".join(packed[i * width : (i + 1) * width]) + b"\xfd" * row_padding for i in range(height)]
    datatype = {"f": 7, "d": 8}[kind]
    step = before + 3 * size + after
    return SimpleNamespace(
        header=header(stamp),
        height=height,
        width=width,
        fields=[
            SimpleNamespace(name="ring", offset=0, datatype=99, count=1),
            *(
                SimpleNamespace(name=name, offset=before + i * size, datatype=datatype, count=1)
                for i, name in enumerate("zyx")
            ),
        ],
        is_bigendian=big_endian,
        point_step=step,
        row_step=width * step + row_padding,
        data=np.frombuffer(b"".join(rows), dtype=np.uint8),
    )
