# SPDX-License-Identifier: Apache-2.0
"""Tests leave no shared memory of killed nodes behind, and take none away from those that run."""

import os
import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from camera_scene import rig_without_calibrations
from ros_graph import RosGraph
from shared_memory import mapped_by, remove_what_nobody_uses


def test_what_a_killed_node_leaves_is_removed_and_what_others_use_is_not(graph: RosGraph, tmp_path: Path):
    rig = rig_without_calibrations(tmp_path / "rig.yaml")
    process, other = (graph.start_node(rig=rig, untrained=True, height=64, width=96) for _ in range(2))
    graph.await_status("node", "active")
    graph.spin_until(lambda: mapped_by(process.pid) and mapped_by(other.pid), "the shared memory of both")
    theirs = mapped_by(process.pid)
    process.send_signal(signal.SIGKILL)
    process.wait(30)
    ours = mapped_by(os.getpid()) | mapped_by(other.pid)
    left = {path for path in theirs - ours if path.exists()}
    assert left
    assert left <= set(remove_what_nobody_uses())
    assert not [path for path in left if path.exists()]
    assert all(path.exists() for path in ours)
