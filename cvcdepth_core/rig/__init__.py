# SPDX-License-Identifier: Apache-2.0
"""The rig: calibration and mounts of its cameras, and the file that describes it."""
