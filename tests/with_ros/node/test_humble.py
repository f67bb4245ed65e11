# SPDX-License-Identifier: Apache-2.0
"""What ROS 2 Humble has otherwise. Its rclpy needs Python 3.10 and is not on PyPI: the differences are put on here."""

import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

AS_IN_HUMBLE = """
import sys, types
import rclpy.node

real = sys.modules["rclpy.event_handler"].SubscriptionEventCallbacks

class SubscriptionEventCallbacks(real):
    def __init__(self, *, deadline=None, liveliness=None, message_lost=None, incompatible_qos=None):
        super().__init__(message_lost=message_lost)

sys.modules["rclpy.event_handler"] = None
sys.modules["rclpy.qos_event"] = types.ModuleType("rclpy.qos_event")
sys.modules["rclpy.qos_event"].SubscriptionEventCallbacks = SubscriptionEventCallbacks

import cvcdepth_ros.node.subscriptions, cvcdepth_ros.surround_depth_node
from cvcdepth_ros.end_to_end import recorder

for module in (cvcdepth_ros.node.subscriptions, recorder):
    assert module.SubscriptionEventCallbacks is SubscriptionEventCallbacks
assert not recorder._HAS_MATCHED_EVENTS
"""


def test_node_and_recorder_are_imported_without_what_later_distributions_have():
    done = subprocess.run([sys.executable, "-c", AS_IN_HUMBLE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
