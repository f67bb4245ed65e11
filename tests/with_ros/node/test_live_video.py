# SPDX-License-Identifier: Apache-2.0
"""Cameras that send video: H.264 and H.265 of a running node's cameras, over DDS."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from camera_scene import CLOUD, DEPTH, Cameras, rig_without_calibrations
from recordings import CAMERAS
from ros_graph import RosGraph, reliable
from sensor_msgs.msg import Image, PointCloud2
from video_packets import encoded

from cvcdepth_core.rig.rig_file import load_rig_layout, save_rig_layout
from cvcdepth_ros.node.subscriptions import CameraInputs

PACKAGES = "not built here (make messages)"
FRAMES = 20
KEY_EVERY = 5
TOPICS = {"front": "/camera/front/image_raw/ffmpeg", "left": "/camera/left/video"}


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The sample's, where two cameras send video."""
    layout = load_rig_layout(rig_without_calibrations(tmp_path / "rig.yaml"))
    cameras = tuple(
        camera.model_copy(update={"image_topic": TOPICS.get(camera.name, camera.image_topic)})
        for camera in layout.cameras
    )
    save_rig_layout(tmp_path / "rig.yaml", layout.model_copy(update={"cameras": cameras}))
    return tmp_path / "rig.yaml"


class Videos:
    """What two of the six cameras send, in place of their images."""

    def __init__(self, graph: RosGraph, cameras: Cameras) -> None:
        ffmpeg = pytest.importorskip("ffmpeg_image_transport_msgs.msg", reason=PACKAGES)
        foxglove = pytest.importorskip("foxglove_msgs.msg", reason=PACKAGES)
        classes = {"front": ffmpeg.FFMPEGPacket, "left": foxglove.CompressedVideo}
        qos = reliable()
        self._publishers = {name: graph.node.create_publisher(classes[name], TOPICS[name], qos) for name in TOPICS}
        self._classes = classes
        pictures = {name: [_picture(cameras, name, number % 10) for number in range(FRAMES)] for name in TOPICS}
        codecs = {"front": "h264", "left": "hevc"}
        self._packets = {name: encoded(pictures[name], codecs[name], key_every=KEY_EVERY, crf=35) for name in TOPICS}
        self._count = dict.fromkeys(TOPICS, 3)  # the node joins late: between key frames
        self.lost: set[str] = set()
        """Cameras of which one packet between two key frames gets lost."""
        cameras.faults = {name: self._sender(name) for name in TOPICS}

    def _sender(self, name: str) -> Callable[[Any], None]:
        def send(image: Any) -> None:
            number = self._count[name] % FRAMES
            self._count[name] += 1
            if name in self.lost and number % KEY_EVERY == 2:
                return
            self._publishers[name].publish(self._message(name, image.header, self._packets[name][number]))

        return send

    def _message(self, name: str, header: Any, packet: bytes) -> Any:
        if name == "front":
            return self._classes[name](header=header, encoding="h264;yuv420p;bgr8;bgr8", data=packet)
        return self._classes[name](timestamp=header.stamp, frame_id=header.frame_id, format="h265", data=packet)


def _picture(cameras: Cameras, name: str, number: int) -> Any:
    return cv2.imdecode(np.frombuffer(cameras.pictures[name][number].data, np.uint8), cv2.IMREAD_COLOR)


def test_cameras_that_send_video_get_depth_from_their_next_key_frame_on(graph: RosGraph, rig: Path):
    def told(camera: str) -> bool:  # as this camera's state, or with the set that it cost
        return re.search(f"camera {camera}: [^;\\n]*(packet|waiting for a key frame)", graph.log()[before:]) is not None

    cameras = Cameras(graph)
    videos = Videos(graph, cameras)
    graph.subscribe(PointCloud2, CLOUD)
    graph.subscribe(Image, *DEPTH.values())
    graph.start_node(rig=rig, untrained=True, height=64, width=96, max_age=0.0, reliable=True)
    graph.await_subscribers([*TOPICS.values()])
    cameras.run_until(lambda: all(graph.received[topic] for topic in (CLOUD, *DEPTH.values())), "cloud and depth")
    for name in CAMERAS:
        depth = np.frombuffer(graph.received[DEPTH[name]][0].data, np.float32)
        assert np.isfinite(depth).any(), name

    before = len(graph.log())
    videos.lost = {"front", "left"}
    cameras.run_until(lambda: all(map(told, TOPICS)), "both losses in the log")
    videos.lost.clear()
    count = len(graph.received[CLOUD])
    cameras.run_until(lambda: len(graph.received[CLOUD]) > count + 3, "clouds again")


@pytest.mark.parametrize("missing", ["package", "PyAV"])
def test_what_is_to_be_installed_for_video_is_one_line(
    missing: str, graph: RosGraph, rig: Path, monkeypatch: pytest.MonkeyPatch
):
    if missing == "package":
        expected = (
            "/camera/left/video carries foxglove_msgs/msg/CompressedVideo, whose package is not installed: apt install "
            "ros-$ROS_DISTRO-foxglove-msgs, or source a workspace with foxglove_msgs"
        )
        monkeypatch.setitem(sys.modules, "foxglove_msgs.msg", None)
    else:
        expected = "/camera/left/video: its images are video; pip install 'cvcdepth_ros[video]' reads them"
        monkeypatch.setattr("cvcdepth_core.images.video.find_spec", lambda _: None)
    types = {TOPICS["left"]: ["foxglove_msgs/msg/CompressedVideo"]}
    monkeypatch.setattr("cvcdepth_ros.node.subscriptions.topic_types", lambda _: types)
    graph.node.create_publisher(Image, TOPICS["left"], reliable())  # somebody is there
    inputs = CameraInputs(graph.node, load_rig_layout(rig), False, lambda *_: None, lambda *_: None)
    inputs.connect()
    graph.spin_until(lambda: [reason for _, reason in inputs.troubles()["left"]] == [expected], "the line")
    inputs.close()
