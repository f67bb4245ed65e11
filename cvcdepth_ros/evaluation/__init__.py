# SPDX-License-Identifier: Apache-2.0
"""From recordings to scores: one recording, many of them, the files that tell of them. Nothing here imports ROS."""
