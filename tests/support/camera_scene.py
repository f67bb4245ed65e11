# SPDX-License-Identifier: Apache-2.0
"""Six cameras in front of a running node, for tests and for tools/soak.py: each camera can be made to fail."""

import copy
import json
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import recordings
from camera_faults import Fault
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.serialization import deserialize_message
from recordings import CAMERAS
from ros_graph import RosGraph, reliable
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import String

from cvcdepth_core.rig.rig_file import save_rig_layout
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.recordings.rig import discover_rig

SECOND = 10**9
CLOUD, CONTENT = "/surround_depth/points", "/surround_depth/points/cameras"
DEPTH = {name: f"/surround_depth/{name}/depth/image_rect" for name in CAMERAS}


class Cameras:
    """Six cameras at 10 Hz with the sample's pictures and stamps of their own; each can be made to fail."""

    def __init__(self, graph: RosGraph) -> None:
        self._graph = graph
        self.pictures: dict[str, list[Any]] = {name: [] for name in CAMERAS}
        self.infos: dict[str, Any] = {}
        for entry in recordings.sample_entries():
            name = entry.topic.split("/")[2] if entry.topic.startswith("/camera/") else ""
            if entry.type == "sensor_msgs/msg/CompressedImage":
                self.pictures[name].append(deserialize_message(entry.cdr, CompressedImage))
            elif entry.type == "sensor_msgs/msg/CameraInfo":
                self.infos[name] = deserialize_message(entry.cdr, CameraInfo)
        self.good_infos = dict(self.infos)
        create = graph.node.create_publisher
        self._images = {n: create(CompressedImage, f"/camera/{n}/image_raw/compressed", reliable()) for n in CAMERAS}
        self._info = {n: create(CameraInfo, f"/camera/{n}/camera_info", reliable()) for n in CAMERAS}
        self._cycle = 0
        self.sent: dict[str, set[int]] = {name: set() for name in CAMERAS}
        self.newest_stamp = 0
        self.faults: dict[str, Callable[[Any], Any]] = {}
        """By camera: what becomes of its image; None is no image."""

    def cycle(self) -> None:
        """Let all cameras fire once."""
        self._cycle += 1
        for number, name in enumerate(CAMERAS):
            stamp = 1000 * SECOND + self._cycle * SECOND // 10 + number * 1_000_000
            image = copy.copy(self.pictures[name][self._cycle % 10])
            image.header = copy.deepcopy(image.header)
            image.header.stamp.sec, image.header.stamp.nanosec = divmod(stamp, SECOND)
            image = self.faults.get(name, lambda image: image)(image)
            self.publish_info(name)
            if image is not None:
                self.sent[name].add(stamp_of(image))
                self.newest_stamp = stamp_of(image)
                self._images[name].publish(image)

    def begin_again(self) -> None:
        """Let the stamps go back to the first, as where a recording loops."""
        self._cycle = 0

    def publish_info(self, name: str) -> None:
        self._info[name].publish(self.infos[name])

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
        options = {"max_age": 0.0, "min_cameras": 4, "max_image_mb": 1.5, "trace": self.trace}
        self.node = graph.start_node(rig=rig, untrained=True, height=64, width=96, **options)
        graph.await_subscribers([f"/camera/{name}/image_raw/compressed" for name in CAMERAS])

    def contained(self) -> list[str]:
        """Name the cameras of the last merged cloud."""
        messages = self.graph.received[CONTENT]
        return json.loads(messages[-1].data)["cameras"] if messages else []

    def fail(self, **faults: Callable[[Any], Any]) -> None:
        self.cameras.faults = faults

    def inject(self, **faults: Fault) -> None:
        """Let these cameras have these faults, and all others none."""
        self.cameras.faults = {camera: fault.image for camera, fault in faults.items() if fault.image is not None}
        self.cameras.infos = dict(self.cameras.good_infos)
        for camera, fault in faults.items():
            if fault.info is not None:
                self.cameras.infos[camera] = copy.deepcopy(self.cameras.good_infos[camera])
                fault.info(self.cameras.infos[camera])

    def await_cameras(self, names: list[str]) -> None:
        self.cameras.run_until(lambda: self.contained() == names, f"clouds of {names}")

    def await_state(self, camera: str, text: str) -> DiagnosticStatus:
        def said() -> bool:
            status = self.graph.statuses.get(f"surround_depth: camera {camera}")
            return status is not None and text in status.message

        self.cameras.run_until(said, f"camera {camera} to be '{text}'")
        return self.graph.statuses[f"surround_depth: camera {camera}"]

    def recover(self) -> None:
        self.inject()
        self.await_cameras(list(CAMERAS))
        self.await_state("left", "ok")


@contextmanager
def running_scene(folder: Path) -> Iterator[Scene]:
    """Run a node that publishes all six cameras; its rig and its trace are in `folder`."""
    with closing(RosGraph()) as graph:
        scene = Scene(graph, rig_without_calibrations(folder / "rig.yaml"))
        scene.await_cameras(list(CAMERAS))
        yield scene


def rig_without_calibrations(path: Path) -> Path:
    """Write the sample's rig; calibrations are left to camera_info, so that they can change and be spoiled."""
    with open_recording(recordings.SAMPLE) as recording:
        layout = discover_rig(recording)
    found = {camera.name: camera for camera in layout.cameras}
    cameras = tuple(found[name].model_copy(update={"calibration": None}) for name in CAMERAS)
    save_rig_layout(path, layout.model_copy(update={"cameras": cameras, "anchor": CAMERAS[0]}))
    return path


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec) * SECOND + int(message.header.stamp.nanosec)
