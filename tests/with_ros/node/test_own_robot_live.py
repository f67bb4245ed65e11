# SPDX-License-Identifier: Apache-2.0
"""The node on the robot of `docs/own_rig.md`, whose topics and frames have odd names: the base frame is enough."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")
pytest.importorskip("embreex", reason="worlds need embreex")

from own_robot import HEIGHT, WIDTH, robot
from ros_graph import RosGraph, reliable
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from cvcdepth_core.rig.rig_file import CameraEntry
from cvcdepth_ros.messages.conversion import ros_message_factory

NAMES = [camera.name for camera in robot().cameras]
DEPTH = {name: f"/surround_depth/{name}/depth/image_rect" for name in NAMES}


class Robot:
    """Its four cameras, in this process, and `/tf_static`."""

    def __init__(self, graph: RosGraph) -> None:
        transforms = pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not built here (make messages)")
        self._graph, create = graph, graph.node.create_publisher
        self._cameras = robot().cameras
        self._images = {c.name: create(Image, c.image_topic, reliable()) for c in self._cameras}
        self._infos = {c.name: create(CameraInfo, c.camera_info_topic, reliable()) for c in self._cameras}
        mounts = {c.frame_id: c.base_T_camera.matrix(c.name) for c in self._cameras if c.frame_id and c.base_T_camera}
        self._static = create(transforms.TFMessage, "/tf_static", reliable(latched=True))
        self._static.publish(ros_message_factory().static_transforms(0, "chassis", mounts))
        self._random = np.random.default_rng(0)

    def fire(self) -> None:
        stamp = self._graph.node.get_clock().now().to_msg()
        for camera in self._cameras:
            header = Header(stamp=stamp, frame_id=camera.frame_id)
            self._infos[camera.name].publish(_info(header, camera))
            pixels = self._random.integers(0, 255, 3 * WIDTH * HEIGHT, np.uint8).tobytes()
            image = Image(header=header, height=HEIGHT, width=WIDTH, encoding="bgr8", step=3 * WIDTH, data=pixels)
            self._images[camera.name].publish(image)

    def run_until_depth(self) -> None:
        def step() -> bool:
            self.fire()
            self._graph.spin(0.2)
            return all(self._graph.received[topic] for topic in DEPTH.values())

        self._graph.spin_until(step, "depth of every camera")


def _info(header: Header, camera: CameraEntry) -> CameraInfo:
    calibration = camera.calibration
    assert calibration is not None
    named = {name: [float(number) for number in getattr(calibration, name)] for name in "dkp"}
    return CameraInfo(
        header=header, height=HEIGHT, width=WIDTH, distortion_model="equidistant", r=np.eye(3).ravel().tolist(), **named
    )


def test_with_the_base_frame_alone_its_cameras_are_found_and_get_depth(graph: RosGraph):
    graph.subscribe(Image, *DEPTH.values())
    graph.subscribe(PointCloud2, "/surround_depth/points")
    cameras = Robot(graph)
    graph.start_node(rig="auto", base_frame="chassis", min_cameras=4, untrained=True, height=64, width=96)
    cameras.run_until_depth()
    for name, topic in DEPTH.items():
        image = graph.received[topic][0]
        assert image.header.frame_id == f"eye_{name}"
        assert np.isfinite(np.frombuffer(image.data, np.float32)).mean() > 0.9
    graph.spin_until(lambda: graph.received["/surround_depth/points"], "a cloud")
    assert graph.received["/surround_depth/points"][0].header.frame_id == "chassis"


def test_without_it_the_log_names_the_parameter_and_the_frames(graph: RosGraph):
    cameras = Robot(graph)
    graph.start_node(rig="auto", untrained=True, height=64, width=96)

    def told() -> list[str]:
        cameras.fire()
        graph.spin(0.2)
        return [line for line in graph.log().splitlines() if "the parameter base_frame is base_link" in line]

    graph.spin_until(told, "the line")
    assert "[WARN]" in told()[0]
    assert "known are ['chassis', 'eye_a7'" in told()[0]
