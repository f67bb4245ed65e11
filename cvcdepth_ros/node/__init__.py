# SPDX-License-Identifier: Apache-2.0
"""The parts of the ROS 2 node; other rooms import no ROS."""
