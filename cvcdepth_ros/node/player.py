# SPDX-License-Identifier: Apache-2.0
"""Publish a recording on its own topics in real time. Needs rclpy; call `prepare_process` before importing this.

Messages go out as the bytes that were recorded, never unpacked. A reliable publisher of large messages waits, before
each, until its last one was acknowledged: then neither its history nor the shared-memory segment overflows, and nothing
is lost however slow a subscriber is. Small messages do not wait: those that FastDDS sends in one piece it may ask to be
acknowledged only with its next heartbeat, seconds later (measured: 5 ms for 66 kB, up to 3 s for 65 kB).
"""

import time
from collections import Counter, deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosReliability
from rosgraph_msgs.msg import Clock

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags import RecordedMessage, Recording, Topic
from cvcdepth_ros.messages.camera_discovery import RECORDED_IMAGE_TYPES
from cvcdepth_ros.messages.conversion import ros_message_class

CLOCK_TOPIC = "/clock"

_DEFAULT_DEPTH = 100
_CLOCK_PERIOD = 0.02  # s of wall time
_LARGE_MESSAGE = 66_000  # bytes; above, FastDDS sends a message in fragments
_ACKNOWLEDGE_SECONDS = 3.0
_LAST_ACKNOWLEDGE_SECONDS = 5.0
_WAIT_SECONDS = 0.1
_SETTLING_SECONDS = 0.5
_LATENESS_WINDOW = 100_000


@dataclass
class PlayStatistics:
    """Counts and delays of what was published."""

    published: Counter[str] = field(default_factory=Counter)
    """Messages per topic."""
    unacknowledged: Counter[str] = field(default_factory=Counter)
    """Per topic, how often a subscriber had not acknowledged a large message in time."""
    lateness: deque[float] = field(default_factory=lambda: deque(maxlen=_LATENESS_WINDOW))
    """Seconds between due time and publication of the last messages."""


class RecordingPlayer:
    """A node that publishes a recording's topics. Use it as a context manager, between rclpy's init and shutdown."""

    def __init__(self, recording: Recording, topics: Collection[str] | None = None, clock: bool = False) -> None:
        """Advertise `topics` (all by default) with the QoS they were recorded with, and `/clock` if wanted.

        RecordingError when a topic is not in the recording, or nothing is left that could be published.
        """
        self._recording = recording
        self.statistics = PlayStatistics()
        self._stalled: set[str] = set()
        self.skipped: dict[str, str] = {}
        """Topic -> why it cannot be published."""
        self._node = rclpy.create_node("bag_replay", enable_rosout=False, start_parameter_services=False)
        self._clock = self._node.create_publisher(Clock, CLOCK_TOPIC, _DEFAULT_DEPTH) if clock else None
        self._publishers = dict(self._advertise(_chosen(recording, topics, clock)))
        if not self._publishers:
            reasons = ", ".join(sorted(set(self.skipped.values())))
            raise RecordingError(f"{recording.path}: nothing to play: {reasons}")

    def __enter__(self) -> "RecordingPlayer":
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()

    def wait_for_subscribers(self, seconds: float) -> list[str]:
        """Wait until every image topic (without any: every topic) has a subscriber; return those that have none."""
        types = {name: self._recording.topics[name].type for name in self._publishers}
        awaited = [name for name, type_ in types.items() if type_ in RECORDED_IMAGE_TYPES]
        deadline = time.monotonic() + seconds
        while missing := [t for t in awaited or self._publishers if not self._publishers[t].get_subscription_count()]:
            if time.monotonic() > deadline:
                return missing
            time.sleep(0.02)
        time.sleep(_SETTLING_SECONDS)  # the subscribers must find us, too
        return []

    def play(self, start: int, stop: int | None, rate: float) -> None:
        """Publish the messages with start <= log_time < stop (ns), `rate` times as fast as they were recorded.

        Latched topics (/tf_static) begin with what was recorded of them before `start`.
        """
        for message in self._recording.messages(self._latched(), stop=start):
            self._publish(message)
        began = time.monotonic()
        for message in self._recording.messages(self._publishers, start, stop):
            due = began + (message.log_time - start) / NANOSECONDS / rate
            self._sleep_until(due, message.log_time, rate)
            self._publish(message)
            self.statistics.lateness.append(time.monotonic() - due)

    def finish(self) -> None:
        """Wait until the last messages have arrived."""
        deadline = time.monotonic() + _LAST_ACKNOWLEDGE_SECONDS
        for publisher in self._publishers.values():
            _acknowledged(publisher, deadline - time.monotonic())

    def _advertise(self, topics: list[Topic]) -> Iterator[tuple[str, Publisher]]:
        for topic in topics:
            try:
                message_class = ros_message_class(topic.type)
                publisher = self._node.create_publisher(message_class, topic.name, offered_qos(topic))
            except (ImportError, AttributeError):
                self.skipped[topic.name] = f"no message package is installed for {topic.type}"
            except (InvalidTopicNameException, ValueError):  # ROS 1 lets parts of names begin with digits
                self.skipped[topic.name] = "no topic of ROS 2 may be called so"
            else:
                yield topic.name, publisher

    def _latched(self) -> list[str]:
        latched = DurabilityPolicy.TRANSIENT_LOCAL
        return [name for name, publisher in self._publishers.items() if publisher.qos_profile.durability == latched]

    def _publish(self, message: RecordedMessage) -> None:
        publisher = self._publishers[message.topic]
        if len(message.cdr) > _LARGE_MESSAGE:
            self._wait_until_acknowledged(message.topic, publisher)
        publisher.publish(bytes(message.cdr))
        self.statistics.published[message.topic] += 1

    def _wait_until_acknowledged(self, topic: str, publisher: Publisher) -> None:
        """Wait for subscribers to take large messages, but not again for one that hangs or was killed."""
        if _acknowledged(publisher, 0.0 if topic in self._stalled else _ACKNOWLEDGE_SECONDS):
            self._stalled.discard(topic)
        else:
            self._stalled.add(topic)
            self.statistics.unacknowledged[topic] += 1

    def _sleep_until(self, due: float, log_time: int, rate: float) -> None:
        """Sleep until `due`, and publish simulated time meanwhile and at the end."""
        while (remaining := due - time.monotonic()) > 0:
            self._tell_time(log_time - round(remaining * rate * NANOSECONDS))
            time.sleep(min(remaining, _CLOCK_PERIOD))
        self._tell_time(log_time)

    def _tell_time(self, log_time: int) -> None:
        if self._clock is not None:
            message: Any = Clock()
            message.clock.sec, message.clock.nanosec = divmod(log_time, NANOSECONDS)
            self._clock.publish(message)


def offered_qos(topic: Topic) -> QoSProfile:
    """Return the QoS to publish a topic with: as recorded, else reliable with the last 100 messages kept.

    Of several recorded publishers' profiles the one that satisfies the most subscribers is made. Deadline, lifespan and
    liveliness are left out: at another rate they would be broken. `/tf_static` is always latched.
    """
    profiles = topic.qos or ()
    is_latched = topic.name == "/tf_static" or any(p.durability == QosDurability.TRANSIENT_LOCAL for p in profiles)
    best_effort = bool(profiles) and all(p.reliability == QosReliability.BEST_EFFORT for p in profiles)
    keeps_all = any(p.history == QosHistory.KEEP_ALL for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if keeps_all else HistoryPolicy.KEEP_LAST,
        depth=_depth(profiles, is_latched),
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE,
    )


def _depth(profiles: Sequence[Qos], is_latched: bool) -> int:
    """Return how many messages to keep; a latched topic had a publisher for each transform, and now has one for all."""
    recorded = max((p.depth for p in profiles if p.history == QosHistory.KEEP_LAST), default=0)
    return max(recorded, _DEFAULT_DEPTH) if is_latched else recorded or _DEFAULT_DEPTH


def _chosen(recording: Recording, topics: Collection[str] | None, clock: bool) -> list[Topic]:
    unknown = sorted(set(topics or ()) - recording.topics.keys())
    if unknown:
        raise RecordingError(f"{recording.path}: no topic {', '.join(unknown)}; it has {', '.join(recording.topics)}")
    wanted = recording.topics if topics is None else topics
    # Two sources of time would contradict each other.
    return [topic for name, topic in recording.topics.items() if name in wanted and not (clock and name == CLOCK_TOPIC)]


def _acknowledged(publisher: Publisher, seconds: float) -> bool:
    """Return whether all messages were acknowledged within `seconds`."""
    # In short turns: a signal is only noticed between them.
    deadline = time.monotonic() + seconds
    while not publisher.wait_for_all_acked(Duration(seconds=min(max(deadline - time.monotonic(), 0.0), _WAIT_SECONDS))):
        if time.monotonic() >= deadline:
            return False
    return True
