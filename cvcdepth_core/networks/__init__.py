# SPDX-License-Identifier: Apache-2.0
"""The depth network and the pose network."""

from cvcdepth_core.networks.depth import INPUT_STRIDE, DepthNet, disparity_to_depth
from cvcdepth_core.networks.encoders import Encoder
from cvcdepth_core.networks.pose import PoseNet

__all__ = ["INPUT_STRIDE", "DepthNet", "Encoder", "PoseNet", "disparity_to_depth"]
