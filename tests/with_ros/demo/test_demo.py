# SPDX-License-Identifier: Apache-2.0
"""The demo as its users meet it: processes over DDS, honest counts, pictures, and nothing left running."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from domains import own_domain
from recordings import CAMERAS, JAZZY

from cvcdepth_core.model_choices import NOTICE
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.end_to_end.received import node_outputs
from cvcdepth_ros.messages.node_report import Latency, read_report

NODE = "/surround_depth"
TIMEOUT = 60.0
SMALL = ("--height", "64", "--width", "96", "--rate", "0.1")

# A node that knows nothing of ours: it tells diagnostics all the time, and publishes once it is subscribed.
PUBLISHER = f"""
import sys, time
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node("surround_depth")
diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
images = node.create_publisher(Image, "{NODE}/front/image_rect", 10)
status = DiagnosticStatus(name="surround_depth: node", hardware_id="{NODE}", message="active")
print("ready", flush=True)
while not images.get_subscription_count():
    diagnostics.publish(DiagnosticArray(status=[status]))
    time.sleep(0.1)
for i in range(20):
    image = Image(height=300, width=400, step=400, encoding="mono8", data=bytes([i]) * 120_000)
    image.header.stamp.sec = i
    images.publish(image)
    images.wait_for_all_acked()
while True:
    diagnostics.publish(DiagnosticArray(status=[status]))
    time.sleep(0.1)
"""


def wait_for(condition: Callable[[], Any], what: str, seconds: float = TIMEOUT) -> Any:
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, f"waited {seconds} s in vain for {what}"
        time.sleep(0.05)
    return value


@pytest.fixture
def environment() -> Iterator[dict[str, str]]:
    with own_domain() as domain:
        yield os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


# The whole demo


@pytest.fixture(scope="module")
def finished_demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, "subprocess.CompletedProcess[str]"]:
    output = tmp_path_factory.mktemp("demo")
    # Slower than this machine would manage alone: the other tests' load comes and goes.
    command = [sys.executable, "-m", "cvcdepth_ros.demo", "--output", str(output), "--rate", "0.05"]
    with own_domain() as domain:
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
        return output, subprocess.run(command, env=environment, capture_output=True, text=True, timeout=150)


def test_every_set_is_sent_matched_published_and_received(finished_demo: Any):
    output, process = finished_demo
    assert process.returncode == 0, process.stdout + process.stderr
    result = json.loads((output / "demo.json").read_text())
    sets = result["node"]["sets"]
    assert (result["sent"], sets["matched"], sets["published"], result["received"]) == (10, 10, 10, 10)
    assert (result["images_sent"], sum(result["node"]["images_lost"].values())) == (60, 0)
    assert result["messages_lost"] == {}
    received = {topic: count for topic, count in result["messages_received"].items() if topic.startswith(NODE)}
    assert set(received.values()) == {10}
    assert len(received) == 3 * len(CAMERAS) + 1


def test_the_table_on_the_terminal_says_what_the_file_says(finished_demo: Any):
    output, process = finished_demo
    result = json.loads((output / "demo.json").read_text())
    lines = [line.split() for line in process.stdout.splitlines()]
    assert ["sets", "received", "complete", "10"] in lines
    inference = result["node"]["latencies"]["inference"]
    assert ["inference", f"{inference['p50_ms']:.1f}", f"{inference['p95_ms']:.1f}"] in lines


def test_without_a_checkpoint_the_packages_own_model_is_shown_and_named(finished_demo: Any):
    output, process = finished_demo
    assert process.stdout.splitlines()[0] == NOTICE
    assert json.loads((output / "demo.json").read_text())["untrained"] is False
    assert "Network: default.safetensors" in (output / "demo.html").read_text()


def test_every_set_has_its_picture_and_none_is_like_another(finished_demo: Any):
    output, _ = finished_demo
    sheets = [cv2.imread(str(path)) for path in sorted((output / "sets").iterdir())]
    assert len(sheets) == 10
    assert {sheet.shape for sheet in sheets} == {sheets[0].shape}
    for one, other in pairwise(sheets):
        assert (one != other).mean() > 0.05


def test_the_page_holds_every_set_and_loads_nothing(finished_demo: Any):
    output, _ = finished_demo
    page = (output / "demo.html").read_text()
    assert page.count('src="data:image/jpeg;base64,') == page.count("src=") == 10
    assert "href" not in page
    assert "://" not in page


def test_the_recording_holds_what_was_published_and_nothing_else(finished_demo: Any):
    output, _ = finished_demo
    with open_recording(output / "recording") as recording:
        outputs = {entry.topic for entry in node_outputs(NODE, CAMERAS, "front")}
        assert recording.topics.keys() == outputs | {"/diagnostics"}
        assert {recording.topics[topic].count for topic in outputs} == {10}
        depth = next(iter(recording.messages([f"{NODE}/left/depth/image_rect"])))
        assert recording.deserialize(depth).encoding == "32FC1"


# Failures, and the end of the processes


class RunningDemo:
    """A demo that has its node running."""

    def __init__(self, output: Path, environment: dict[str, str]) -> None:
        self.output = output
        command = [sys.executable, "-m", "cvcdepth_ros.demo", "--output", str(output), "--untrained", *SMALL]
        self.process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        wait_for(self._node_runs, "the node and the recorder")
        self.children = self._find_children()

    def child(self, module: str) -> int:
        return next(pid for pid, command in self.children.items() if module in command)

    def end(self) -> tuple[int, str]:
        """Return exit code and what was said on stderr; nothing may be left."""
        _, errors = self.process.communicate(timeout=TIMEOUT)
        left = [pid for pid in self.children if Path(f"/proc/{pid}").exists()]
        assert not left, f"still running: {[self.children[pid] for pid in left]}"
        return self.process.returncode, errors

    def _node_runs(self) -> bool:
        assert self.process.poll() is None, self.process.communicate()
        log = self.output / "logs" / "node.log"
        return log.exists() and "model:" in log.read_text() and len(self._find_children()) >= 2

    def _find_children(self) -> dict[int, str]:
        """Command line by pid."""
        found = {}
        for status in Path("/proc").glob("[0-9]*/stat"):
            try:
                parent = int(status.read_text().rpartition(")")[2].split()[1])
                command = (status.parent / "cmdline").read_text().replace("\0", " ")
            except OSError:
                continue  # it has ended meanwhile
            if parent == self.process.pid:
                found[int(status.parent.name)] = command
        return found


@pytest.fixture
def running_demo(tmp_path: Path, environment: dict[str, str]) -> Iterator[RunningDemo]:
    demo = RunningDemo(tmp_path / "demo", environment)
    yield demo
    if demo.process.poll() is None:
        demo.process.terminate()
        demo.process.communicate(timeout=TIMEOUT)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_demo_and_its_processes(running_demo: RunningDemo, number: int, code: int):
    running_demo.process.send_signal(number)
    returned, errors = running_demo.end()
    assert returned == code
    assert "Traceback" not in errors


def test_a_node_that_dies_fails_the_demo_with_its_last_lines(running_demo: RunningDemo):
    os.kill(running_demo.child("surround_depth_node"), signal.SIGKILL)
    returned, errors = running_demo.end()
    assert returned == 1
    assert "demo: node ended with code -9" in errors
    assert (running_demo.output / "logs" / "node.log").read_text().splitlines()[-1] in errors


def test_a_recording_that_is_not_there_is_named(tmp_path: Path):
    command = [sys.executable, "-m", "cvcdepth_ros.demo", "--output", str(tmp_path), "--recording", "/no/such.mcap"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT)
    assert process.returncode == 1
    assert "/no/such.mcap: does not exist" in process.stderr


# The recorder


def start_recorder(output: Path, environment: dict[str, str], *options: str) -> "subprocess.Popen[str]":
    topic = ("--topic", f"{NODE}/front/image_rect", "sensor_msgs/msg/Image")
    command = [sys.executable, "-m", "cvcdepth_ros.end_to_end.recorder", str(output), *topic, *options]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


@pytest.fixture
def publisher(environment: dict[str, str]) -> Iterator[None]:
    command = [sys.executable, "-c", PUBLISHER]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    process.stdout.readline()
    yield
    process.kill()
    process.wait()


@pytest.mark.usefixtures("publisher")
def test_the_recorder_stores_every_message_until_it_is_interrupted(tmp_path: Path, environment: dict[str, str]):
    recorder = start_recorder(tmp_path / "out", environment)
    assert recorder.stdout is not None
    topic = f"{NODE}/front/image_rect"
    for line in recorder.stdout:
        report = json.loads(line)
        if report["received"][topic] == 20:
            break
    assert report["ready"] is True
    recorder.send_signal(signal.SIGINT)
    summary = json.loads(recorder.communicate(timeout=TIMEOUT)[0].splitlines()[-1])
    assert recorder.returncode == 0
    assert summary["received"][topic] == 20
    assert summary["lost"] == {}
    with open_recording(tmp_path / "out") as recording:
        assert recording.damage is None
        assert recording.topics.keys() == {topic, "/diagnostics"}
        images = [recording.deserialize(message) for message in recording.messages([topic])]
    assert [image.header.stamp.sec for image in images] == list(range(20))
    assert all((image.data == i).all() and image.data.size == 120_000 for i, image in enumerate(images))


@pytest.mark.usefixtures("publisher")
def test_the_recorder_ends_by_itself_when_only_diagnostics_come(tmp_path: Path, environment: dict[str, str]):
    recorder = start_recorder(tmp_path / "out", environment, "--idle-seconds", "10")  # discovery takes its time too
    output, _ = recorder.communicate(timeout=TIMEOUT)
    assert recorder.returncode == 0
    assert json.loads(output.splitlines()[-1])["received"][f"{NODE}/front/image_rect"] == 20


def test_the_recorder_refuses_an_unknown_type_and_an_existing_folder(tmp_path: Path, environment: dict[str, str]):
    command = [sys.executable, "-m", "cvcdepth_ros.end_to_end.recorder"]
    for options, text in (
        ([str(tmp_path / "new"), "--topic", "/a", "no_such_msgs/msg/Thing"], "no_such_msgs/msg/Thing"),
        ([str(tmp_path)], "exists already"),
    ):
        process = subprocess.run([*command, *options], env=environment, capture_output=True, text=True, timeout=TIMEOUT)
        assert process.returncode == 1
        assert process.stderr.startswith("recorder: ")
        assert text in process.stderr


# What the node tells


def diagnostics(published: int, matched: int = 10, replaced: int = 0) -> Any:
    """The node's DiagnosticArray, in the words of its diagnostics module."""
    from diagnostic_msgs.msg import DiagnosticArray

    from cvcdepth_ros.live.camera_states import CameraCondition, CameraState, CameraWatch
    from cvcdepth_ros.live.mailbox import MailboxStatistics
    from cvcdepth_ros.node.diagnostics import OK, camera_status, inference_status, status, synchronisation_status
    from cvcdepth_ros.surround_sets.latencies import StageLatencies
    from cvcdepth_ros.surround_sets.synchronizer import CameraStatistics, SynchronizerStatistics

    cameras = {
        name: CameraStatistics(12, 10, 0, {"unmatched": 1, "duplicate_stamp": 1}, 0, 10**8)
        for name in ("front", "back")
    }
    latencies = StageLatencies()
    for milliseconds in (10, 20, 30):
        latencies.record("inference", milliseconds / 1000)
    mailbox = MailboxStatistics(received=matched, delivered=matched - replaced, replaced=replaced)
    counters = {"published": published, "skipped: no subscriber": 0, "refused": 0}
    statuses = [
        status(OK, "node", "active"),
        *(
            camera_status(name, CameraCondition(CameraState.OK), values, CameraWatch(1.0, 1.0), lost=3)
            for name, values in cameras.items()
        ),
        synchronisation_status(SynchronizerStatistics(matched, cameras), mailbox, counters),
        inference_status(latencies.summaries(), mailbox, "", "a model"),
    ]
    for entry in statuses:
        entry.name = f"surround_depth: {entry.name}"
        entry.hardware_id = NODE
    return DiagnosticArray(status=statuses)


def test_the_nodes_diagnostics_are_read_as_it_writes_them():
    report = read_report(diagnostics(published=8, replaced=2), NODE)
    assert report is not None
    assert (report.matched, report.published, report.dropped) == (10, 8, {"replaced": 2})
    assert report.images_lost == {"front": 3, "back": 3}
    assert report.images_dropped == {"unmatched": 2, "duplicate_stamp": 2}
    assert report.latencies == {"inference": Latency(p50_ms=20, p95_ms=29, max_ms=30)}
    assert (report.model, report.error) == ("a model", "")


def test_recorded_diagnostics_are_read_like_live_ones():
    from rclpy.serialization import serialize_message

    live = diagnostics(published=8, replaced=2)
    recorded = JAZZY.deserialize_cdr(serialize_message(live), "diagnostic_msgs/msg/DiagnosticArray")
    assert read_report(recorded, NODE) == read_report(live, NODE)


def test_diagnostics_of_another_node_are_passed_over():
    assert read_report(diagnostics(published=8), "/another") is None


def test_a_set_under_way_is_not_settled():
    settled = {published: read_report(diagnostics(published, replaced=2), NODE) for published in (7, 8)}
    assert [report is not None and report.settled() for report in settled.values()] == [False, True]


def test_what_makes_the_node_useless_is_its_error():
    message = diagnostics(published=0)
    message.status[0].level, message.status[0].message = b"\x02", "no such rig"
    report = read_report(message, NODE)
    assert report is not None
    assert report.error == "no such rig"
