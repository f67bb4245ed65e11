# SPDX-License-Identifier: Apache-2.0
"""What somebody learns who sees nothing of the node but its log: no depth comes, why, and what helps."""

import copy
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from camera_faults import silent
from camera_scene import CLOUD, SECOND, Cameras, rig_without_calibrations, stamp_of
from recordings import CAMERAS
from ros_graph import RosGraph, reliable
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

SMALL = {"untrained": True, "height": 64, "width": 96}


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return rig_without_calibrations(tmp_path / "rig.yaml")


def lines_with(graph: RosGraph, severity: str, text: str) -> list[str]:
    return [line for line in graph.log().splitlines() if f"[{severity}]" in line and text in line]


def shifted(seconds: float) -> Callable[[Any], Any]:
    def shift(image: Any) -> Any:
        stamp = stamp_of(image) + round(seconds * SECOND)
        image.header = copy.deepcopy(image.header)
        image.header.stamp.sec, image.header.stamp.nanosec = divmod(stamp, SECOND)
        return image

    return shift


def test_a_recording_without_simulated_time_is_told_with_the_remedy_and_mended_by_it(graph: RosGraph, rig: Path):
    graph.subscribe(PointCloud2, CLOUD)
    cameras = Cameras(graph)  # its stamps are of 1970
    clock = graph.node.create_publisher(Clock, "/clock", reliable())
    graph.start_node(rig=rig, **SMALL)
    told = "sets: every set is older than max_age (0.5 s) in the node's time, by "
    cameras.run_until(lambda: lines_with(graph, "WARN", told), "the warning")
    assert "start the node with -p use_sim_time:=true" in lines_with(graph, "WARN", told)[0]
    for _ in range(30):
        cameras.cycle()
        graph.spin(0.1)
    assert len(lines_with(graph, "WARN", told)) == 1
    assert not graph.received[CLOUD]

    graph.set_parameters(use_sim_time=True)

    def mended() -> bool:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(max(cameras.sent[CAMERAS[0]]), SECOND)
        clock.publish(message)
        return bool(lines_with(graph, "INFO", "sets: mended after"))

    cameras.run_until(mended, "its end in the log")
    cameras.run_until(lambda: mended() and graph.received[CLOUD], "a cloud")


def test_a_simulated_time_that_nobody_publishes_is_told(graph: RosGraph, rig: Path):
    graph.start_node(rig=rig, use_sim_time=True, **SMALL)
    graph.spin_until(lambda: lines_with(graph, "WARN", "clock: use_sim_time is true, but nothing"), "the warning")


def test_waiting_cameras_are_told_once_they_are_no_longer_just_starting(graph: RosGraph, rig: Path):
    graph.start_node(rig=rig, **SMALL)
    told = "camera left: waiting for camera_info on /camera/left/camera_info; no publisher on"
    graph.spin_until(lambda: lines_with(graph, "WARN", told), "the warning")
    assert "publish it, or write the calibration into the rig file (for " in lines_with(graph, "WARN", told)[0]
    assert len(lines_with(graph, "WARN", "camera left")) == 1


def test_the_camera_that_holds_up_every_set_is_told_and_when_it_no_longer_does(graph: RosGraph, rig: Path):
    graph.subscribe(PointCloud2, CLOUD)
    cameras = Cameras(graph)
    cameras.faults = {"left": shifted(-10800.0)}
    graph.start_node(rig=rig, max_age=0.0, **SMALL)
    told = "sets: no set: camera left's stamps are 3.0 hours behind the others'"
    cameras.run_until(lambda: lines_with(graph, "WARN", told), "the warning")
    assert not lines_with(graph, "WARN", "camera front")
    cameras.faults = {}
    cameras.run_until(lambda: lines_with(graph, "INFO", "sets: mended after"), "its end in the log")
    cameras.run_until(lambda: graph.received[CLOUD], "a cloud")


def test_a_camera_that_never_sends_is_told_as_the_one_that_is_waited_for(graph: RosGraph, rig: Path):
    cameras = Cameras(graph)
    cameras.faults = {"right": silent}
    graph.start_node(rig=rig, max_age=0.0, **SMALL)
    told = "sets: no set: 6 cameras are needed: camera right: waiting for images"
    cameras.run_until(lambda: lines_with(graph, "WARN", told), "the warning")
    assert "min_cameras:=5 goes on without" in lines_with(graph, "WARN", told)[0]


def test_rig_auto_says_what_it_waits_for_and_since_when(graph: RosGraph):
    pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make tf2_msgs)")
    graph.start_node(rig="auto", **SMALL)
    told = "rig auto: waiting for at least 1 camera with image and camera_info topics, found none; are the drivers"
    graph.spin_until(lambda: lines_with(graph, "WARN", told), "the warning")
    assert "running, in this ROS_DOMAIN_ID? (for 3 s now)" in lines_with(graph, "WARN", told)[0]


def test_parameters_that_are_none_are_named_with_the_nearest_on_the_command_line_and_in_a_file(
    graph: RosGraph, rig: Path, tmp_path: Path
):
    file = tmp_path / "parameters.yaml"
    file.write_text("/**:\n  ros__parameters:\n    checkpont: model.safetensors\n    rgi: auto\n    zzz: 1\n")
    topic = "qos_overrides./camera/lefft/camera_info.subscription.depth"
    good = "qos_overrides./camera/left/image_raw/compressed.subscription.depth"
    given = {"tolerence": 0.2, topic: 5, good: 5}
    graph.start_node("--params-file", str(file), rig=rig, use_sim_time=False, **SMALL, **given)
    graph.await_status("node", "active")
    expected = {
        "tolerence": "; did you mean tolerance?",
        "checkpont": "; did you mean checkpoint?",
        "rgi": "; did you mean rig?",
        "zzz": "",
        topic: f"; did you mean {topic.replace('lefft', 'left')}?",
    }
    for name, hint in expected.items():
        assert [line.rpartition("]: ")[2] for line in lines_with(graph, "WARN", f"parameter {name} ")] == [
            f"parameter {name} is unknown and has no effect{hint}"
        ]
    assert len(lines_with(graph, "WARN", "is unknown and has no effect")) == len(expected)


def test_arguments_that_cannot_be_parsed_are_one_line(graph: RosGraph):
    process = graph.start_node("-p", "rig:=")
    assert process.wait(30) == 1
    assert graph.log().startswith("surround_depth_node: Failed to parse ROS arguments: ")
    assert len(graph.log().splitlines()) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_last_lines_of_the_log_are_the_latencies_and_no_complaint(
    number: signal.Signals, graph: RosGraph, rig: Path
):
    graph.subscribe(PointCloud2, CLOUD)
    cameras = Cameras(graph)
    process = graph.start_node(rig=rig, max_age=0.0, **SMALL)
    cameras.run_until(lambda: graph.received[CLOUD], "a cloud")
    process.send_signal(number)
    cameras.cycle()  # images still come
    process.send_signal(number)  # as `ros2 launch` does
    assert process.wait(30) == 0
    assert lines_with(graph, "INFO", "inference: p50 ")
    assert "Failed to publish" not in graph.log()
    assert "Traceback" not in graph.log()
