# SPDX-License-Identifier: Apache-2.0
"""The live node's depth is what `bag_replay run` computes of the same images."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
from numpy.typing import NDArray
from recordings import CAMERAS
from rosbags.highlevel import AnyReader

from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_ros.bag_replay import main
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.surround_sets.synchronizer import SurroundSynchronizer

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message
from ros_graph import RosGraph, reliable
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

SIZE = {"height": 64, "width": 96}
CLASSES = {"sensor_msgs/msg/CompressedImage": CompressedImage, "sensor_msgs/msg/CameraInfo": CameraInfo}
DEPTH = {name: f"/surround_depth/{name}/depth/image_rect" for name in CAMERAS}
Depths = dict[tuple[int, int], NDArray[np.float32]]


def by_stamp(images: list[Any]) -> Depths:
    return {
        (image.header.stamp.sec, image.header.stamp.nanosec): np.frombuffer(image.data, np.float32).reshape(
            image.height, image.width
        )
        for image in images
    }


def stored_depth(path: Path, topic: str) -> Depths:
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return by_stamp([reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(connections)])


def live_depth(graph: RosGraph, rig: Path) -> dict[str, Depths]:
    """What the node publishes for the sample's first two sets, by camera and stamp."""
    entries = [entry for entry in recordings.sample_entries(2) if entry.type in CLASSES]
    publishers = {e.topic: graph.node.create_publisher(CLASSES[e.type], e.topic, reliable()) for e in entries}
    graph.subscribe(Image, *DEPTH.values())
    # Each image is sent once: best effort loses it when the subscription does not know of the publisher yet.
    graph.start_node(rig=rig, untrained=True, max_age=0.0, reliable=True, **SIZE)
    graph.await_matches(publishers.values())
    graph.spin_until(lambda: all(graph.node.count_publishers(topic) for topic in DEPTH.values()), "the node's outputs")
    for entry in sorted(entries, key=lambda entry: "CameraInfo" not in entry.type):
        publishers[entry.topic].publish(deserialize_message(entry.cdr, CLASSES[entry.type]))
    graph.spin_until(lambda: all(graph.received[topic] for topic in DEPTH.values()), "depth of every camera")
    return {name: by_stamp(graph.received[topic]) for name, topic in DEPTH.items()}


def test_run_and_the_live_node_give_the_same_depth_bit_for_bit(graph: RosGraph, tmp_path: Path):
    rig, recording = tmp_path / "rig.yaml", tmp_path / "two_sets"
    recordings.write_rosbag2(recording, recordings.sample_entries(2))
    assert main(["rig", str(recording), "-o", str(rig)]) == 0
    options = ("--height", str(SIZE["height"]), "--width", str(SIZE["width"]))
    assert main(["run", str(recording), "-o", str(tmp_path / "depth"), "--untrained", *options]) == 0
    published = live_depth(graph, rig)
    for name, topic in DEPTH.items():
        stored = stored_depth(tmp_path / "depth", topic)
        assert len(stored) == 2
        assert published[name]
        for stamp, depth in published[name].items():
            np.testing.assert_array_equal(depth, stored[stamp])


def refined_live(graph: RosGraph, rig: Path, topics: list[str], sets: int) -> dict[str, list[Image]]:
    """What a node that refines publishes, each set waited for, so that none is left out."""
    tf2_msgs = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make tf2_msgs)")
    classes = {**CLASSES, "tf2_msgs/msg/TFMessage": tf2_msgs.TFMessage}
    entries = [entry for entry in recordings.sample_entries(sets) if entry.type in classes]
    latched = {"/tf_static"}
    publishers = {
        e.topic: graph.node.create_publisher(classes[e.type], e.topic, reliable(latched=e.topic in latched))
        for e in entries
    }
    graph.subscribe(Image, *topics)
    graph.start_node(rig=rig, untrained=True, refine="geometry", max_age=0.0, reliable=True, publish_tf=False, **SIZE)
    graph.await_matches(publishers.values())
    graph.spin_until(lambda: all(graph.node.count_publishers(topic) for topic in topics), "the node's outputs")
    images = [entry for entry in entries if entry.type.endswith("CompressedImage")]
    for entry in sorted(entries, key=lambda entry: "CameraInfo" not in entry.type):
        if entry not in images:
            publishers[entry.topic].publish(deserialize_message(entry.cdr, classes[entry.type]))
    # Motion that comes after the first pictures would be another history.
    graph.spin_until(lambda: graph.values("refinement").get("motion topic") == "/tf", "the motion")
    matching: SurroundSynchronizer[None] = SurroundSynchronizer.from_layout(load_rig_layout(rig), 0.1)
    done = 0
    for entry in images:
        message = deserialize_message(entry.cdr, classes[entry.type])
        publishers[entry.topic].publish(message)
        done += len(matching.add(entry.topic.split("/")[2], stamp_ns(message), None))
        graph.spin_until(lambda done=done: all(len(graph.received[t]) >= done for t in topics), f"set {done}")
    return {topic: graph.received[topic] for topic in topics}


def test_run_and_the_live_node_refine_the_same_sets_alike_bit_for_bit(graph: RosGraph, tmp_path: Path):
    sets = 5
    rig, recording = tmp_path / "rig.yaml", tmp_path / "some_sets"
    recordings.write_rosbag2(recording, recordings.sample_entries(sets))
    assert main(["rig", str(recording), "-o", str(rig)]) == 0
    options = ("--height", str(SIZE["height"]), "--width", str(SIZE["width"]), "--refine", "geometry")
    run = ["run", str(recording), "-o", str(tmp_path / "depth"), "--untrained", "--rig", str(rig), *options]
    assert main(run) == 0
    topics = [f"/surround_depth/{name}/depth/{part}" for name in CAMERAS for part in ("image_rect", "confidence")]
    for topic, images in refined_live(graph, rig, topics, sets).items():
        stored, published = stored_depth(tmp_path / "depth", topic), by_stamp(images)
        assert published.keys() == stored.keys()
        for stamp, values in published.items():
            np.testing.assert_array_equal(values, stored[stamp])
        assert any(values.any() for values in published.values())
    graph.await_status("refinement", "earlier pictures by odometry, and neighbours")


def test_motion_from_the_pictures_is_published_where_it_is_asked_for(graph: RosGraph, tmp_path: Path):
    rig, recording = tmp_path / "rig.yaml", tmp_path / "some_sets"
    recordings.write_rosbag2(recording, recordings.sample_entries(4))
    assert main(["rig", str(recording), "-o", str(rig)]) == 0
    entries = [entry for entry in recordings.sample_entries(4) if entry.type in CLASSES]
    publishers = {e.topic: graph.node.create_publisher(CLASSES[e.type], e.topic, reliable()) for e in entries}
    graph.subscribe(Odometry, "/surround_depth/odometry")
    graph.subscribe(PointCloud2, "/surround_depth/points")
    graph.start_node(rig=rig, publish_odometry=True, max_age=0.0, reliable=True)
    graph.await_matches(publishers.values())
    graph.spin_until(lambda: graph.node.count_publishers("/surround_depth/odometry"), "the topic")
    clouds, images = graph.received["/surround_depth/points"], 0
    for entry in sorted(entries, key=lambda entry: "CameraInfo" not in entry.type):
        publishers[entry.topic].publish(deserialize_message(entry.cdr, CLASSES[entry.type]))
        images += "CameraInfo" not in entry.type
        before = images // len(CAMERAS) - 1  # a busy node would leave sets out
        graph.spin_until(lambda before=before: len(clouds) >= before, "the set before")
    graph.spin_until(lambda: graph.received["/surround_depth/odometry"], "odometry")
    message = graph.received["/surround_depth/odometry"][-1]
    assert (message.header.frame_id, message.child_frame_id) == ("visual_odom", "base_link")
    assert 3.0 < message.twist.twist.linear.x < 7.0  # 5 m/s
    assert 0 < message.twist.covariance[0] < 1.0
