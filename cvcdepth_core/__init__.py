# SPDX-License-Identifier: Apache-2.0
"""Surround depth without ROS: rigs, preprocessing, networks, losses, training and evaluation."""
