# SPDX-License-Identifier: Apache-2.0
"""`cvcdepth play`: player and subscriber in processes of their own, over real DDS."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import recordings
from domains import own_domain
from recordings import CAMERAS, JAZZY, SAMPLE, Entry
from repository import ROOT
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from cvcdepth_ros.bags import RecordingWriter

pytest.importorskip("rclpy", reason="no ROS in this environment")

PROFILE = ROOT / "config" / "fastdds_large_shm.xml"
STRING = "std_msgs/msg/String"

# Subscribes the topics given as {topic: [type, reliable, latched]} and prints, after a line on its standard input, how
# many messages came, their digests, and what QoS their publisher offered; before that, a line for every message. It
# knows nothing of the player.
SUBSCRIBER = """
import hashlib, importlib, json, sys, threading
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

rclpy.init()
node = rclpy.create_node("subscriber")
found, offered = {}, {}

def listen(topic, type_, reliable, latched):
    package, _, name = type_.split("/")
    qos = QoSProfile(
        depth=100,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    def receive(cdr):
        # DDS notes the padding of the last word in the encapsulation header.
        found[topic].append(hashlib.sha256(cdr[4:] + bytes(-len(cdr) % 4)).hexdigest())
        print("got", topic, flush=True)
        if topic not in offered:
            (publisher,) = node.get_publishers_info_by_topic(topic)
            profile = publisher.qos_profile
            offered[topic] = profile.reliability.name, profile.durability.name
    found[topic] = []
    node.create_subscription(getattr(importlib.import_module(package + ".msg"), name), topic, receive, qos, raw=True)

for topic, options in json.loads(sys.argv[1]).items():
    listen(topic, *options)
print("ready", flush=True)
stop = threading.Event()
threading.Thread(target=lambda: (sys.stdin.readline(), stop.set()), daemon=True).start()
while not stop.is_set():
    rclpy.spin_once(node, timeout_sec=0.1)
for _ in range(100 * len(found)):
    rclpy.spin_once(node, timeout_sec=0)
print(json.dumps({"found": found, "offered": offered}))
"""


class Subscriber:
    """A subscriber in a process of its own."""

    def __init__(self, environment: dict[str, str], topics: dict[str, tuple[str, bool, bool]]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", SUBSCRIBER, json.dumps(topics)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout
        assert self._process.stdout.readline() == "ready\n"

    def await_messages(self, topic: str, count: int) -> None:
        """Wait until so many messages came."""
        while count:
            assert self._process.stdout
            line = self._process.stdout.readline()
            assert line
            count -= line == f"got {topic}\n"

    def pause(self, seconds: float) -> None:
        """Stop the whole process for a moment, its DDS threads too."""
        self._process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        self._process.send_signal(signal.SIGCONT)

    def result(self) -> dict[str, Any]:
        output, _ = self._process.communicate("end\n", timeout=60)
        content: dict[str, Any] = json.loads(output.splitlines()[-1])
        return content

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()


@pytest.fixture
def environment() -> Iterator[dict[str, str]]:
    """A domain of its own for every test; no packet leaves the machine."""
    with own_domain() as domain:
        yield os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE),
            "FASTDDS_DEFAULT_PROFILES_FILE": str(PROFILE),
        }


@contextmanager
def subscribed(environment: dict[str, str], topics: dict[str, tuple[str, bool, bool]]) -> Iterator[Subscriber]:
    subscriber = Subscriber(environment, topics)
    try:
        yield subscriber
    finally:
        subscriber.kill()


def player(environment: dict[str, str], recording: Path, *options: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "cvcdepth_ros.bag_replay", "play", str(recording), "--json", *options],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def play(environment: dict[str, str], recording: Path, *options: str) -> tuple[dict[str, Any], str]:
    """Play to the end; return the result and what was told on stderr."""
    process = player(environment, recording, *options)
    output, errors = process.communicate(timeout=90)
    assert process.returncode == 0, errors
    content: dict[str, Any] = json.loads(output)
    return content, errors


def digests(entries: list[Entry], topic: str) -> list[str]:
    return [digest(entry.cdr) for entry in entries if entry.topic == topic]


def digest(cdr: bytes) -> str:
    return sha256(cdr[4:] + bytes(-len(cdr) % 4)).hexdigest()


def qos(reliability: QosReliability, durability: QosDurability, depth: int = 5) -> Qos:
    unlimited = QosTime(0, 0)
    liveliness = QosLiveliness.AUTOMATIC
    return Qos(QosHistory.KEEP_LAST, depth, reliability, durability, unlimited, unlimited, liveliness, unlimited, False)


def text_entry(topic: str, text: str, log_time: int, profile: Qos) -> Entry:
    message = JAZZY.types[STRING](data=text)
    return Entry(topic, STRING, log_time, bytes(JAZZY.serialize_cdr(message, STRING)), (profile,))


def test_every_image_of_the_sample_arrives_byte_for_byte(environment: dict[str, str]):
    topics = {f"/camera/{name}/image_raw/compressed": "sensor_msgs/msg/CompressedImage" for name in CAMERAS}
    topics |= {f"/camera/{name}/camera_info": "sensor_msgs/msg/CameraInfo" for name in CAMERAS}
    with subscribed(environment, {topic: (type_, True, False) for topic, type_ in topics.items()}) as subscriber:
        result, errors = play(environment, SAMPLE, "--wait-for-subscribers", "30")
        received = subscriber.result()["found"]
    entries = recordings.sample_entries()
    assert {topic: result["published"][topic] for topic in topics} == dict.fromkeys(topics, 10)
    assert {topic: received[topic] for topic in topics} == {topic: digests(entries, topic) for topic in topics}
    assert "no subscriber" not in errors


def test_a_subscriber_that_pauses_loses_no_raw_image(environment: dict[str, str], tmp_path: Path):
    # The publisher may keep one message only, so it has to wait for the subscriber.
    keeps_one = qos(QosReliability.RELIABLE, QosDurability.VOLATILE, depth=1)
    raw = recordings.with_raw_images(recordings.sample_entries(8), "bgr8")
    recording = recordings.write_rosbag2(tmp_path / "raw", (entry._replace(qos=(keeps_one,)) for entry in raw))
    topics = {f"/camera/{name}/image_raw": ("sensor_msgs/msg/Image", True, False) for name in CAMERAS}
    with subscribed(environment, topics) as subscriber:
        process = player(environment, recording, "--topics", *topics, "--wait-for-subscribers", "30")
        subscriber.await_messages("/camera/back/image_raw", 1)
        subscriber.pause(0.8)
        _, errors = process.communicate(timeout=60)
        received = subscriber.result()["found"]
    assert process.returncode == 0, errors
    assert {topic: len(messages) for topic, messages in received.items()} == dict.fromkeys(topics, 8)


def test_topics_are_offered_as_they_were_recorded(environment: dict[str, str], tmp_path: Path):
    reliable, volatile = QosReliability.RELIABLE, QosDurability.VOLATILE
    entries = [
        text_entry("/reliable", "a", 10**9, qos(reliable, volatile)),
        text_entry("/best_effort", "b", 10**9, qos(QosReliability.BEST_EFFORT, volatile)),
        text_entry("/latched", "c", 10**9, qos(reliable, QosDurability.TRANSIENT_LOCAL)),
        text_entry("/unknown", "d", 10**9, qos(reliable, volatile))._replace(qos=()),
    ]
    recording = recordings.write_rosbag2(tmp_path / "recording", entries)
    topics = {entry.topic: (STRING, False, False) for entry in entries}
    with subscribed(environment, topics) as subscriber:
        play(environment, recording, "--wait-for-subscribers", "30")
        assert subscriber.result()["offered"] == {
            "/reliable": ["RELIABLE", "VOLATILE"],
            "/best_effort": ["BEST_EFFORT", "VOLATILE"],
            "/latched": ["RELIABLE", "TRANSIENT_LOCAL"],
            "/unknown": ["RELIABLE", "VOLATILE"],
        }


def test_a_late_subscriber_gets_latched_messages_from_before_the_start(environment: dict[str, str], tmp_path: Path):
    latched = qos(QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, depth=1)
    volatile = qos(QosReliability.RELIABLE, QosDurability.VOLATILE)
    entries = [text_entry("/map", part, 10**9, latched) for part in ("part one", "part two")]
    entries += [text_entry("/beat", str(second), second * 10**9, volatile) for second in range(1, 60)]
    recording = recordings.write_rosbag2(tmp_path / "recording", entries)
    process = player(environment, recording, "--start", "2")
    try:
        assert process.stdout
        with subscribed(environment, {"/map": (STRING, True, True), "/beat": (STRING, True, False)}) as subscriber:
            subscriber.await_messages("/beat", 2)
            received = subscriber.result()["found"]
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(10)
    assert received["/map"] == digests(entries, "/map")


def test_simulated_time_is_told_before_each_message(environment: dict[str, str]):
    clock = {"/clock": ("rosgraph_msgs/msg/Clock", True, False), "/odom": ("nav_msgs/msg/Odometry", True, False)}
    with subscribed(environment, clock) as subscriber:
        result, _ = play(
            environment, SAMPLE, "--clock", "--topics", "/odom", "--rate", "2", "--wait-for-subscribers", "30"
        )
        received = subscriber.result()["found"]
    times = [entry.log_time for entry in recordings.sample_entries() if entry.topic == "/odom"]
    told = {clock_digest(time) for time in times}
    assert result["published"] == {"/odom": len(times)}
    assert told <= set(received["/clock"])
    assert len(received["/clock"]) > len(times)


def clock_digest(log_time: int) -> str:
    seconds, nanoseconds = divmod(log_time, 10**9)
    time = JAZZY.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    type_ = "rosgraph_msgs/msg/Clock"
    return digest(bytes(JAZZY.serialize_cdr(JAZZY.types[type_](clock=time), type_)))


def test_topics_that_cannot_be_published_are_named_once_and_left_out(environment: dict[str, str], tmp_path: Path):
    type_ = "made_up_msgs/msg/Thing"
    with RecordingWriter(tmp_path / "recording") as writer:
        writer.add_topic("/thing", type_, definition="uint8 x")
        writer.add_topic("/text", STRING)
        writer.add_topic("/2d_lidar/text", STRING)
        for time in range(1, 4):
            writer.write("/2d_lidar/text", time * 10**8, JAZZY.types[STRING](data="hello"))
            writer.write("/thing", time * 10**8, b"\x00\x01\x00\x00\x07")
            writer.write("/text", time * 10**8, JAZZY.types[STRING](data="hello"))
    result, errors = play(environment, tmp_path / "recording")
    assert result["published"] == {"/text": 3}
    assert result["skipped"] == {
        "/thing": f"no message package is installed for {type_}",
        "/2d_lidar/text": "no topic of ROS 2 may be called so",
    }
    assert errors.count("/thing") == 1


@pytest.mark.parametrize("loop", [(), ("--loop",)])
def test_a_part_without_messages_is_an_error(loop: tuple[str, ...], environment: dict[str, str]):
    arguments = [sys.executable, "-m", "cvcdepth_ros.bag_replay", "play", str(SAMPLE), "--start", "100", *loop]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "no message of these topics between --start and --duration" in done.stderr


def test_a_ros1_recording_is_played_as_ros2_messages(environment: dict[str, str], tmp_path: Path):
    recording = recordings.ros1_copy(tmp_path / "sample.bag", 2)
    topic = "/camera/left/image_raw/compressed"
    with subscribed(environment, {topic: ("sensor_msgs/msg/CompressedImage", True, False)}) as subscriber:
        play(environment, recording, "--wait-for-subscribers", "30", "--topics", topic)
        received = subscriber.result()["found"][topic]
    assert received == digests(recordings.sample_entries(2), topic)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_loop_begins_again_until_a_signal_ends_it(number: signal.Signals, environment: dict[str, str]):
    topic = "/camera/front/camera_info"
    with subscribed(environment, {topic: ("sensor_msgs/msg/CameraInfo", True, False)}) as subscriber:
        process = player(environment, SAMPLE, "--loop", "--rate", "5", "--topics", topic)
        try:
            subscriber.await_messages(topic, 15)
            process.send_signal(number)
            output, errors = process.communicate(timeout=10)
        finally:
            process.kill()
        received = Counter(subscriber.result()["found"][topic])
    assert process.returncode == 0, errors
    result = json.loads(output)
    assert result["interrupted"]
    assert result["published"][topic] > 10
    assert max(received.values()) > 1


def test_an_unknown_topic_is_named(environment: dict[str, str]):
    process = player(environment, SAMPLE, "--topics", "/odometry")
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    (line,) = errors.splitlines()
    assert "no topic /odometry" in line


def test_a_recording_that_is_not_there_is_named(environment: dict[str, str], tmp_path: Path):
    process = player(environment, tmp_path / "gone.mcap")
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    (line,) = errors.splitlines()
    assert "gone.mcap: does not exist" in line


def test_the_readmes_command_plays_the_sample(environment: dict[str, str]):
    (command,) = re.findall(r"^cvcdepth (play .*)$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    words = [sys.executable, "-m", "cvcdepth_ros.bag_replay", *shlex.split(command)]
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
