# SPDX-License-Identifier: Apache-2.0
"""Topics, services, parameters and diagnostics of a running node are those of the committed list."""

import os
import subprocess
import sys

import pytest
from domains import own_domain
from repository import ROOT, load_tool

pytest.importorskip("rclpy", reason="no ROS in this environment")


def test_no_name_of_the_node_is_missing_added_or_changed_unless_the_list_says_so():
    surface = load_tool("public_surface")
    command = [sys.executable, ROOT / "tools" / "public_surface.py", "--only", "node"]
    with own_domain() as domain:
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    difference = surface.difference(surface.NODE_LIST.read_text(encoding="utf-8"), done.stdout)
    assert not difference, difference
