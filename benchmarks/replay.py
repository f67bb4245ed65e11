# SPDX-License-Identifier: Apache-2.0
"""How fast recordings are evaluated, where the time goes, and whether memory grows with their length.

    .venv/bin/python benchmarks/replay.py [--times 1 10] [--height 192 --width 320] [--rounds 1]

The sample, played so many times one after the other, is evaluated on one CPU thread by `evaluate`, and by what one
writes at first: everything read into lists, pictures undistorted one by one, the same network in eager torch, the
nearest sweep projected, Abs Rel. The latter leaves out what evaluate does beside: occlusion filter, two protocols,
ranges, overlaps, label-free scores. Each run has a process of its own; peak memory is that after the network is there.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from measuring import circumstances, print_line
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from cvcdepth_core.estimator import DepthPredictor
from cvcdepth_core.rig.calibration import Calibration
from cvcdepth_core.rig.pinhole import scale_intrinsics
from cvcdepth_core.rig.poses import Pose, inverse, pose_from_quaternion
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_core.surround_depth import SurroundPictures
from cvcdepth_ros.bags import RecordedMessage, Recording, RecordingWriter, open_recording
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import open_evaluation
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.point_clouds import points_from_message
from cvcdepth_ros.recordings.rig import RecordedRig

SAMPLE = Path(__file__).parent.parent / "samples" / "pandaset_002_excerpt"
STEP_NS = 1_000_000_000  # the sample is ten sets, 10 Hz
LIDAR = "/lidar/points"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path, default=SAMPLE)
    parser.add_argument("--times", type=int, nargs="+", default=[1, 10])
    parser.add_argument("--height", type=int, default=192)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--measure", nargs=2, metavar=("CASE", "RECORDING"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.measure:
        case, recording = arguments.measure
        print(json.dumps(measured(CASES[case], recording, arguments)))
        return
    with tempfile.TemporaryDirectory() as folder:
        for times in arguments.times:
            path = repeated(arguments.recording, Path(folder) / f"times_{times}", times)
            rounds = [{case: in_own_process(case, path) for case in CASES} for _ in range(arguments.rounds)]
            for case in CASES:
                print_line(line(case, times, rounds, arguments))


def in_own_process(case: str, recording: Path) -> dict[str, Any]:
    command = [sys.executable, __file__, *sys.argv[1:], "--measure", case, str(recording)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def line(
    case: str, times: int, rounds: list[dict[str, dict[str, Any]]], arguments: argparse.Namespace
) -> dict[str, Any]:
    own, baseline = ([found[name] for found in rounds] for name in (case, "straightforward"))

    def median(of: Callable[[dict[str, Any]], float]) -> float:
        return statistics.median(map(of, own))

    def ratio(name: str) -> float:
        return statistics.median(b[name] / a[name] for a, b in zip(own, baseline, strict=True))

    shares = {
        f"{stage} %": round(100 * statistics.median(found["stages"][stage] for found in own))
        for stage in own[0]["stages"]
    }
    return {
        "benchmark": "replay",
        "case": f"{case}, {own[0]['sets']} sets",
        "times the sample": times,
        "picture": f"{arguments.height}x{arguments.width}",
        "rounds": len(rounds),
        "median_ms": round(1e3 * median(lambda found: found["seconds"] / found["sets"]), 1),
        "cpu_ms": round(1e3 * median(lambda found: found["cpu_seconds"] / found["sets"]), 1),
        "per_second": round(median(lambda found: found["sets"] / found["seconds"]), 3),
        "baseline": "straightforward",
        "times_baseline": round(ratio("seconds"), 3),
        "times_baseline_cpu": round(ratio("cpu_seconds"), 3),
        "peak_memory_mb": round(median(lambda found: found["peak_mb"])),
        "mb_before_the_first_set": round(median(lambda found: found["ready_mb"])),
        **shares,
        **circumstances(),
        "threads": "1",
    }


def measured(
    case: Callable[[str, EvaluationSettings], Callable[[], dict[str, float]]],
    recording: str,
    arguments: argparse.Namespace,
) -> dict[str, Any]:
    """Evaluate in this process."""
    settings = EvaluationSettings(untrained=True, height=arguments.height, width=arguments.width, device="cpu")
    work = case(recording, settings)
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew, see proc(5)
    ready, wall, cpu = memory_mb("VmRSS"), time.monotonic(), time.process_time()
    stages = work()
    seconds, cpu_seconds = time.monotonic() - wall, time.process_time() - cpu
    sets = int(stages.pop("sets"))
    return {
        "sets": sets,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "ready_mb": ready,
        "peak_mb": memory_mb("VmHWM"),
        "stages": {name: took / seconds for name, took in stages.items()},
    }


def memory_mb(name: str) -> float:
    """Return a value of /proc/self/status in MiB."""
    return int(re.findall(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())[0]) / 1024


def evaluate(recording: str, settings: EvaluationSettings) -> Callable[[], dict[str, float]]:
    """Return what evaluates, and tells the number of sets and the seconds of each stage."""
    opened = ExitStack()
    evaluation = opened.enter_context(open_evaluation(EvaluationJob("benchmark", recording, settings)))

    def work() -> dict[str, float]:
        with opened:
            scores = evaluation.scores()
        stages = {name: summary.total_s for name, summary in evaluation.latencies.summaries().items()}
        return {"sets": scores.summary["sets"]["scored"], **stages}

    return work


def straightforward(recording: str, settings: EvaluationSettings) -> Callable[[], dict[str, float]]:
    """Return what finds Abs Rel as one writes it at first."""
    with open_recording(recording) as opened:
        recorded = RecordedRig.from_recording(opened)
        layout, fixed = recorded.layout, recorded.transforms
        rig = layout.complete()
    network = settings.model_copy(update={"backend": "torch_eager"}).build_estimator()

    def work() -> dict[str, float]:
        messages: dict[str, list[Any]] = defaultdict(list)
        with AnyReader([Path(recording)]) as reader:
            for connection, _, raw in reader.messages():
                messages[connection.topic].append(reader.deserialize(raw, connection.msgtype))
        odom_T_base = {stamp_ns(link): pose_of(link.transform) for m in messages["/tf"] for link in m.transforms}
        errors = []
        anchors = messages[layout.cameras[0].image_topic]
        for anchor in anchors:
            images = [nearest(messages[camera.image_topic], stamp_ns(anchor)) for camera in layout.cameras]
            for image, camera, depth in zip(images, rig.cameras, estimated(images, rig, network), strict=True):
                sweep = nearest(messages[LIDAR], stamp_ns(image))
                base_T_lidar = fixed.lookup(rig.base_frame, sweep.header.frame_id)
                odom_T_camera = odom_T_base[stamp_ns(image)] @ camera.base_T_camera
                camera_T_lidar = inverse(odom_T_camera) @ odom_T_base[stamp_ns(sweep)] @ base_T_lidar
                points = points_from_message(sweep, LIDAR) @ camera_T_lidar[:3, :3].T + camera_T_lidar[:3, 3]
                errors.append(abs_rel(depth, points, camera))
        if not np.isfinite(errors).all():
            raise SystemExit("no truth in some picture")
        return {"sets": len(anchors)}

    return work


def nearest(messages: list[Any], stamp: int) -> Any:
    return min(messages, key=lambda message: abs(stamp_ns(message) - stamp))


def pose_of(transform: Any) -> Pose:
    t, q = transform.translation, transform.rotation
    return pose_from_quaternion((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))


def estimated(images: list[Any], rig: Rig, network: DepthPredictor) -> NDArray[np.float32]:
    size = network.spec.width, network.spec.height
    pictures = []
    for image, camera in zip(images, rig.cameras, strict=True):
        raw = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR_RGB)
        c = camera.calibration
        flat = cv2.undistort(raw, c.raw_intrinsics, c.distortion, None, c.rectified_intrinsics)
        pictures.append(cv2.resize(flat, size, interpolation=cv2.INTER_AREA))
    surround = SurroundPictures(
        pictures=np.stack(pictures),
        present=np.ones(len(pictures), bool),
        intrinsics=np.stack([scaled_intrinsics(camera.calibration, size) for camera in rig.cameras]),
        base_T_camera=np.stack([camera.base_T_camera for camera in rig.cameras]),
        valid=np.ones((len(pictures), size[1], size[0]), bool),
    )
    return network.estimate(surround)


def scaled_intrinsics(calibration: Calibration, size: tuple[int, int]) -> NDArray[np.float64]:
    width, height = calibration.image_size
    return scale_intrinsics(calibration.rectified_intrinsics, (size[0] / width, size[1] / height))


def abs_rel(depth: NDArray[np.float32], points: NDArray[np.float64], camera: Camera) -> float:
    """Compare depth with points [M, 3] in the camera's frame at the pixels where they are seen."""
    width, height = camera.calibration.image_size
    ahead = points[(points[:, 2] > 0) & (points[:, 2] < 80)]
    u, v, z = (ahead @ camera.calibration.rectified_intrinsics.T).T
    column, row = (u / z).round().astype(int), (v / z).round().astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    full = cv2.resize(depth, (width, height))
    return float(np.mean(np.abs(full[row[inside], column[inside]] - z[inside]) / z[inside]))


CASES = {"straightforward": straightforward, "evaluate": evaluate}


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
