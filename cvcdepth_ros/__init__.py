# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node and the bag tool around `cvcdepth_core`."""
