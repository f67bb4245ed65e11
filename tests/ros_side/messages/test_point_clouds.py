# SPDX-License-Identifier: Apache-2.0
"""The points of PointCloud2 messages: any layout is read, a lying one refused by topic and field."""

import math

import numpy as np
import pytest
from clouds import POINTS, cloud

from cvcdepth_core.errors import RecordingError
from cvcdepth_ros.messages.point_clouds import points_from_message


@pytest.mark.parametrize("kind", ["f", "d"])
@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(
    "layout", [{}, {"before": 3, "after": 5}, {"height": 2}, {"height": 4, "row_padding": 7, "after": 1}]
)
def test_any_layout_of_points_is_read(kind, big_endian, layout):
    message = cloud(kind=kind, big_endian=big_endian, **layout)
    assert points_from_message(message, "/lidar").tolist() == [list(point) for point in POINTS]


def test_points_without_a_return_are_dropped():
    nothing = [(math.nan, 1, 1), (1, math.inf, 1), (0, 0, 0)]
    assert points_from_message(cloud([*nothing, (0, 0, 1)]), "/lidar").tolist() == [[0, 0, 1]]
    assert points_from_message(cloud([]), "/lidar").shape == (0, 3)


def test_a_single_row_needs_no_row_step_and_the_last_row_no_padding():
    message = cloud()
    message.row_step = 0
    assert len(points_from_message(message, "/lidar")) == 4
    padded = cloud(height=2, row_padding=8)
    padded.data = padded.data[:-8]
    assert len(points_from_message(padded, "/lidar")) == 4


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("data", np.zeros(47, np.uint8), "/lidar: data has 47 bytes, but 1 x 4 points of 12 bytes .* need 48"),
        ("height", 2, "/lidar: data has 48 bytes, .* need 96"),
        ("width", 5, "/lidar: data has 48 bytes, .* need 60"),
        ("point_step", 10, "/lidar: field x at offset 8 of 4 bytes is outside of the point_step of 10"),
        ("fields", [], "/lidar: no field x; there are none"),
    ],
)
def test_a_lying_cloud_is_refused_by_topic_and_field(field, value, message):
    broken = cloud()
    setattr(broken, field, value)
    with pytest.raises(RecordingError, match=message):
        points_from_message(broken, "/lidar")


def test_a_field_that_is_no_float_is_refused():
    broken = cloud()
    broken.fields[1].datatype = 5
    with pytest.raises(RecordingError, match="field z has datatype 5, want 7"):
        points_from_message(broken, "/lidar")


def test_rows_that_overlap_are_refused():
    broken = cloud(height=2)
    broken.row_step = 3
    with pytest.raises(RecordingError, match="row_step is 3 bytes, but 2 points of 12 need 24"):
        points_from_message(broken, "/lidar")
