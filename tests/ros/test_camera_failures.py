# SPDX-License-Identifier: Apache-2.0
"""Cameras that die, freeze, change and return while the node runs: what is published and what is said. One node."""

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
from recordings import CAMERAS

from cvcdepth_core.rig import save_rig_layout
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.recorded_rig import discover_rig

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.serialization import deserialize_message
from ros_graph import RosGraph, reliable
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import String

SECOND = 10**9
CLOUD, CONTENT = "/surround_depth/points", "/surround_depth/points/cameras"
DEPTH = {name: f"/surround_depth/{name}/depth/image_rect" for name in CAMERAS}


class Cameras:
    """Six cameras at 10 Hz with the sample's pictures and stamps of their own; each can be made to fail."""

    def __init__(self, graph: RosGraph) -> None:
        self._graph = graph
        self._pictures: dict[str, list[Any]] = {name: [] for name in CAMERAS}
        self.infos: dict[str, Any] = {}
        for entry in recordings.sample_entries():
            name = entry.topic.split("/")[2] if entry.topic.startswith("/camera/") else ""
            if entry.type == "sensor_msgs/msg/CompressedImage":
                self._pictures[name].append(deserialize_message(entry.cdr, CompressedImage))
            elif entry.type == "sensor_msgs/msg/CameraInfo":
                self.infos[name] = deserialize_message(entry.cdr, CameraInfo)
        self.good_infos = dict(self.infos)
        create = graph.node.create_publisher
        self._images = {n: create(CompressedImage, f"/camera/{n}/image_raw/compressed", reliable()) for n in CAMERAS}
        self._info = {n: create(CameraInfo, f"/camera/{n}/camera_info", reliable()) for n in CAMERAS}
        self._cycle = 0
        self.sent: dict[str, set[int]] = {name: set() for name in CAMERAS}
        self.faults: dict[str, Callable[[Any], Any]] = {}
        """By camera: what becomes of its image; None is no image."""

    def cycle(self) -> None:
        """Let all cameras fire once."""
        self._cycle += 1
        for number, name in enumerate(CAMERAS):
            stamp = 1000 * SECOND + self._cycle * SECOND // 10 + number * 1_000_000
            image = copy.copy(self._pictures[name][self._cycle % 10])
            image.header = copy.deepcopy(image.header)
            image.header.stamp.sec, image.header.stamp.nanosec = divmod(stamp, SECOND)
            image = self.faults.get(name, lambda image: image)(image)
            self._info[name].publish(self.infos[name])
            if image is not None:
                self.sent[name].add(stamp_of(image))
                self._images[name].publish(image)

    def run_until(self, condition: Callable[[], object], what: str) -> None:
        def step() -> bool:
            self.cycle()
            self._graph.spin(0.1)
            return bool(condition())

        self._graph.spin_until(step, what)


class Scene:
    """The running node, its cameras and what it publishes."""

    def __init__(self, graph: RosGraph, rig: Path) -> None:
        self.graph = graph
        self.trace = rig.parent / "trace.json"
        self.cameras = Cameras(graph)
        graph.subscribe(PointCloud2, CLOUD)
        graph.subscribe(String, CONTENT)
        graph.subscribe(Image, *DEPTH.values())
        options = {"max_age": 0.0, "min_cameras": 4, "trace": self.trace}
        graph.start_node(rig=rig, untrained=True, height=64, width=96, **options)
        graph.await_subscribers([f"/camera/{name}/image_raw/compressed" for name in CAMERAS])

    def contained(self) -> list[str]:
        """Name the cameras of the last merged cloud."""
        messages = self.graph.received[CONTENT]
        return json.loads(messages[-1].data)["cameras"] if messages else []

    def fail(self, **faults: Callable[[Any], Any]) -> None:
        self.cameras.faults = faults

    def await_cameras(self, names: list[str]) -> None:
        self.cameras.run_until(lambda: self.contained() == names, f"clouds of {names}")

    def await_state(self, camera: str, text: str) -> DiagnosticStatus:
        def said() -> bool:
            status = self.graph.statuses.get(f"surround_depth: camera {camera}")
            return status is not None and text in status.message

        self.cameras.run_until(said, f"camera {camera} to be '{text}'")
        return self.graph.statuses[f"surround_depth: camera {camera}"]

    def recover(self) -> None:
        self.fail()
        self.cameras.infos = dict(self.cameras.good_infos)
        self.await_cameras(list(CAMERAS))
        self.await_state("left", "ok")


@pytest.fixture(scope="module")
def running_scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    rig = tmp_path_factory.mktemp("rig") / "rig.yaml"
    with open_recording(recordings.SAMPLE) as recording:
        layout = discover_rig(recording)
    found = {camera.name: camera for camera in layout.cameras}
    # Calibrations are left to camera_info, so that they can change.
    cameras = tuple(found[name].model_copy(update={"calibration": None}) for name in CAMERAS)
    save_rig_layout(rig, layout.model_copy(update={"cameras": cameras, "anchor": CAMERAS[0]}))
    graph = RosGraph()
    try:
        scene = Scene(graph, rig)
        scene.await_cameras(list(CAMERAS))
        yield scene
    finally:
        graph.close()


@pytest.fixture
def scene(running_scene: Scene) -> Iterator[Scene]:
    yield running_scene
    running_scene.recover()


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec) * SECOND + int(message.header.stamp.nanosec)


def silent(image: Any) -> None:
    return None


def test_a_dead_camera_is_told_and_the_others_go_on_until_it_returns(scene):
    scene.fail(left=silent)
    scene.await_cameras([name for name in CAMERAS if name != "left"])
    status = scene.await_state("left", "stale: no image for more than 1 s")
    assert status.level == DiagnosticStatus.ERROR


def test_another_camera_stands_in_for_a_dead_anchor(scene):
    anchor = CAMERAS[0]
    scene.fail(**{anchor: silent})
    scene.await_cameras(list(CAMERAS[1:]))
    cloud = scene.graph.received[CLOUD][-1]
    assert stamp_of(cloud) in scene.cameras.sent[CAMERAS[1]]
    scene.recover()
    assert stamp_of(scene.graph.received[CLOUD][-1]) in scene.cameras.sent[anchor]


def test_too_few_cameras_hold_everything_back(scene):
    scene.fail(left=silent, right=silent, back=silent)
    last = max(scene.cameras.sent["back"])
    scene.await_state("back", "stale")
    for _ in range(5):
        scene.cameras.cycle()
        scene.graph.spin(0.1)
    assert max(map(stamp_of, scene.graph.received[CLOUD])) <= last


def test_a_camera_that_sends_the_same_picture_for_ever_is_frozen_and_left_out(scene):
    frozen = scene.cameras._pictures["left"][0].data

    def freeze(image: Any) -> Any:
        image.data = frozen
        return image

    scene.fail(left=freeze)
    scene.await_state("left", "frozen: the same picture or stamp again and again")
    scene.await_cameras([name for name in CAMERAS if name != "left"])


def test_a_camera_whose_stamps_stand_still_is_frozen_and_left_out(scene):
    stamps = []

    def stop_the_clock(image: Any) -> Any:
        stamps.append(image.header.stamp)
        image.header.stamp = stamps[0]
        return image

    scene.fail(left=stop_the_clock)
    scene.await_state("left", "frozen")
    scene.await_cameras([name for name in CAMERAS if name != "left"])


def test_a_camera_that_sends_rubbish_is_rejected_and_left_out(scene):
    def cut(image: Any) -> Any:
        image.data = image.data[:1000]
        return image

    scene.fail(left=cut)
    status = scene.await_state("left", "rejected: ")
    assert status.level == DiagnosticStatus.ERROR
    scene.await_cameras([name for name in CAMERAS if name != "left"])


def test_a_camera_whose_calibration_becomes_impossible_is_left_out_at_once(scene):
    bad = copy.deepcopy(scene.cameras.infos["left"])
    bad.k = np.zeros(9)
    scene.cameras.infos["left"] = bad
    scene.await_state("left", "K[0] = 0: the camera is not calibrated")
    scene.await_cameras([name for name in CAMERAS if name != "left"])


def test_a_camera_that_changes_its_calibration_goes_on_with_the_new_one(scene):
    good = scene.cameras.infos["left"]
    wider = copy.deepcopy(good)
    wider.k[0] = wider.k[4] = wider.p[0] = wider.p[5] = good.k[0] / 2
    scene.cameras.infos["left"] = wider
    info_topic = "/surround_depth/left/depth/camera_info"
    scene.graph.subscribe(CameraInfo, info_topic)
    received = scene.graph.received[info_topic]
    scene.cameras.run_until(
        lambda: received and received[-1].k[0] == pytest.approx(wider.k[0] * 96 / 960), "the new focal length"
    )
    scene.cameras.infos["left"] = good
    scene.cameras.run_until(lambda: received[-1].k[0] == pytest.approx(good.k[0] * 96 / 960), "the old one")


def test_a_camera_whose_clock_jumps_away_is_told_and_left_out(scene):
    def late_by_an_hour(image: Any) -> Any:
        image.header.stamp.sec += 3600
        return image

    scene.fail(left=late_by_an_hour)
    scene.await_cameras([name for name in CAMERAS if name != "left"])
    scene.await_state("left", "unmatched: its images come, but their stamps fit no set")


def test_every_published_depth_belongs_to_an_image_of_that_camera_and_stamp(scene):
    received = scene.graph.received
    scene.cameras.run_until(lambda: all(len(received[topic]) > 10 for topic in DEPTH.values()), "some depth of each")
    for name, topic in DEPTH.items():
        stamps = [stamp_of(message) for message in received[topic]]
        assert set(stamps) <= scene.cameras.sent[name]
        assert len(set(stamps)) == len(stamps)


def test_the_trace_tells_what_ran_on_which_thread_also_while_the_node_runs(scene):
    events = json.loads(scene.trace.read_text().rpartition("},")[0] + "}]")
    threads = {event["tid"]: event["args"]["name"] for event in events if event["name"] == "thread_name"}
    where = {(event["name"], threads[event["tid"]].partition("_")[0]) for event in events if event["ph"] == "X"}
    assert {("decode", "prepare"), ("preprocess", "prepare"), ("inference", "inference")} <= where
    assert {("postprocess", "publish"), ("publish", "publish")} <= where
