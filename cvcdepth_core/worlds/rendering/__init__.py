# SPDX-License-Identifier: Apache-2.0
"""Rays, light and sensors: from a world to pictures, depth and LiDAR points."""
