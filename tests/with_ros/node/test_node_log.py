# SPDX-License-Identifier: Apache-2.0
"""What somebody learns who sees nothing of the node but its log: no depth comes, why, and what helps."""

import copy
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from camera_faults import silent
from camera_scene import CLOUD, CONTENT, SECOND, Cameras, rig_without_calibrations, stamp_of
from geometry_msgs.msg import TransformStamped
from recordings import CAMERAS
from ros_graph import RosGraph, reliable
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header, String

from cvcdepth_core.rig.rig_file import load_rig_layout

SMALL = {"untrained": True, "height": 64, "width": 96, "backend": "torch_eager"}  # the engine that is there at once


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


def test_that_nobody_subscribes_is_told_once(graph: RosGraph, rig: Path):
    cameras = Cameras(graph)
    graph.start_node(rig=rig, max_age=0.0, **SMALL)
    told = "sets are matched, but nothing subscribes to the node's topics: no depth is computed"
    cameras.run_until(lambda: lines_with(graph, "INFO", told), "the line")
    for _ in range(20):
        cameras.cycle()
        graph.spin(0.1)
    assert len(lines_with(graph, "INFO", told)) == 1


def test_rig_auto_says_what_it_waits_for_and_since_when(graph: RosGraph):
    pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
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


def test_what_a_merged_cloud_contains_is_published_to_whoever_asks_for_that_alone(graph: RosGraph, rig: Path):
    graph.subscribe(String, CONTENT)
    cameras = Cameras(graph)
    graph.start_node(rig=rig, max_age=0.0, **SMALL)
    cameras.run_until(lambda: graph.received[CONTENT], "the content of a cloud")
    assert json.loads(graph.received[CONTENT][0].data)["cameras"] == list(CAMERAS)


def test_the_rectified_picture_has_a_camera_info_beside_it(graph: RosGraph, rig: Path):
    topics = {"image_rect": Image, "camera_info": CameraInfo}
    for topic, kind in topics.items():
        graph.subscribe(kind, f"/surround_depth/left/{topic}")
    cameras = Cameras(graph)
    graph.start_node(rig=rig, max_age=0.0, **SMALL)
    cameras.run_until(lambda: all(graph.received[f"/surround_depth/left/{topic}"] for topic in topics), "both")
    picture, info = (graph.received[f"/surround_depth/left/{topic}"][0] for topic in topics)
    assert picture.header == info.header
    assert (picture.height, picture.width) == (info.height, info.width)
    assert info.p[0] > 0


# The rig file's poses on TF


@pytest.fixture
def tf(graph: RosGraph) -> "Tf":
    return Tf(graph)


class Tf:
    """What is on /tf_static, and somebody else who publishes there."""

    def __init__(self, graph: RosGraph) -> None:
        self.messages = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
        self._graph = graph
        self.links: dict[str, list[tuple[str, float]]] = {}
        node, qos = graph.node, reliable(latched=True)
        node.create_subscription(self.messages.TFMessage, "/tf_static", self._on_message, qos)
        self._publisher = node.create_publisher(self.messages.TFMessage, "/tf_static", qos)

    def publish(self, **parents: str) -> None:
        """Hang these frames from these parents, 5 m ahead of them."""
        links = [
            TransformStamped(header=Header(frame_id=parent), child_frame_id=child) for child, parent in parents.items()
        ]
        for link in links:
            link.transform.translation.x = 5.0
        self._publisher.publish(self.messages.TFMessage(transforms=links))

    def _on_message(self, message: Any) -> None:
        for link in message.transforms:
            place = (link.header.frame_id, link.transform.translation.x)
            self.links.setdefault(link.child_frame_id, []).append(place)


def frame_of(camera: str) -> str:
    return f"{camera}_camera_optical_frame"


def test_poses_of_the_rig_file_are_published_but_for_frames_that_tf_has(graph: RosGraph, rig: Path, tf: Tf):
    layout = load_rig_layout(rig)
    tf.publish(**{frame_of("left"): "roof", "roof": "base_link"})
    graph.start_node(rig=rig, max_age=0.0, **SMALL)
    others = [frame_of(name) for name in CAMERAS if name != "left"]
    graph.spin_until(lambda: all(frame in tf.links for frame in others), "the poses of the others")
    for camera in layout.cameras:
        place = ("roof", 5.0) if camera.name == "left" else ("base_link", camera.base_T_camera.translation[0])
        assert tf.links[frame_of(camera.name)] == [pytest.approx(place)]
    told = f"frame {frame_of('left')} is elsewhere on TF than in the rig file, by "
    graph.spin_until(lambda: lines_with(graph, "WARN", told), "the difference in the log")


def test_poses_are_not_published_where_the_parameter_says_so(graph: RosGraph, rig: Path, tf: Tf):
    graph.start_node(rig=rig, publish_tf=False, **SMALL)
    graph.await_status("node", "active")
    graph.spin(4.0)
    assert tf.links == {}
    assert not graph.node.get_publishers_info_by_topic("/tf_static")[1:]  # but the test's own


def test_a_frame_that_gets_a_second_parent_later_is_told(graph: RosGraph, rig: Path, tf: Tf):
    graph.start_node(rig=rig, **SMALL)
    graph.spin_until(lambda: frame_of("left") in tf.links, "the poses")
    tf.publish(**{frame_of("left"): "roof"})
    graph.spin_until(lambda: lines_with(graph, "WARN", "hangs from roof too, which breaks the tree"), "the warning")
    assert "publish_tf:=false" in graph.log()


# Time


def test_latencies_that_cannot_be_known_are_not_told_as_numbers(graph: RosGraph, rig: Path):
    graph.subscribe(PointCloud2, CLOUD)
    cameras = Cameras(graph)  # its stamps are of 1970
    process = graph.start_node(rig=rig, max_age=0.0, **SMALL)
    cameras.run_until(lambda: graph.received[CLOUD], "a cloud")
    stages = ("receive (ROS time)", "age of newest image at publish (ROS time)")
    cameras.run_until(lambda: "not known" in graph.values("inference").get(stages[1], ""), "a statement")
    assert not [key for key in graph.values("inference") if key.startswith(stages) and key not in stages]
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 0
    for stage in stages:
        (line,) = lines_with(graph, "INFO", stage)
        assert line.endswith(f"{stage}: not known: images are not stamped in the node's time")


def test_a_recording_that_loops_loses_no_set_at_the_jump_although_the_clock_follows_later(graph: RosGraph, rig: Path):
    graph.subscribe(PointCloud2, CLOUD)
    cameras = Cameras(graph)
    clock = graph.node.create_publisher(Clock, "/clock", reliable())
    graph.start_node(rig=rig, use_sim_time=True, reliable=True, **SMALL)
    images = [f"/camera/{name}/image_raw/compressed" for name in CAMERAS]
    infos = [f"/camera/{name}/camera_info" for name in CAMERAS]
    graph.await_subscribers([*images, *infos, "/clock"])

    def play_cycle() -> None:
        cameras.cycle()
        graph.spin(0.15)
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(cameras.newest_stamp, SECOND)
        clock.publish(message)
        graph.spin(0.15)

    rounds, cycles = 3, 15
    for _ in range(rounds):
        cameras.begin_again()
        for _ in range(cycles):
            play_cycle()
    counted = {"matched": rounds * cycles, "stale": 0, "refused": 0}
    graph.spin_until(
        lambda: {name: int(graph.values("synchronisation").get(name, -1)) for name in counted} == counted,
        "every set",
        10,
    )
    for name in CAMERAS:
        values = graph.values(f"camera {name}")
        assert values["clock steps"] == str(rounds - 1)
        assert not [key for key in values if key.startswith("dropped: ")], values
