# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node's parts: the only room that imports ROS."""
