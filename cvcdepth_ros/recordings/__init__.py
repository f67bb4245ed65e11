# SPDX-License-Identifier: Apache-2.0
"""What a recording says: rig, surround sets, motion, LiDAR, time."""
