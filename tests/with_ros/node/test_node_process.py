# SPDX-License-Identifier: Apache-2.0
"""What the node's program sets before its imports load torch, which reads it once."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

LOADING_TORCH = """
import importlib.abc, os, sys

class Watch(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            print("torch:", os.environ.get("GOMP_SPINCOUNT"))

sys.meta_path.insert(0, Watch())
exec(sys.argv[1])
"""


@pytest.mark.parametrize(
    "program",
    [
        "from cvcdepth_ros.surround_depth_node import main; main(['surround_depth_node', '--help'])",
        "import cvcdepth_ros.bench.baseline_node",
    ],
)
@pytest.mark.parametrize(("environment", "found"), [({}, "0"), ({"OMP_WAIT_POLICY": "active"}, "None")])
def test_openmps_threads_sleep_in_the_node_unless_the_user_says_how_they_wait(program, environment, found):
    without = {name: value for name, value in os.environ.items() if not name.startswith(("GOMP", "OMP"))}
    loaded = subprocess.run(
        [sys.executable, "-c", LOADING_TORCH, program],
        env=without | environment,
        check=True,
        capture_output=True,
        text=True,
    )
    assert f"torch: {found}\n" in loaded.stdout
