# SPDX-License-Identifier: Apache-2.0
"""`inspect`: tell what is in recordings."""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

from cvcdepth_core.errors import CvcDepthError, RecordingError
from cvcdepth_ros.commands.arguments import (
    add_json,
    add_quiet,
    add_recordings,
    add_window,
    recording_progress,
    window_ns,
)
from cvcdepth_ros.console import print_result, table, warn

if TYPE_CHECKING:
    from cvcdepth_ros.bags import Location
    from cvcdepth_ros.recordings.summary import CameraSummary, IndexState, RecordingSummary, TopicSummary

SUMMARY = """Tell what is in recordings: topics, rates, gaps, clocks, cameras, damage.

Every message is read, so that damage shows; --start and --duration take a part. Times are those of the header stamps
where a type has one: gap is the largest interval, gaps how many exceed twice the median, jitter how far 95 % of the
intervals keep to the median, clock by how much later messages are recorded than stamped (median)."""
EXAMPLES: tuple[str, ...] = (
    "inspect drive.mcap",
    "inspect drives/ 'archive/*/*.db3' --json",
    "inspect s3://fleet/2026/drive.mcap --start 60 --duration 5",
)

_TRANSFORMS = "/tf"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recordings(parser)
    add_window(parser)
    add_quiet(parser)
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Describe each recording; RecordingError at the end when one could not be read."""
    from cvcdepth_ros.bags import find_recordings

    summaries, failures = [], []
    for location in find_recordings(arguments.recordings):
        try:
            summaries.append(_summary(location, arguments))
        except CvcDepthError as error:
            failures.append(str(error))
    result = {"recordings": [_json(summary) for summary in summaries], "failed": failures}
    if summaries or arguments.json:
        print_result(result, "\n\n".join(_text(summary) for summary in summaries), arguments.json)
    for failure in failures[:-1]:
        warn(failure)
    if failures:
        raise RecordingError(failures[-1])


def _summary(location: "Location", arguments: argparse.Namespace) -> "RecordingSummary":
    from cvcdepth_ros.bags import open_recording
    from cvcdepth_ros.recordings.summary import summarize

    with open_recording(location) as recording:
        window = window_ns(arguments, recording.start)
        with recording_progress(recording, window, arguments.quiet) as progress:
            # Without --start, also what was recorded before the clock was set.
            return summarize(recording, window[0] if arguments.start else None, window[1], progress)


def _json(summary: "RecordingSummary") -> dict[str, Any]:
    content = asdict(summary) | {"index": summary.index}
    for camera, stored in zip(summary.cameras, content["cameras"], strict=True):
        stored["calibration"] = camera.calibration.model_dump(mode="json") if camera.calibration else None
    for topic in content["topics"]:
        clock = topic["timing"]["clock_offset"]
        topic["timing"]["clock_offset"] = clock._asdict() if clock else None
    return content


def _text(summary: "RecordingSummary") -> str:
    parts = [_headline(summary), *_damage(summary), "", _topics(summary.topics), "", _cameras(summary.cameras)]
    return "\n".join(parts)


def _headline(summary: "RecordingSummary") -> str:
    begin = datetime.fromtimestamp(summary.start / 1e9, timezone.utc)
    size, files = sum(file.bytes for file in summary.files), len(summary.files)
    messages = sum(topic.timing.messages for topic in summary.topics)
    return (
        f"{summary.path}\n"
        f"  {begin:%Y-%m-%d %H:%M:%S} UTC, {_seconds(summary.seconds)}, {messages} messages, {_bytes(size)}"
        f"{f' in {files} files' if files > 1 else ''}; {_INDEX[summary.index]}"
    )


_INDEX: dict["IndexState", str] = {
    "intact": "index intact",
    "rebuilt": "no index, rebuilt by reading the file through",
    "damaged": "damaged:",
}


def _damage(summary: "RecordingSummary") -> Iterable[str]:
    damage = [f"  {part}" for part in (summary.damage or "").split("; ") if part]
    return [*damage, *(f"  note: {note}" for note in summary.notes)]


def _topics(topics: Sequence["TopicSummary"]) -> str:
    header = ("topic", "type", "messages", "Hz", "gap ms", "gaps", "jitter ms", "clock ms", "size")
    rows = [_topic_row(topic) for topic in topics]
    return "\n".join([table(header, rows, numbers=range(2, len(header)), apart=0), *_odd_stamps(topics)])


def _odd_stamps(topics: Sequence["TopicSummary"]) -> Iterator[str]:
    for topic in topics:
        timing = topic.timing
        for count, what in ((timing.steps_back, "step back"), (timing.repeated, "repeat")):
            # One message of /tf has the transforms of one sender; stamps of several senders need not ascend.
            if count and topic.name != _TRANSFORMS:
                yield f"  {topic.name}: {count} of {timing.messages} stamps {what}"


def _topic_row(topic: "TopicSummary") -> tuple[str, ...]:
    timing = topic.timing
    several = timing.messages > 1
    clock = timing.clock_offset
    return (
        topic.name,
        topic.type.rpartition("/")[2],
        str(timing.messages),
        "" if timing.rate is None else f"{timing.rate:.1f}",
        _milliseconds(timing.largest_gap),
        str(timing.gaps) if several else "",
        _milliseconds(timing.jitter),
        _milliseconds(clock.median) if clock else "no stamp",
        _bytes(timing.bytes),
    )


def _cameras(cameras: Sequence["CameraSummary"]) -> str:
    if not cameras:
        return "no cameras: a camera is a namespace with a camera_info and an image topic"
    rows = [_camera_row(camera) for camera in cameras]
    problems = [f"  {camera.problem}" for camera in cameras if camera.problem]
    problems += [f"  camera {camera.name}: camera_info: {note}" for camera in cameras for note in camera.notes]
    header = ("camera", "size", "distortion", "frame", "images")
    return "\n".join([table(header, rows, apart=len(header) - 1), *problems])


def _camera_row(camera: "CameraSummary") -> tuple[str, ...]:
    calibration = camera.calibration
    if calibration is None:
        size, distortion = "?", "?"
    else:
        size = "{}x{}".format(*calibration.image_size)
        distortion = calibration.distortion_model if any(calibration.d) else "none"
    return (camera.name, size, distortion, camera.frame_id or "?", _pictures(camera.encoding or "none readable"))


def _pictures(encoding: str) -> str:
    """Return image_transport's `bgr8; jpeg compressed bgr8` in two words; other encodings as they are."""
    raw, _, packed = encoding.partition("; ")
    return f"{packed.split()[0]} {raw}" if packed.endswith(f" compressed {raw}") else encoding


def _milliseconds(seconds: float | None) -> str:
    if seconds is None:
        return ""
    milliseconds = 1e3 * seconds
    return f"{milliseconds:.0f}" if abs(milliseconds) >= 100 else f"{milliseconds:.1f}"


def _seconds(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02} h"


def _bytes(size: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"
