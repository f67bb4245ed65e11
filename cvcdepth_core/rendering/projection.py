# SPDX-License-Identifier: Apache-2.0
"""Differentiable SE(3), back-projection and projection; every function takes any leading dimensions.

Pixel centres are the integers, u to the right and v down; poses are named `target_T_source` and act on column vectors.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

PROJECTION_EPSILON = 1e-7
"""Added to z before the division (method section 5)."""

_LEAST_DENOMINATOR = 1e-12  # keeps coordinates and their gradients finite in the focal plane, in float32 too
_SMALL_SQUARED_ANGLE = 1e-2  # rad^2: below, series are more exact than quotients of small numbers


def axis_angle_to_rotation(axis_angle: Tensor) -> Tensor:
    """Return the rotation matrices [..., 3, 3] of `axis_angle` [..., 3] in radians; differentiable at zero."""
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(*x.shape, 3, 3)
    rotation: Tensor = torch.linalg.matrix_exp(skew)
    return rotation


def rotation_to_euler_xyz(rotation: Tensor) -> Tensor:
    """Return the angles [..., 3] (rad) with `rotation` [..., 3, 3] = Rx(a) Ry(b) Rz(c)."""
    a = torch.atan2(-rotation[..., 1, 2], rotation[..., 2, 2])
    b = torch.asin(rotation[..., 0, 2].clamp(-1.0, 1.0))
    c = torch.atan2(-rotation[..., 0, 1], rotation[..., 0, 0])
    return torch.stack([a, b, c], dim=-1)


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Return the poses [..., 4, 4] made of `rotation` [..., 3, 3] and `translation` [..., 3] in metres."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat([top, bottom], dim=-2)


def rigid_inverse(target_T_source: Tensor) -> Tensor:
    """Return `source_T_target` [..., 4, 4]."""
    rotation = target_T_source[..., :3, :3].mT
    return rigid(rotation, -(rotation @ target_T_source[..., :3, 3:]).squeeze(-1))


def rigid_power(target_T_source: Tensor, exponent: Tensor) -> Tensor:
    """Return the poses [..., 4, 4] that the motions [..., 4, 4] reach after `exponent` [...] of their way.

    Velocity and turn rate stay constant on the way: exp(a log T). Differentiable at standstill; rotations have to be
    smaller than half a turn.
    """
    power: Tensor = torch.linalg.matrix_exp(exponent[..., None, None] * _rigid_log(target_T_source))
    return power


def _rigid_log(pose: Tensor) -> Tensor:
    """Return the twists [..., 4, 4] whose matrix exponential is `pose`."""
    skew, squared_angle = _rotation_log(pose[..., :3, :3])
    angle = torch.where(squared_angle < _SMALL_SQUARED_ANGLE, 1.0, squared_angle).sqrt()
    beyond_linear = torch.where(
        squared_angle < _SMALL_SQUARED_ANGLE,
        1 / 12 + squared_angle / 720 + squared_angle.square() / 30240,
        (1 - angle / 2 / (angle / 2).tan()) / angle.square(),
    )
    identity = torch.eye(3, dtype=pose.dtype, device=pose.device)
    velocity = (identity - skew / 2 + beyond_linear[..., None, None] * (skew @ skew)) @ pose[..., :3, 3:]
    return nn.functional.pad(torch.cat([skew, velocity], dim=-1), (0, 0, 0, 1))


def _rotation_log(rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Return the axis-angle as a skew matrix [..., 3, 3], and the angle's square [...]."""
    skew = (rotation - rotation.mT) / 2  # of length sin(angle)
    squared_sine = skew.square().sum((-2, -1)) / 2
    cosine = (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    is_small = (squared_sine < _SMALL_SQUARED_ANGLE) & (cosine > 0)
    sine = torch.where(is_small, 1.0, squared_sine).sqrt()
    series = 1 + squared_sine / 6 + 3 / 40 * squared_sine.square() + 5 / 112 * squared_sine**3
    ratio = torch.where(is_small, series, torch.atan2(sine, cosine) / sine)
    return ratio[..., None, None] * skew, ratio.square() * squared_sine


def unit_depth_points(inverse_intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Return the points [..., 3, H*W] at z = 1 m behind every pixel, row by row.

    `inverse_intrinsics` [..., 3, 3] belongs to an image of `height` x `width` pixels.
    """
    return inverse_intrinsics @ pixel_grid(inverse_intrinsics.new_empty(height, width))


def pixel_grid(like: Tensor) -> Tensor:
    """Return the homogeneous pixels (u, v, 1) [3, H*W] of an image of the size of `like` [..., H, W], row by row."""
    ones = like.new_ones(like.shape[-2:])
    return torch.stack([ones.cumsum(1) - 1, ones.cumsum(0) - 1, ones]).flatten(1)


def back_project(depth: Tensor, inverse_intrinsics: Tensor) -> Tensor:
    """Return the camera-frame points [..., 3, H*W] in metres of `depth` [..., 1, H, W] (metres along z)."""
    height, width = depth.shape[-2:]
    return unit_depth_points(inverse_intrinsics, height, width) * depth.flatten(-2)


def transform(target_T_source: Tensor, points: Tensor) -> Tensor:
    """Move `points` [..., 3, M] of the source frame to the target frame by poses [..., 4, 4]."""
    return target_T_source[..., :3, :3] @ points + target_T_source[..., :3, 3:]


def project(points: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Project camera-frame `points` [..., 3, M] (metres) with `intrinsics` [..., 3, 3].

    Gives pixels [..., 2, M] and z [..., 1, M]. Points behind the camera are projected too: see z.
    """
    homogeneous = intrinsics @ points
    z = homogeneous[..., 2:, :]
    return homogeneous[..., :2, :] / divisor(z), z


def divisor(z: Tensor) -> Tensor:
    """Return what homogeneous pixels are divided by, never zero (method section 5)."""
    denominator = z + PROJECTION_EPSILON
    return torch.where(denominator.abs() < _LEAST_DENOMINATOR, _LEAST_DENOMINATOR, denominator)


class Reprojection(NamedTuple):
    """The way from the pixels of one image, with their depths, to the pixels of another."""

    turn: Tensor
    """[..., 3, 3] K_source R inv(K_target)."""
    shift: Tensor
    """[..., 3, 1] K_source t."""

    @classmethod
    def from_cameras(cls, inverse_intrinsics: Tensor, source_T_target: Tensor, intrinsics: Tensor) -> Reprojection:
        """Take the target's inverse intrinsics [..., 3, 3], the pose [..., 4, 4], and the source's intrinsics."""
        projection = intrinsics @ source_T_target[..., :3, :]
        return cls(projection[..., :3] @ inverse_intrinsics, projection[..., 3:])

    def at(self, index: Any) -> Reprojection:
        """Return those at an index into the leading dimensions."""
        return Reprojection(self.turn[index], self.shift[index])

    def from_column(self, first: Tensor) -> Reprojection:
        """Return the same for a part of the target image that begins at column `first` [...]."""
        turn = self.turn.clone()
        turn[..., 2] += turn[..., 0] * first[..., None]
        return self._replace(turn=turn)

    def turned(self, like: Tensor) -> Tensor:
        """Return where the pixels of an image of the size of `like` [..., H, W] were at infinity, [..., 3, H*W]."""
        return self.turn @ pixel_grid(like)

    def z(self, depth: Tensor) -> Tensor:
        """Return the source's z [..., 1, H, W] of pixels at `depth` [..., 1, H, W], metres both."""
        along_axis = Reprojection(self.turn[..., 2:, :], self.shift[..., 2:, :])
        return torch.addcmul(along_axis.shift, along_axis.turned(depth), depth.flatten(-2)).view_as(depth)
