# SPDX-License-Identifier: Apache-2.0
"""Record topics as they arrive, byte for byte, into a rosbag2 (MCAP) recording. Nothing else is stored."""

import argparse
import inspect
import json
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from cvcdepth_core.errors import ConfigError, CvcDepthError
from cvcdepth_ros.bags import RecordingWriter
from cvcdepth_ros.messages.conversion import ros_message_class
from cvcdepth_ros.messages.node_report import DIAGNOSTICS_TOPIC, read_report
from cvcdepth_ros.node.qos import SubscriptionEventCallbacks
from cvcdepth_ros.process_setup import prepare_process

# Room for every message of several sets, so that a moment without the processor loses nothing.
_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE)
# Others publish as their drivers did, and a reliable subscription does not match a publisher that is not.
_INPUT_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
_DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"
_SPIN_SECONDS = 0.5
_HAS_MATCHED_EVENTS = "matched" in inspect.signature(SubscriptionEventCallbacks).parameters

_EXAMPLE = """example:
  python -m cvcdepth_ros.end_to_end.recorder OUTPUT --topic /surround_depth/points sensor_msgs/msg/PointCloud2

On /diagnostics, which is always recorded, every report of --node is also printed as one line of JSON: what the node
says of itself, how many messages of each topic have come, and "ready" once no message can be missed any more.
"""


class Recorder(Node):  # type: ignore[misc] # rclpy is not annotated
    """Subscribes topics and writes what arrives; `on_report` is called with each report of the watched node."""

    def __init__(
        self,
        writer: RecordingWriter,
        topics: Mapping[str, str],  # of the watched node, with their types
        inputs: Mapping[str, str],  # others, whose publishers come later
        watched: str,
        on_report: Callable[[dict[str, Any]], None],
    ) -> None:
        super().__init__("demo_recorder")
        self._writer = writer
        self._watched = watched
        self._on_report = on_report
        self._unmatched = set(topics)
        self.received = dict.fromkeys([*topics, *inputs, DIAGNOSTICS_TOPIC], 0)
        self.lost = dict.fromkeys(self.received, 0)
        self.last_message = time.monotonic()
        for topic, type_name in topics.items():
            self._subscribe(topic, type_name, _QOS)
        for topic, type_name in inputs.items():
            self._subscribe(topic, type_name, _INPUT_QOS)
        # Last of all. DDS makes subscriptions known in their order, so whoever reaches this one knows the others.
        self._subscribe(DIAGNOSTICS_TOPIC, _DIAGNOSTICS_TYPE, _QOS)

    def summary(self) -> dict[str, Any]:
        """Return how many messages of each topic have come, and how many were lost of those that lost any."""
        return {"received": self.received, "lost": {topic: count for topic, count in self.lost.items() if count}}

    def _subscribe(self, topic: str, type_name: str, qos: QoSProfile) -> Subscription:
        self._writer.add_topic(topic, type_name)

        def matched(event: Any) -> None:
            if event.current_count:
                self._unmatched.discard(topic)

        def message_lost(event: Any) -> None:
            self.lost[topic] += event.total_count_change

        callbacks = SubscriptionEventCallbacks(message_lost=message_lost)
        callbacks.matched = matched  # not an argument, which ROS 2 Humble does not have

        return self.create_subscription(
            self._message_class(type_name),
            topic,
            partial(self._store, topic),
            qos,
            raw=True,
            event_callbacks=callbacks,
        )

    @staticmethod
    def _message_class(type_name: str) -> Any:
        try:
            return ros_message_class(type_name)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigError(f"message type '{type_name}' is not installed here: {error}") from error

    def _store(self, topic: str, cdr: bytes) -> None:
        self._writer.write(topic, time.time_ns(), cdr)
        self.received[topic] += 1
        if topic == DIAGNOSTICS_TOPIC:
            self._report(cdr)
        else:
            self.last_message = time.monotonic()

    def _report(self, cdr: bytes) -> None:
        """Pass a report of the watched node on, with the counts so far and whether all of its publishers are matched.

        That its message arrived means that its publishers know our subscriptions; together with ours knowing its
        publishers, nothing that it publishes from now on can be missed.
        """
        report = read_report(deserialize_message(cdr, DiagnosticArray), self._watched)
        if not _HAS_MATCHED_EVENTS:
            self._unmatched = {topic for topic in self._unmatched if not self.count_publishers(topic)}
        if report is not None:
            self._on_report({"ready": not self._unmatched, "node": report.model_dump(), **self.summary()})


def record(
    output: Path, topics: Mapping[str, str], inputs: Mapping[str, str], watched: str, idle_seconds: float
) -> dict[str, Any]:
    """Record until SIGINT or SIGTERM, or until nothing but diagnostics came for `idle_seconds`; return the summary."""
    with RecordingWriter(output) as writer:
        recorder = Recorder(writer, topics, inputs, watched, _print_line)
        executor = SingleThreadedExecutor()
        executor.add_node(recorder)
        try:
            while rclpy.ok() and time.monotonic() - recorder.last_message < idle_seconds:
                executor.spin_once(timeout_sec=_SPIN_SECONDS)
        except Exception:
            # A signal invalidates the context at once, also just before rclpy waits with it.
            if rclpy.ok():
                raise
        # A second signal must not cut the file.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        recorder.destroy_node()
    return recorder.summary()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the recorder; return the exit code."""
    options = _parse(arguments)
    prepare_process()
    # rclpy ends the spinning; a KeyboardInterrupt besides could come while rclpy's extension takes a message.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    rclpy.init(args=[])
    try:
        summary = record(options.output, dict(options.topic), dict(options.input), options.node, options.idle_seconds)
    except CvcDepthError as error:
        print(f"recorder: {error}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    _print_line(summary)
    return 0


def _print_line(content: dict[str, Any]) -> None:
    print(json.dumps(content), flush=True)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="recorder", description=__doc__, epilog=_EXAMPLE, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", type=Path, help="folder of the recording; must not exist")
    parser.add_argument("--topic", nargs=2, action="append", default=[], metavar=("NAME", "TYPE"), help="repeatable")
    parser.add_argument(
        "--input", nargs=2, action="append", default=[], metavar=("NAME", "TYPE"), help="as --topic, but not awaited"
    )
    parser.add_argument("--node", default="/surround_depth", help="whose diagnostics are printed [%(default)s]")
    parser.add_argument(
        "--idle-seconds", type=float, default=60.0, help="end when no message came for so long [%(default)s]"
    )
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
