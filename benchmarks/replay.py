# SPDX-License-Identifier: Apache-2.0
"""How fast recordings are evaluated, where the time goes, and whether memory grows with their length.

    .venv/bin/python benchmarks/replay.py [--repeat 1 10] [--height 384 --width 640] [--threads 1]

Each length of the sample, played so many times one after the other, is evaluated in a process of its own, whose peak
memory is that of the whole evaluation; torch alone takes part of it.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cvcdepth_ros.bags import RecordedMessage, Recording, RecordingWriter, open_recording
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.recording import open_evaluation

SAMPLE = Path(__file__).parent.parent / "samples" / "pandaset_002_excerpt"
STEP_NS = 1_000_000_000  # the sample is ten sets, 10 Hz


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path, default=SAMPLE)
    parser.add_argument("--repeat", type=int, nargs="+", default=[1, 10])
    parser.add_argument("--height", type=int, default=384)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measured(arguments.measure, arguments)))
        return
    with tempfile.TemporaryDirectory() as folder:
        for times in arguments.repeat:
            path = repeated(arguments.recording, Path(folder) / f"times_{times}", times)
            command = [sys.executable, __file__, *sys.argv[1:], "--measure", str(path)]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            report(times, json.loads(done.stdout))


def measured(recording: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Evaluate in this process."""
    settings = EvaluationSettings(
        untrained=True, height=arguments.height, width=arguments.width, threads=arguments.threads, device="cpu"
    )
    with open_evaluation(EvaluationJob("benchmark", recording, settings)) as evaluation:
        ready = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        began = time.monotonic()
        scores = evaluation.scores()
        seconds = time.monotonic() - began
        stages = {name: summary.total_s for name, summary in evaluation.latencies.summaries().items()}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "sets": scores.summary["sets"]["scored"],
        "seconds": seconds,
        "ready_mb": ready / 1024,
        "peak_mb": peak / 1024,
        "stages": stages | {"read and match": seconds - sum(stages.values())},
    }


def report(times: int, found: dict[str, Any]) -> None:
    rate = found["sets"] / found["seconds"]
    print(f"{times} x: {found['sets']} sets in {found['seconds']:.1f} s, {rate:.2f} sets/s, ", end="")
    print(f"peak {found['peak_mb']:.0f} MB ({found['ready_mb']:.0f} MB before the first set)")
    for stage, seconds in sorted(found["stages"].items(), key=lambda item: -item[1]):
        print(f"    {stage:15s} {1000 * seconds / found['sets']:7.1f} ms per set  {seconds / found['seconds']:5.1%}")


def repeated(source: Path, path: Path, times: int) -> Path:
    """Write the recording several times one after the other, with later and later stamps."""
    with open_recording(source) as recording, RecordingWriter(path) as writer:
        for topic in recording.topics.values():
            writer.add_topic(topic.name, topic.type, topic.qos or ())
        for number in range(times):
            for message, content in messages(recording, number * STEP_NS):
                writer.write(message.topic, message.log_time + number * STEP_NS, content)
    return path


def messages(recording: Recording, later_ns: int) -> Iterator[tuple[RecordedMessage, Any]]:
    """Give the messages with their stamps moved; fixed transforms come once."""
    for message in recording.messages():
        content = recording.deserialize(message)
        if message.topic == "/tf_static":
            if not later_ns:
                yield message, content
            continue
        for header in [m.header for m in getattr(content, "transforms", [content])]:
            stamp = header.stamp.sec * 10**9 + header.stamp.nanosec + later_ns
            header.stamp.sec, header.stamp.nanosec = divmod(stamp, 10**9)
        yield message, content


if __name__ == "__main__":
    main()
