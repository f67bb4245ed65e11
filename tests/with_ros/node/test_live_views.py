# SPDX-License-Identifier: Apache-2.0
"""Wide lenses in the live node: one subscription for all views of a lens, and the depth that `run` computes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")
pytest.importorskip("embreex", reason="worlds need embreex")

from fisheye_drive import VIEWS, record_fisheyes
from rclpy.serialization import deserialize_message
from ros_graph import RosGraph, reliable
from sensor_msgs.msg import CameraInfo, Image

from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.bags import open_recording

SIZE = {"height": 64, "width": 96}
NAMES = [lens + view for lens in ("ahead", "port") for view in VIEWS]
DEPTH = {name: f"/surround_depth/{name}/depth/image_rect" for name in NAMES}
CLASSES = {"image_raw": Image, "camera_info": CameraInfo}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_fisheyes(tmp_path_factory.mktemp("fisheyes") / "drive", sets=2)


def recorded(drive: Path) -> list[tuple[str, Any]]:
    """The messages of the lenses, their camera_info first."""
    topics = [f"/{lens}/{what}" for lens in ("ahead", "port") for what in CLASSES]
    with open_recording(drive) as recording:
        found = [
            (message.topic, deserialize_message(message.cdr, CLASSES[message.topic.rpartition("/")[2]]))
            for message in recording.messages(topics)
        ]
    return sorted(found, key=lambda message: "camera_info" not in message[0])


def publish_all(graph: RosGraph, drive: Path) -> None:
    messages = recorded(drive)
    publishers = {topic: graph.node.create_publisher(type(message), topic, reliable()) for topic, message in messages}
    graph.await_matches(publishers.values())
    graph.spin_until(lambda: all(graph.node.count_publishers(topic) for topic in DEPTH.values()), "the node's outputs")
    # Each lens is subscribed once, whatever it is shown by.
    assert {topic: graph.node.count_subscribers(topic) for topic in publishers} == dict.fromkeys(publishers, 1)
    for topic, message in messages:
        publishers[topic].publish(message)


def content(image: Any) -> tuple[int, bytes]:
    return image.header.stamp.sec * 10**9 + image.header.stamp.nanosec, bytes(image.data)


def test_the_live_depth_of_every_view_is_what_run_computes(graph: RosGraph, drive: Path, tmp_path: Path):
    rig = tmp_path / "rig.yaml"
    assert main(["rig", str(drive), "-o", str(rig)]) == 0
    options = [f"--{name}={size}" for name, size in SIZE.items()]
    assert main(["run", str(drive), "-o", str(tmp_path / "depth"), "--untrained", *options]) == 0
    graph.subscribe(Image, *DEPTH.values())
    graph.start_node(rig=rig, untrained=True, max_age=0.0, reliable=True, **SIZE)
    publish_all(graph, drive)
    graph.spin_until(lambda: all(graph.received[topic] for topic in DEPTH.values()), "depth of every view")
    with open_recording(tmp_path / "depth") as recording:
        for name, topic in DEPTH.items():
            stored = dict(content(recording.deserialize(message)) for message in recording.messages([topic]))
            for image in graph.received[topic]:
                stamp, live = content(image)
                np.testing.assert_array_equal(np.frombuffer(live, np.float32), np.frombuffer(stored[stamp], np.float32))
                assert image.header.frame_id == (
                    f"{name[:-2]}_lens" if name.endswith("_m") else f"{name}_optical_frame"
                )


def test_wide_lenses_are_found_live_and_their_views_are_on_tf(graph: RosGraph, drive: Path):
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make tf2_msgs)")
    with open_recording(drive) as recording:
        (static,) = (deserialize_message(found.cdr, tf2_msgs.TFMessage) for found in recording.messages(["/tf_static"]))
    transforms = graph.node.create_publisher(tf2_msgs.TFMessage, "/tf_static", reliable(latched=True))
    transforms.publish(static)
    graph.subscribe(Image, *DEPTH.values())
    messages = recorded(drive)
    publishers = {topic: graph.node.create_publisher(type(message), topic, reliable()) for topic, message in messages}
    graph.start_node(rig="auto", untrained=True, max_age=0.0, reliable=True, **SIZE)

    def step() -> bool:
        for topic, message in messages:
            publishers[topic].publish(message)
        graph.spin(0.2)
        return all(graph.received[topic] for topic in DEPTH.values())

    graph.spin_until(step, "depth of every view")
    frames: set[str] = set()
    graph.node.create_subscription(
        tf2_msgs.TFMessage,
        "/tf_static",
        lambda message: frames.update(link.child_frame_id for link in message.transforms),
        reliable(latched=True),
    )
    graph.spin_until(lambda: {"ahead_l_optical_frame", "port_r_optical_frame"} <= frames, "the views' frames on TF")
    assert "ahead_m_optical_frame" not in frames
