# SPDX-License-Identifier: Apache-2.0
"""tf2_msgs, built from its one-line definition (see tests/support/message_packages), is a message like any other."""

import os
import subprocess
import sys

import pytest
from domains import own_domain

pytest.importorskip("rclpy", reason="no ROS in this environment")
pytest.importorskip("tf2_msgs", reason="tf2_msgs is not built (it needs g++)")

LATCHED = """
import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage
rclpy.init()
node = rclpy.create_node("latched")
qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""
PUBLISH = f"""{LATCHED}
transform = TransformStamped(child_frame_id="front_camera_optical_frame")
transform.header.frame_id = "base_link"
transform.transform.translation.x = 1.5
publisher = node.create_publisher(TFMessage, "/tf_static", qos)
publisher.publish(TFMessage(transforms=[transform]))
input()
"""
RECEIVE = f"""{LATCHED}
received = []
subscription = node.create_subscription(TFMessage, "/tf_static", received.append, qos)
while not received:
    rclpy.spin_once(node)
(transform,) = received[0].transforms
print(transform.header.frame_id, transform.child_frame_id, transform.transform.translation.x)
"""


def test_a_latched_transform_reaches_another_process():
    with own_domain() as domain:
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        with subprocess.Popen([sys.executable, "-c", PUBLISH], env=environment, stdin=subprocess.PIPE) as publisher:
            try:
                receive = [sys.executable, "-c", RECEIVE]
                done = subprocess.run(receive, env=environment, capture_output=True, text=True, check=True, timeout=60)
            finally:
                publisher.kill()
    assert done.stdout == "base_link front_camera_optical_frame 1.5\n"
