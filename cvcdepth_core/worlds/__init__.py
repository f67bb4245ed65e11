# SPDX-License-Identifier: Apache-2.0
"""Rendered worlds with exact truth: descriptions, geometry, materials, light, sensors, motion. No ROS formats."""
