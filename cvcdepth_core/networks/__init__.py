# SPDX-License-Identifier: Apache-2.0
"""The depth networks behind one seam, and the pose network."""

from cvcdepth_core.networks.depth import INPUT_STRIDE, DepthNet, disparity_to_depth
from cvcdepth_core.networks.encoders import Encoder
from cvcdepth_core.networks.pose import PoseNet
from cvcdepth_core.networks.registry import NETWORKS, DepthModelSpec, build_depth_network
from cvcdepth_core.networks.rig_images import ConditionedNetwork, DepthNetwork, DepthOutputs, RigImages

__all__ = [
    "INPUT_STRIDE",
    "NETWORKS",
    "ConditionedNetwork",
    "DepthModelSpec",
    "DepthNet",
    "DepthNetwork",
    "DepthOutputs",
    "Encoder",
    "PoseNet",
    "RigImages",
    "build_depth_network",
    "disparity_to_depth",
]
