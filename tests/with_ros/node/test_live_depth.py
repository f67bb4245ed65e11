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

from cvcdepth_ros.bag_replay import main

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from rclpy.serialization import deserialize_message
from ros_graph import RosGraph, reliable
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

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
