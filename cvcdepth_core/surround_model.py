# SPDX-License-Identifier: Apache-2.0
"""The two networks applied to a rig: depth and motion of every camera (method sections 3, 4, 7 and 8)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from cvcdepth_core.augmentation import mirror, mirror_motion
from cvcdepth_core.networks import DepthNet, PoseNet, disparity_to_depth
from cvcdepth_core.objective import Prediction
from cvcdepth_core.pose_distribution import distribute_anchor_motion, distribute_vehicle_motion, motion_to_context
from cvcdepth_core.rig_batch import RigBatch

PoseMethod = Literal["front", "joint_front", "joint", "per_camera"]

_VEHICLE_LATERAL_AXIS = 1


class SurroundModel(nn.Module):
    """Depth of every camera and motion of every camera from a rig's images.

    `pose_method` says which images the pose network sees and whose motion it gives: the anchor (front) camera's from
    its own images (`front`, the paper's) or from all images (`joint_front`, VFDepth), the vehicle's from all images
    (`joint`, SurroundDepth), or each camera's from its own (`per_camera`, FSM; wants the pose-consistency term).
    """

    def __init__(
        self,
        depth_net: DepthNet,
        pose_net: PoseNet,
        *,
        min_depth: float,
        max_depth: float,
        focal_scale: float = 300.0,
        pose_method: PoseMethod = "front",
    ) -> None:
        super().__init__()
        self.depth_net = depth_net
        self.pose_net = pose_net
        self.min_depth, self.max_depth, self.focal_scale = min_depth, max_depth, focal_scale
        self.pose_method = pose_method

    def forward(self, batch: RigBatch, network_frames: Tensor, depth_flips: Tensor, pose_flips: Tensor) -> Prediction:
        """Return disparity, depth and motions for `batch`.

        `network_frames` [B, 3, N, 3, H, W] are the batch's frames (0, -1, +1) as the networks shall see them, jittered
        in training. The samples named by `depth_flips` and `pose_flips` (bool [B]) are shown mirrored to that network
        and the answer is mirrored back (Hflip-S).
        """
        disparity = self._disparity(network_frames[:, 0], depth_flips)
        depth = disparity_to_depth(
            disparity, batch.intrinsics[..., 0, 0], self.min_depth, self.max_depth, self.focal_scale
        )
        return Prediction(disparity, depth, self._motions(batch, mirror(network_frames, pose_flips), pose_flips))

    def _disparity(self, images: Tensor, flips: Tensor) -> Tensor:
        samples, cameras = images.shape[:2]
        disparity: Tensor = self.depth_net(mirror(images, flips).flatten(0, 1)).to(images.dtype)
        return mirror(disparity.view(samples, cameras, *disparity.shape[1:]), flips)

    def _motions(self, batch: RigBatch, frames: Tensor, flips: Tensor) -> Tensor:
        """Return the motions [B, 2, N, 4, 4] of all cameras to the frames -1 and +1."""
        target, before, after = frames.unbind(1)
        lateral = _VEHICLE_LATERAL_AXIS if self.pose_method == "joint" else 0
        raw = [
            self._motion(batch, before, target, backward=True),
            self._motion(batch, target, after, backward=False),
        ]
        motions = mirror_motion(torch.stack(raw, dim=1), flips, lateral)
        if self.pose_method == "per_camera":
            return motions
        if self.pose_method == "joint":
            return distribute_vehicle_motion(motions, batch.base_T_camera)
        return distribute_anchor_motion(motions, batch.base_T_camera, batch.anchor)

    def _motion(self, batch: RigBatch, earlier: Tensor, later: Tensor, backward: bool) -> Tensor:
        """Return one motion per sample [B, 4, 4], or one per camera [B, N, 4, 4], from frames [B, N, 3, H, W]."""
        if self.pose_method == "per_camera":
            earlier, later = earlier.flatten(0, 1).unsqueeze(1), later.flatten(0, 1).unsqueeze(1)
        elif self.pose_method == "front":
            earlier, later = earlier[:, batch.anchor, None], later[:, batch.anchor, None]
        axis_angle, translation = self.pose_net(earlier, later)
        motion = motion_to_context(axis_angle.to(earlier.dtype), translation.to(earlier.dtype), backward)
        return motion.view(len(batch.base_T_camera), -1, 4, 4) if self.pose_method == "per_camera" else motion
