# SPDX-License-Identifier: Apache-2.0
"""ROS messages in and out of core's types; no ROS needed."""
