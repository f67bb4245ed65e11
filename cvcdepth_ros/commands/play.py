# SPDX-License-Identifier: Apache-2.0
"""`play`: publish a recording on its own topics in real time."""

import argparse
import signal
import time
from typing import TYPE_CHECKING, Any

from cvcdepth_core.errors import ConfigError, RecordingError
from cvcdepth_ros.commands.arguments import add_json, add_recording, add_window, window_ns
from cvcdepth_ros.console import non_negative, positive, print_result, table, warn

if TYPE_CHECKING:
    from cvcdepth_ros.bags import Recording
    from cvcdepth_ros.node.player import RecordingPlayer

SUMMARY = """Publish a recording on its own topics in real time, with the QoS it was recorded with.

Needs rclpy, not rosbag2. Latched topics (/tf_static) are there for subscribers that come later, reliable topics lose
nothing. Ctrl-C ends it at once."""
EXAMPLES: tuple[str, ...] = (
    "play drive.mcap --wait-for-subscribers 20",
    "play drive/ --rate 0.5 --start 10 --duration 5 --loop --clock",
    "play drive/ --topics /camera/front/image_raw/compressed /camera/front/camera_info",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recording(parser)
    add_window(parser)
    parser.add_argument("--rate", type=positive, default=1.0, metavar="R", help="how many times real time [1]")
    parser.add_argument("--loop", action="store_true", help="begin again at the end, until interrupted")
    parser.add_argument(
        "--clock", action="store_true", help="publish the recording's time on /clock (for use_sim_time)"
    )
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="play these topics only [all]")
    parser.add_argument(
        "--wait-for-subscribers",
        type=non_negative,
        default=0.0,
        metavar="S",
        help="wait until every image topic has a subscriber, S seconds at most [0]",
    )
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Play until the end or until interrupted."""
    from cvcdepth_ros.bags import open_recording
    from cvcdepth_ros.process_setup import prepare_process

    prepare_process()
    rclpy = _import_rclpy()
    with open_recording(arguments.recording) as recording:
        rclpy.init(args=[], signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        try:
            # Also SIGINT: a shell starts its background jobs with that one ignored.
            _on_signals(signal.default_int_handler)
            result = _play(recording, arguments)
        finally:
            rclpy.shutdown()
        for note in recording.notes:
            warn(note)
        if recording.damage:
            warn(f"not everything could be read: {recording.damage}")
    print_result(result, _text(result), arguments.json)


def _play(recording: "Recording", arguments: argparse.Namespace) -> dict[str, Any]:
    from cvcdepth_ros.node.player import RecordingPlayer

    interrupted = False
    with RecordingPlayer(recording, arguments.topics, arguments.clock) as player:
        if player.skipped:
            warn(f"not played: {', '.join(f'{topic} ({reason})' for topic, reason in player.skipped.items())}")
        began = time.monotonic()
        try:
            _await_subscribers(player, arguments.wait_for_subscribers)
            began = time.monotonic()
            _play_through(player, recording, arguments)
        except KeyboardInterrupt:
            interrupted = True
            _on_signals(signal.SIG_IGN)  # `ros2 launch` may deliver one twice
        return _result(player, recording, time.monotonic() - began, interrupted)


def _await_subscribers(player: "RecordingPlayer", seconds: float) -> None:
    missing = player.wait_for_subscribers(seconds) if seconds else []
    if missing:
        warn(f"no subscriber after {seconds:g} s on {', '.join(missing)}; playing anyway")


def _play_through(player: "RecordingPlayer", recording: "Recording", arguments: argparse.Namespace) -> None:
    start, stop = window_ns(arguments, recording.start)
    player.play(start, stop, arguments.rate)
    if not player.statistics.lateness:
        raise RecordingError(f"{recording.path}: no message of these topics between --start and --duration")
    while arguments.loop:
        player.play(start, stop, arguments.rate)
    player.finish()


def _result(player: "RecordingPlayer", recording: "Recording", seconds: float, interrupted: bool) -> dict[str, Any]:
    import numpy as np

    statistics = player.statistics
    late_ms = 1e3 * np.percentile(statistics.lateness or [0.0], [50, 95, 100])
    return {
        "recording": str(recording.path),
        "published": dict(statistics.published),
        "skipped": player.skipped,
        "unacknowledged": dict(statistics.unacknowledged),
        "late_ms": dict(zip(("p50", "p95", "max"), late_ms.round(2).tolist(), strict=True)),
        "seconds": round(seconds, 3),
        "interrupted": interrupted,
    }


def _text(result: dict[str, Any]) -> str:
    rows = [(topic, str(count)) for topic, count in result["published"].items()]
    late = result["late_ms"]
    lines = [
        table(("topic", "messages"), rows, apart=0),
        f"{sum(result['published'].values())} messages in {result['seconds']:.1f} s"
        f"{' until interrupted' if result['interrupted'] else ''}; late by {late['p50']} ms at the median, "
        f"{late['p95']} ms p95, {late['max']} ms at most",
        *(f"{topic}: a subscriber did not follow, {n} times" for topic, n in result["unacknowledged"].items()),
    ]
    return "\n".join(lines)


def _on_signals(handler: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def _import_rclpy() -> Any:
    try:
        import rclpy
        import rclpy.signals
    except ImportError as error:
        raise ConfigError(
            f"play publishes over ROS 2, but rclpy cannot be imported ({error}): source a ROS 2 installation, or "
            "install this package with its extra ros-jazzy"
        ) from error
    return rclpy
