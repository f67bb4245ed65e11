# SPDX-License-Identifier: Apache-2.0
"""The two networks applied to a rig: depth and motion of every camera (method sections 3, 4, 7 and 8)."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.networks import DepthNetwork, DepthOutputs, PoseNet, RigImages, disparity_to_depth
from cvcdepth_core.networks.mirroring import LATERAL_AXIS, mirror, mirror_motion, mirror_rig
from cvcdepth_core.networks.vfdepth import FusedDepthNet, VolumePoseNet
from cvcdepth_core.networks.volume import STRIDE
from cvcdepth_core.training.batch import RigBatch
from cvcdepth_core.training.motion import distribute_anchor_motion, distribute_vehicle_motion, motion_to_context
from cvcdepth_core.training.novel_views import NovelViews, novel_poses
from cvcdepth_core.training.objective import Prediction

PoseMethod = Literal["front", "joint_front", "joint", "per_camera", "volume"]


class MotionVector(NamedTuple):
    """The pose network's answer."""

    axis_angle: Tensor
    """[..., 3] rad."""
    translation: Tensor
    """[..., 3] metres."""


class SurroundModel(nn.Module):
    """Depth of every camera and motion of every camera from a rig's images.

    `pose_method` says which images the pose network sees and whose motion it gives: the anchor (front) camera's from
    its own images (`front`, the paper's), from all images (`joint_front`, the paper's ablation) or from a volume of all
    (`volume`, VFDepth), the vehicle's from all images (`joint`, SurroundDepth), or each camera's from its own
    (`per_camera`, FSM; wants the pose-consistency term).
    """

    def __init__(
        self,
        depth_net: DepthNetwork,
        pose_net: PoseNet | VolumePoseNet,
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

    def forward(
        self,
        batch: RigBatch,
        network_frames: Tensor,
        depth_flips: Tensor,
        pose_flips: Tensor,
        novel_turns: Tensor | None = None,
    ) -> Prediction:
        """Return disparity, depth and motions for `batch`.

        `network_frames` [B, 3, N, 3, H, W] are the batch's frames (0, -1, +1) as the networks shall see them, jittered
        in training; of a batch without context frames there is one. The samples named by `depth_flips` and `pose_flips`
        (bool [B]) are shown mirrored to that network and the answer is mirrored back (Hflip-S). With `novel_turns`
        [B, N, 3] (axis-angle, rad), a network that fuses its cameras in a volume gives views of that from turned
        cameras too. Under autocast only the networks run in half precision.
        """
        rig = rig_images(batch, network_frames[:, 0])
        outputs, novel = (
            (self._outputs(rig, depth_flips), None)
            if novel_turns is None
            else self._with_novel_views(rig, depth_flips, novel_turns)
        )
        vectors = self._motion_vectors(batch, network_frames, pose_flips) if len(batch.contexts[0]) else []
        with torch.autocast(network_frames.device.type, enabled=False):
            depth = self._depth(outputs.disparity, batch)
            motions = depth.new_zeros(len(depth), 0, batch.cameras, 4, 4)
            if vectors:
                motions = self._motions(batch, vectors, pose_flips)
            return Prediction(outputs.disparity, depth, motions, outputs.sky, outputs.log_uncertainty, novel)

    def _depth(self, disparity: Tensor, rig: RigImages | RigBatch) -> Tensor:
        fx = rig.intrinsics[..., 0, 0]
        return disparity_to_depth(disparity, fx, self.min_depth, self.max_depth, self.focal_scale)

    def _outputs(self, rig: RigImages, flips: Tensor) -> DepthOutputs:
        outputs = self.depth_net.details(mirror_rig(rig, flips, self.depth_net.mirror_offset))
        return outputs.map(lambda part: mirror(part.to(rig.images.dtype), flips))

    def _with_novel_views(self, rig: RigImages, flips: Tensor, turns: Tensor) -> tuple[DepthOutputs, NovelViews]:
        if not isinstance(self.depth_net, FusedDepthNet):
            raise ConfigError(f"novel views need a network with a volume, found a {type(self.depth_net).__name__}")
        poses = novel_poses(rig.base_T_camera, turns)
        mirrored = mirror_rig(rig._replace(base_T_camera=poses), flips)
        shown = mirror_rig(rig, flips, self.depth_net.mirror_offset)
        found = self.depth_net.with_novel_views(shown, mirrored.base_T_camera)
        own, disparity = (mirror(part.to(rig.images.dtype), flips) for part in found)
        with torch.autocast(rig.images.device.type, enabled=False):
            depth = self._depth(disparity, rig)
        return DepthOutputs(own), NovelViews(
            disparity, depth, poses, (self.min_depth, self.max_depth), self.focal_scale
        )

    def _motion_vectors(self, batch: RigBatch, frames: Tensor, flips: Tensor) -> list[MotionVector]:
        """Return what the pose network says for the frames -1 and +1: per sample [B, 3], or per camera [B*N, 3]."""
        seen = mirror(frames, flips)
        if isinstance(self.pose_net, VolumePoseNet):
            rig = mirror_rig(rig_images(batch, frames[:, 0]), flips, STRIDE - 1)
            target, before, after = seen.unbind(1)
            answers = [
                self.pose_net(rig._replace(images=one), other) for one, other in ((before, target), (target, after))
            ]
        else:
            target, before, after = self._pose_views(batch, seen).unbind(1)
            answers = [self.pose_net(before, target), self.pose_net(target, after)]
        return [MotionVector(*(part.to(frames.dtype) for part in answer)) for answer in answers]

    def _pose_views(self, batch: RigBatch, frames: Tensor) -> Tensor:
        """Choose from `frames` [B, 3, N, 3, H, W] the views that share a motion: [B, 3, V, ...] or [B*N, 3, 1, ...]."""
        if self.pose_method == "front":
            return frames[:, :, batch.anchor, None]
        if self.pose_method == "per_camera":
            return frames.transpose(1, 2).flatten(0, 1).unsqueeze(2)
        return frames

    def _motions(self, batch: RigBatch, vectors: list[MotionVector], flips: Tensor) -> Tensor:
        """Return the motions [B, 2, N, 4, 4] of all cameras, from exposure to exposure, to the frames -1 and +1."""
        before, after = vectors
        raw = [motion_to_context(*before, backward=True), motion_to_context(*after, backward=False)]
        motions = torch.stack([motion.view(len(flips), -1, 4, 4) for motion in raw], dim=1)
        motions = mirror_motion(motions, flips, LATERAL_AXIS if self.pose_method == "joint" else 0)
        if self.pose_method == "per_camera":
            return motions
        motion = motions.squeeze(2)
        if self.pose_method == "joint":
            anchors = distribute_vehicle_motion(motion, batch.base_T_camera)[:, :, batch.anchor]
            return distribute_vehicle_motion(motion, batch.at_exposures(anchors).base_T_camera)
        return distribute_anchor_motion(motion, batch.at_exposures(motion).base_T_camera, batch.anchor)


def rig_images(batch: RigBatch, images: Tensor) -> RigImages:
    """Return the batch's rig with the target `images` [B, N, 3, H, W] that the network shall see; none is absent."""
    present = torch.ones(images.shape[:2], dtype=torch.bool, device=images.device)
    return RigImages(images, batch.intrinsics, batch.base_T_camera, present, batch.masks)
