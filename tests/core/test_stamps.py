# SPDX-License-Identifier: Apache-2.0
"""Stamps stay whole nanoseconds, which a float of seconds since 1970 cannot hold."""

import numpy as np
import pytest

from cvcdepth_core.stamps import exposure_times, to_nanoseconds

STAMP = 1_557_539_960_399_291_073


@pytest.mark.parametrize(("seconds", "nanoseconds"), [(0.1, 10**8), (-1e-5, -10_000), (3.2, 3_200_000_000), (0, 0)])
def test_seconds_become_whole_nanoseconds(seconds: float, nanoseconds: int):
    found = to_nanoseconds(seconds)
    assert (found, type(found)) == (nanoseconds, int)


def test_an_exposure_is_its_stamp_without_the_cameras_offset_to_the_nanosecond():
    assert exposure_times(STAMP, 3_200_000_000) == STAMP - 3_200_000_000
    assert exposure_times(STAMP, -1) == STAMP + 1


def test_arrays_of_stamps_take_an_offset_for_each_camera_or_one_for_all():
    stamps = np.array([[STAMP, STAMP + 5], [STAMP + 100, STAMP + 105]])
    np.testing.assert_array_equal(exposure_times(stamps, np.array([0, 5])), [[STAMP, STAMP], [STAMP + 100] * 2])
    np.testing.assert_array_equal(exposure_times(stamps[:, 1], 5), [STAMP, STAMP + 100])
