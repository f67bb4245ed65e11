# SPDX-License-Identifier: Apache-2.0
"""Recordings and training shards of simulated drives. Imports no ROS."""
