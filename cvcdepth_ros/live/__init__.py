# SPDX-License-Identifier: Apache-2.0
"""The live path from received image to published depth, in threads and without ROS."""
