# SPDX-License-Identifier: Apache-2.0
"""The content of a recording: rig, surround sets, motion, LiDAR, times."""
