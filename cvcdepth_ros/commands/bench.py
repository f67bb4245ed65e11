# SPDX-License-Identifier: Apache-2.0
"""`bench`: measure the live node on a recording, over DDS, against the baseline node; or the engines alone."""

import argparse
import json
import os
import platform
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvcdepth_core.errors import EngineError, RecordingError
from cvcdepth_ros.commands.arguments import add_recording, add_rig, add_settings, rig_layout, settings_from
from cvcdepth_ros.console import count, positive, print_result, table
from cvcdepth_ros.installation import package_version, require_ros
from cvcdepth_ros.process_setup import prepare_long_work
from cvcdepth_ros.settings import ModelSettings

if TYPE_CHECKING:
    from cvcdepth_core.engines.measuring import EngineTimes
    from cvcdepth_core.rig.rig_file import RigLayout
    from cvcdepth_ros.end_to_end.live_run import LiveOutcome
    from cvcdepth_ros.end_to_end.paths import DemoPaths

SUMMARY = """Measure the live node on a recording, over DDS, against the baseline node; or the engines alone.

BAG: player, node and subscriber are processes of their own. The baseline is measured in the same run: a node that
decodes, estimates (PyTorch, operation by operation) and publishes one set after the other. Prints one line of JSON. A
rate at which sets are dropped measures throughput, one at which none is measures latency. Needs rclpy.

`engines` in the place of BAG: what every engine that is installed takes for six cameras of this network, and which one
`auto` takes. (A recording of that name is ./engines.)"""
EXAMPLES: tuple[str, ...] = (
    "bench drive/ --checkpoint model.safetensors",
    "bench drive/ --untrained --height 192 --width 320 --seconds 10 --rate 2",
    "bench engines --checkpoint model.safetensors --threads 2",
)

_ENGINES = "engines"

_NODE = "/surround_depth"
_NODES = {"baseline": "cvcdepth_ros.bench.baseline_node", "node": "cvcdepth_ros.surround_depth_node"}
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recording(parser)
    add_rig(parser, "the cameras found in the recording")
    add_settings(parser, ModelSettings)
    parser.add_argument("--seconds", type=positive, default=10.0, metavar="S", help="recorded seconds to play [10]")
    parser.add_argument("--rate", type=positive, default=1.0, metavar="R", help="how many times real time [1]")
    parser.add_argument("--no-baseline", action="store_true", help="leave the baseline node out")
    parser.add_argument("--threads", type=count, metavar="N", help="engines: CPU threads [as many as PyTorch takes]")
    parser.add_argument("--sets", type=count, default=10, metavar="N", help="engines: sets to measure [10]")
    parser.add_argument("--json", action="store_true", help="engines: print the result as one JSON document")


def execute(arguments: argparse.Namespace) -> None:
    """Measure and print."""
    if arguments.recording == _ENGINES:
        _measure_engines(arguments)
    else:
        _measure_nodes(arguments)


def _measure_engines(arguments: argparse.Namespace) -> None:
    import torch

    from cvcdepth_core.engines import resolve_device
    from cvcdepth_core.engines.measuring import measure_engines

    model = settings_from(arguments, ModelSettings)
    prepare_long_work()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    network, spec = model.build_network()
    device = resolve_device(model.device)
    found = measure_engines(network, spec, device, model.precision, arguments.sets)
    best = next((engine.backend for engine in found if not engine.problem), None)
    if best is None:
        raise EngineError(found[0].problem)
    result = {
        "benchmark": "bench engines",
        "version": package_version(),
        "machine": _machine(),
        "network": spec.kind,
        "size": f"{spec.height}x{spec.width}",
        "device": str(device),
        "threads": torch.get_num_threads(),
        "auto": best,
        "engines": [_times(one) for one in found],
    }
    print_result(result, _engine_text(result), arguments.json)


def _times(engine: "EngineTimes") -> dict[str, Any]:
    if engine.problem:
        return {"backend": engine.backend, "problem": engine.problem}
    return {
        "backend": engine.backend,
        "engine": engine.name,
        "ready_s": round(engine.ready_seconds, 2),
        "median_ms": round(engine.wall_ms, 2),
        "cpu_ms": round(engine.cpu_ms, 2),
    }


def _engine_text(result: dict[str, Any]) -> str:
    usable = [engine for engine in result["engines"] if "engine" in engine]
    rows = [
        (engine["engine"], *(f"{engine[name]:.1f}" for name in ("ready_s", "median_ms", "cpu_ms"))) for engine in usable
    ]
    return "\n".join(
        [
            f"{result['network']} {result['size']}, six cameras, {result['device']}, {result['threads']} threads",
            table(("engine", "ready s", "ms per set", "CPU ms"), rows, numbers=(1, 2, 3)),
            *(f"{engine['backend']}: {engine['problem']}" for engine in result["engines"] if "problem" in engine),
            f"auto takes {result['auto']}",
        ]
    )


def _measure_nodes(arguments: argparse.Namespace) -> None:
    from cvcdepth_ros.bags import open_recording
    from cvcdepth_ros.end_to_end.repeated_recording import write_repeated
    from cvcdepth_ros.recordings.ground import with_ground
    from cvcdepth_ros.recordings.rig import RecordedRig

    model = settings_from(arguments, ModelSettings)
    require_ros("bench")
    with tempfile.TemporaryDirectory(prefix="cvcdepth_bench_") as folder, open_recording(arguments.recording) as source:
        given = rig_layout(arguments)
        recorded, _ = with_ground(RecordedRig.from_recording(source, given, arguments.base_frame))
        layout = recorded.layout if given is None else recorded.completed().layout
        played = Path(folder) / "played"
        write_repeated(source, layout, played, arguments.seconds)
        names = ["node"] if arguments.no_baseline else list(_NODES)
        found = {name: _measure(Path(folder), name, played, layout, model, arguments) for name in names}
    print(json.dumps(_result(arguments, model, found)))


def _measure(
    folder: Path, name: str, played: Path, layout: "RigLayout", model: ModelSettings, arguments: argparse.Namespace
) -> dict[str, Any]:
    """Run one of the nodes."""
    from cvcdepth_core.rig.rig_file import save_rig_layout
    from cvcdepth_ros.end_to_end.live_run import LiveRun
    from cvcdepth_ros.end_to_end.paths import DemoPaths
    from cvcdepth_ros.end_to_end.processes import children
    from cvcdepth_ros.end_to_end.received import node_outputs

    paths = DemoPaths(folder / name)
    paths.prepare()
    save_rig_layout(paths.rig, layout)
    backend = {"backend": "torch_eager"} if name == "baseline" else {}
    _write_parameters(paths, model.model_copy(update=backend))
    outputs = node_outputs(_NODE, layout.names, layout.anchor_camera)
    info = next(c.camera_info_topic for c in layout.cameras if c.name == layout.anchor_camera)
    with children(paths.logs) as family:
        live = LiveRun(family, paths, _NODE, _NODES[name], {info: _CAMERA_INFO})
        outcome = live.play(played, arguments.rate, arguments.seconds, outputs)
    return _figures(paths, layout.anchor_camera, info, outcome)


def _write_parameters(paths: "DemoPaths", model: ModelSettings) -> None:
    import yaml

    settings = {"rig": str(paths.rig.absolute()), "max_age": 0.0, "cloud_stride": 1}
    parameters = settings | model.model_dump(exclude_defaults=True)
    content = {_NODE.lstrip("/"): {"ros__parameters": parameters}}
    paths.parameters.write_text(yaml.safe_dump(content), encoding="utf-8")


def _figures(paths: "DemoPaths", anchor: str, info: str, outcome: "LiveOutcome") -> dict[str, Any]:
    """Return the intervals between sets, the age of depth, and the latency of each stage, in milliseconds.

    Ages are those of the anchor's depth: from its camera_info's arrival at the subscriber to its own.
    """
    import numpy as np

    from cvcdepth_ros.surround_sets.output_messages import DEPTH

    sent = _arrivals(paths.recording, info)
    depth = _arrivals(paths.recording, f"{_NODE}/{anchor}/{DEPTH}")
    if len(depth) < 3:
        raise RecordingError(f"only {len(depth)} sets came back: play more seconds")
    if not sent.keys() & depth.keys():
        raise RecordingError(f"none of the messages of {info} that belong to the depth was recorded")
    ages = np.array([(depth[stamp] - sent[stamp]) / 1e6 for stamp in depth.keys() & sent.keys()])
    intervals = np.diff(sorted(depth.values())) / 1e6
    # The recording's time and this machine's have nothing to do with each other.
    latencies = {stage: found for stage, found in outcome.node.latencies.items() if "ROS time" not in stage}
    stages = {stage: latency.model_dump() for stage, latency in latencies.items()}
    median = float(np.median(intervals))
    return {
        "engine": outcome.node.model,
        "sets_sent": outcome.sent[info],  # the recorder may miss the first
        "sets_received": len(depth),
        "median_ms": round(median, 2),
        "p95_ms": round(float(np.percentile(intervals, 95)), 2),
        "per_second": round(1e3 / median, 3),
        "age_ms": dict(zip(("p50", "p95", "max"), np.percentile(ages, [50, 95, 100]).round(1).tolist(), strict=True)),
        "outside_inference": round(max(0.0, 1 - stages["inference"]["p50_ms"] / median), 3),
        "peak_memory_mb": round(outcome.node_peak_mb),
        "stages_ms": stages,
    }


def _arrivals(path: Path, topic: str) -> dict[int, int]:
    """Return when (ns) each of the topic's messages came, by its stamp."""
    from cvcdepth_ros.bags import open_recording
    from cvcdepth_ros.messages.conversion import stamp_ns

    with open_recording(path) as recording:
        return {stamp_ns(recording.deserialize(m)): m.log_time for m in recording.messages([topic])}


def _machine() -> str:
    return f"{platform.machine()}, {len(os.sched_getaffinity(0))} cores, load {os.getloadavg()[0]:.1f}"


def _result(arguments: argparse.Namespace, model: ModelSettings, found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    import numpy
    import torch

    ratio = found["baseline"]["median_ms"] / found["node"]["median_ms"] if "baseline" in found else None
    return {
        "benchmark": "bench",
        "version": package_version(),
        "machine": _machine(),
        "versions": {"python": platform.python_version(), "torch": torch.__version__, "numpy": numpy.__version__},
        "recording": str(arguments.recording),
        "rate": arguments.rate,
        "model": model.model_dump(exclude_defaults=True),
        **found["node"],
        "baseline": found.get("baseline"),
        "times_baseline": None if ratio is None else round(ratio, 2),
    }
