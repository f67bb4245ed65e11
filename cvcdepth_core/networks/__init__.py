# SPDX-License-Identifier: Apache-2.0
"""The depth network and the pose network."""

from cvcdepth_core.networks.depth import DEPTH_ENCODERS, INPUT_STRIDE, DepthNet, disparity_to_depth
from cvcdepth_core.networks.pose import POSE_ENCODERS, PoseNet

__all__ = ["DEPTH_ENCODERS", "INPUT_STRIDE", "POSE_ENCODERS", "DepthNet", "PoseNet", "disparity_to_depth"]
