# SPDX-License-Identifier: Apache-2.0
"""Poses are rigid, named and invertible, whatever their rotation; OpenCV's rotations are the reference."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cvcdepth_core.errors import TransformError
from cvcdepth_core.rig.poses import check_rigid, inverse, pose_from_quaternion, quaternion_from_rotation

_COMPONENT = st.floats(-1.0, 1.0, allow_nan=False, width=32)
_QUATERNION = (
    st.tuples(_COMPONENT, _COMPONENT, _COMPONENT, _COMPONENT)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: tuple(c / math.hypot(*q) for c in q))
)
_TRANSLATION = st.tuples(*[st.floats(-100.0, 100.0)] * 3)


@given(_QUATERNION)
@example((1.0, 0.0, 0.0, 0.0))
@example((0.0, 0.0, 1.0, 0.0))
@example((0.0, 0.0, 0.0, 1.0))
def test_a_quaternion_survives_the_way_through_a_matrix(quaternion: tuple[float, ...]):
    rotation = pose_from_quaternion((0.0, 0.0, 0.0), quaternion)[:3, :3]
    found = quaternion_from_rotation(rotation)
    assert found[3] >= 0
    # q and -q are the same rotation.
    assert abs(float(found @ np.array(quaternion))) == pytest.approx(1.0, abs=1e-12)


@given(_QUATERNION)
def test_a_quaternion_turns_as_opencv_turns(quaternion: tuple[float, ...]):
    axis, w = np.array(quaternion[:3]), quaternion[3]
    norm = float(np.linalg.norm(axis))
    rotation_vector = axis / norm * 2.0 * math.atan2(norm, w) if norm > 1e-12 else np.zeros(3)
    want, _ = cv2.Rodrigues(rotation_vector)
    assert pose_from_quaternion((0.0, 0.0, 0.0), quaternion)[:3, :3] == pytest.approx(want, abs=1e-9)


@given(_TRANSLATION, _QUATERNION)
def test_a_pose_and_its_inverse_cancel(translation: tuple[float, ...], quaternion: tuple[float, ...]):
    target_T_source = pose_from_quaternion(translation, quaternion)
    check_rigid(inverse(target_T_source), "inverse")
    assert target_T_source @ inverse(target_T_source) == pytest.approx(np.eye(4), abs=1e-10)


def test_a_pose_takes_the_sources_origin_to_its_translation():
    quarter_turn_left = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
    pose = pose_from_quaternion((1.0, 2.0, 3.0), quarter_turn_left)
    assert pose @ [0.0, 0.0, 0.0, 1.0] == pytest.approx([1.0, 2.0, 3.0, 1.0])
    assert pose @ [1.0, 0.0, 0.0, 1.0] == pytest.approx([1.0, 3.0, 3.0, 1.0])


def test_a_matrix_with_rounded_digits_gives_the_nearest_rotations_quaternion():
    exact = pose_from_quaternion((0.0, 0.0, 0.0), (0.5, -0.5, 0.5, -0.5))[:3, :3]
    rounded = exact + np.random.default_rng(0).uniform(-5e-4, 5e-4, (3, 3))
    assert quaternion_from_rotation(rounded) == pytest.approx([-0.5, 0.5, -0.5, 0.5], abs=1e-3)


def test_a_quaternion_rounded_to_float32_is_normalised():
    rounded = np.array([0.1, 0.2, 0.3, math.sqrt(0.86)], dtype=np.float32).tolist()
    check_rigid(pose_from_quaternion((0.0, 0.0, 0.0), rounded), "rounded")
    nearly_unit = [component * 1.0009 for component in rounded]
    rotation = pose_from_quaternion((0.0, 0.0, 0.0), nearly_unit)[:3, :3]
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)


@pytest.mark.parametrize(
    ("translation", "rotation", "found"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), "norm 0"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.01), "norm 1.01"),
        ((0.0, math.nan, 0.0), (0.0, 0.0, 0.0, 1.0), "nan"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, math.inf, 1.0), "inf"),
        ((0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 1.0), "3 . 4 finite numbers"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), "3 . 4 finite numbers"),
    ],
)
def test_what_is_no_pose_is_refused_by_name(translation: tuple[float, ...], rotation: tuple[float, ...], found: str):
    with pytest.raises(TransformError, match=f"base_T_lidar.*{found}"):
        pose_from_quaternion(translation, rotation, "base_T_lidar")


def _matrix(**entries: float) -> NDArray[np.float64]:
    matrix = np.eye(4)
    for place, value in entries.items():
        matrix[int(place[1]), int(place[2])] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "found"),
    [
        (_matrix(m00=1.1), "not a rigid transform"),
        (_matrix(m00=-1.0), "det -1"),
        (_matrix(m30=0.5), "last row"),
        (_matrix(m03=math.nan), "finite 4x4"),
        (np.eye(3), "finite 4x4"),
    ],
)
def test_a_matrix_that_is_not_rigid_is_refused_by_name(matrix: NDArray[np.float64], found: str):
    with pytest.raises(TransformError, match=f"camera rear: base_T_camera: .*{found}"):
        check_rigid(matrix, "camera rear: base_T_camera")
