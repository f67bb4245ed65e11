# SPDX-License-Identifier: Apache-2.0
"""Rigid poses: 4x4 float64 matrices named `target_T_source`, which take points of the source to the target frame."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import TransformError

Pose = NDArray[np.float64]

# Recordings round quaternions to float32 and calibration files to a few digits; anything worse is not a rotation.
_ORTHONORMAL_TOLERANCE = 1e-3


def pose_from_quaternion(translation: Sequence[float], rotation: Sequence[float], name: str = "pose") -> Pose:
    """Build a pose from a translation (x, y, z, metres) and a unit quaternion (x, y, z, w; REP 103).

    Raises TransformError, which says `name` and the values, for non-finite numbers and for a quaternion whose norm is
    farther than 1e-3 from 1; within that it is normalised.
    """
    values = np.array([*translation, *rotation], dtype=np.float64)
    if (len(translation), len(rotation)) != (3, 4) or not np.isfinite(values).all():
        raise TransformError(
            f"{name}: translation {list(translation)}, rotation {list(rotation)}: want 3 + 4 finite numbers"
        )
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1.0) > _ORTHONORMAL_TOLERANCE:
        raise TransformError(f"{name}: quaternion {values[3:].tolist()} (x, y, z, w) has norm {norm:.4g}, not 1")
    x, y, z, w = values[3:] / norm
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = values[:3]
    return pose


def quaternion_from_rotation(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit quaternion (x, y, z, w), w >= 0, of a rotation [3, 3].

    It is the eigenvector of the largest eigenvalue of a symmetric 4x4 matrix (Bar-Itzhack 2000): no case distinction,
    and the nearest rotation when the matrix is a little off.
    """
    m = rotation
    K = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    _, vectors = np.linalg.eigh(K)  # reads the lower triangle
    quaternion: NDArray[np.float64] = vectors[:, -1]
    return -quaternion if quaternion[3] < 0 else quaternion


def inverse(target_T_source: Pose) -> Pose:
    """Return source_T_target, exactly rigid (transpose, not a general inverse)."""
    rotation, translation = target_T_source[:3, :3], target_T_source[:3, 3]
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ translation
    return pose


def check_rigid(pose: Pose, name: str) -> None:
    """Raise TransformError, naming `name` and the values, unless `pose` [4, 4] is a finite rotation and translation."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise TransformError(f"{name}: want a finite 4x4 matrix, found {np.array2string(pose, precision=4)}")
    deviation = float(np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max())
    determinant = float(np.linalg.det(pose[:3, :3]))
    if deviation > _ORTHONORMAL_TOLERANCE or determinant < 0 or not np.allclose(pose[3], [0, 0, 0, 1]):
        raise TransformError(
            f"{name}: not a rigid transform (R R^T off identity by {deviation:.3g}, det {determinant:.3g}, "
            f"last row {pose[3].tolist()})"
        )
