# SPDX-License-Identifier: Apache-2.0
"""From one predicted motion to the motion of every camera of a rigid rig (method sections 4 and 8)."""

from __future__ import annotations

import torch
from torch import Tensor

from cvcdepth_core.rendering.projection import axis_angle_to_rotation, rigid, rigid_inverse, rigid_power


def motion_to_context(axis_angle: Tensor, translation: Tensor, backward: bool) -> Tensor:
    """Return the pose `context_T_target` [..., 4, 4] that moves points of the target frame into the context frame.

    The pose network sees both frames in temporal order, so its output [..., 3] (rad) and [..., 3] (m) leads to the
    later frame; for an earlier context (`backward`) it is inverted.
    """
    later_T_earlier = rigid(axis_angle_to_rotation(axis_angle), translation)
    return rigid_inverse(later_T_earlier) if backward else later_T_earlier


def distribute_anchor_motion(anchor_motion: Tensor, base_T_camera: Tensor, anchor: int) -> Tensor:
    """Give every camera the anchor (front) camera's motion: inv(E_i) E_0 T_0 inv(E_0) E_i.

    `anchor_motion` [B, F, 4, 4] for F context frames, `base_T_camera` [B, N, 4, 4]; gives [B, F, N, 4, 4].
    """
    return _conjugate(anchor_motion[:, :, None], _anchor_frame(base_T_camera, anchor))


def distribute_vehicle_motion(vehicle_motion: Tensor, base_T_camera: Tensor) -> Tensor:
    """Give every camera the motion of the base frame: inv(E_i) T E_i; shapes as in `distribute_anchor_motion`."""
    return _conjugate(vehicle_motion[:, :, None], base_T_camera)


def poses_at_exposure(
    base_T_camera: Tensor, anchor_motion: Tensor, anchor: int, delays: Tensor, context_times: Tensor
) -> Tensor:
    """Return each camera's pose [B, N, 4, 4] at its own exposure, in the base frame at the anchor's.

    Between two frames the vehicle keeps its velocity and turn rate, those of the predicted `anchor_motion`
    [B, F, 4, 4] (context_T_target), each of which spans `context_times` [B, F] seconds; a camera that fires after the
    anchor, by `delays` [B, N] seconds, goes by a context after the target, and one before by one before.
    """
    context = (delays[:, :, None] * context_times[:, None] >= 0).float().argmax(dim=-1)  # [B, N]
    share = delays / context_times.gather(1, context)
    context_T_target = anchor_motion[torch.arange(len(delays), device=delays.device)[:, None], context]
    target_T_exposure = rigid_power(rigid_inverse(context_T_target), share)
    return base_T_camera[:, anchor, None] @ target_T_exposure @ _anchor_frame(base_T_camera, anchor)


def motions_seen_from_anchor(camera_motions: Tensor, base_T_camera: Tensor, anchor: int) -> Tensor:
    """Express each camera's own motion [B, F, N, 4, 4] as the anchor's: inv(E_0) E_i T_i inv(E_i) E_0."""
    return _conjugate(camera_motions, rigid_inverse(_anchor_frame(base_T_camera, anchor)))


def relative_poses(base_T_camera: Tensor, targets: Tensor, sources: Tensor) -> Tensor:
    """Return inv(E_source) E_target [B, P, 4, 4] for the camera pairs `targets` [P], `sources` [P]."""
    return rigid_inverse(base_T_camera[:, sources]) @ base_T_camera[:, targets]


def _anchor_frame(base_T_camera: Tensor, anchor: int) -> Tensor:
    """Return `anchor_T_camera` [B, N, 4, 4]."""
    return rigid_inverse(base_T_camera[:, anchor, None]) @ base_T_camera


def _conjugate(motions: Tensor, reference_T_camera: Tensor) -> Tensor:
    """Express motions [B, F, N, 4, 4] of the reference in the cameras' frames; poses are [B, N, 4, 4]."""
    reference_T_camera = reference_T_camera[:, None]
    return rigid_inverse(reference_T_camera) @ motions @ reference_T_camera
