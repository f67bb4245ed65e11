# SPDX-License-Identifier: Apache-2.0
"""What the node's program sets before its imports load torch, which reads it once."""

import pytest
from program_setup import WATCH_TORCH, output_of

pytest.importorskip("rclpy", reason="these tests need a ROS environment")


@pytest.mark.parametrize(
    "program",
    [
        "from cvcdepth_ros.surround_depth_node import main; main(['surround_depth_node', '--help'])",
        "import cvcdepth_ros.bench.baseline_node",
    ],
)
@pytest.mark.parametrize(("environment", "found"), [({}, "3000"), ({"OMP_WAIT_POLICY": "active"}, "None")])
def test_openmps_threads_soon_sleep_in_the_node_unless_the_user_says_how_they_wait(program, environment, found):
    assert f"torch: {found}\n" in output_of(WATCH_TORCH + program, **environment)
