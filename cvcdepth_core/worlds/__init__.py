# SPDX-License-Identifier: Apache-2.0
"""Rendered worlds: descriptions, geometry, materials, light, cameras, LiDAR and motion with exact truth. No ROS formats."""
