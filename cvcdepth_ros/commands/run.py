# SPDX-License-Identifier: Apache-2.0
"""`run`: compute depth for a whole recording and store it in another."""

import argparse
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.files import write_json
from cvcdepth_ros.commands.arguments import (
    add_json,
    add_recording,
    add_rig,
    add_settings,
    add_window,
    rig_layout,
    settings_from,
    window_ns,
)
from cvcdepth_ros.console import print_result, progress_bar, table, warn
from cvcdepth_ros.installation import package_version
from cvcdepth_ros.process_setup import prepare_long_work
from cvcdepth_ros.settings import MatchingSettings, MissingCameraSettings, ModelSettings, OutputSettings

if TYPE_CHECKING:
    from cvcdepth_ros.bags import Recording
    from cvcdepth_ros.recordings.replay import DepthReplay, RecordedImage, SurroundReplay
    from cvcdepth_ros.recordings.rig import RecordedRig
    from cvcdepth_ros.surround_sets.latencies import StageLatencies
    from cvcdepth_ros.surround_sets.set_estimation import EstimatedSet

SUMMARY = """Compute depth and clouds into a new recording that Foxglove and RViz open.

The same matching, preprocessing and network as the live node, without DDS and as fast as it goes: every set is
computed. OUT becomes a rosbag2 folder (mcap) with depth images, camera_info, rectified pictures, the merged cloud and
the transforms, on the node's topic names; OUT/run.json tells what was done with what."""
EXAMPLES: tuple[str, ...] = (
    "run drive.mcap -o depth",
    "run drive/ -o depth --checkpoint model.safetensors --rig rig.yaml --start 10 --duration 5 --clouds all",
    "run drive/ -o try_out --untrained --height 96 --width 160",
)

_RESULT_FILE = "run.json"


class RunSettings(OutputSettings, MissingCameraSettings, MatchingSettings, ModelSettings):
    """The settings of `run`."""

    clouds: Literal["merged", "all", "none"] = "merged"
    """Clouds to store: the merged one, each camera's organised one too, or none."""
    obstacles: bool = False
    """Store the points of obstacles and of the ground, and the scan of the nearest obstacles, too."""
    confidence: bool = False
    """Store how sure depth is also where it is not refined; refined depth always has its confidence."""

    @property
    def wants_confidence(self) -> bool:
        """Whether confidence is computed and stored whatever becomes of depth."""
        return self.confidence or self.needs_confidence


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recording(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder to create")
    add_rig(parser, "the cameras found in the recording")
    add_window(parser)
    add_settings(parser, RunSettings)
    parser.add_argument(
        "--trace", type=Path, metavar="FILE", help="write when each stage ran, for https://ui.perfetto.dev"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Run to the end or to Ctrl-C; the output is whole in both cases."""
    settings = settings_from(arguments, RunSettings)
    from cvcdepth_ros.bags import open_recording

    prepare_long_work()

    if settings.notice:
        warn(settings.notice)
    with open_recording(arguments.recording) as recording:
        from cvcdepth_ros.recordings.ground import with_ground
        from cvcdepth_ros.recordings.replay import DepthReplay, SurroundReplay  # torch: not before there is a recording

        estimator, recorded = settings.build_estimator(), _recorded_rig(arguments, recording)
        ground = None
        if estimator.spec.is_told_its_rig:
            recorded, ground = with_ground(recorded)
            if ground.is_assumed:
                warn(ground.told)
        replay = SurroundReplay(recorded, settings, settings.min_cameras)
        with _trace(arguments.trace) as latencies:
            depths = DepthReplay(
                replay, estimator, latencies, settings, settings.wants_confidence, settings.needs_poses
            )
            outcome = _record(arguments, settings, replay, depths)
        result = {
            "version": package_version(),
            "recording": str(recording.path),
            "output": str(arguments.output),
            "model": depths.estimator.model_id,
            "configuration": _configuration(arguments, settings, replay),
            "ground": None if ground is None else ground.to_json(),
            **outcome,
            "damage": recording.damage,
            "notes": replay.notes,
        }
    write_json(arguments.output / _RESULT_FILE, result)
    print_result(result, _text(result), arguments.json)
    if result["interrupted"]:
        raise KeyboardInterrupt


@contextmanager
def _trace(path: Path | None) -> "Iterator[StageLatencies]":
    """Yield stage latencies that write a trace, where a file for it is named."""
    from cvcdepth_ros.surround_sets.latencies import StageLatencies
    from cvcdepth_ros.surround_sets.trace_file import TraceFile

    trace = TraceFile(path) if path else None
    try:
        yield StageLatencies(trace)
    finally:
        if trace is not None:
            trace.close()


def _recorded_rig(arguments: argparse.Namespace, recording: "Recording") -> "RecordedRig":
    from cvcdepth_ros.recordings.rig import RecordedRig

    return RecordedRig.from_recording(recording, rig_layout(arguments), arguments.base_frame)


def _record(
    arguments: argparse.Namespace, settings: RunSettings, replay: "SurroundReplay", depths: "DepthReplay"
) -> dict[str, Any]:
    """Compute and write all sets; without any, nothing is left behind and RecordingError says why."""
    from cvcdepth_ros.recordings.depth_recorder import DepthRecorder

    window = window_ns(arguments, replay.recording.start)
    began = time.monotonic()
    with (
        _stoppable() as stop,
        DepthRecorder(
            arguments.output,
            replay,
            settings,
            settings.clouds,
            window[0],
            depths.refinement.is_active,
            settings.obstacles,
        ) as recorder,
    ):
        sets = depths.sets(*window, recorder.handlers)
        seconds = (min(window[1] or replay.recording.end, replay.recording.end) - window[0]) / 1e9
        written = 0
        for estimated in _with_progress(sets, seconds, arguments.quiet):
            with depths.latencies.measure("write"):
                recorder.write(estimated)
            written += 1
            if stop.is_set():
                break
    if not written and not stop.is_set():
        shutil.rmtree(arguments.output)
        raise RecordingError(f"{replay.recording.path}: no set: {depths.why_no_set(*window)}")
    return _outcome(replay, depths, written, time.monotonic() - began) | {"interrupted": stop.is_set()}


def _with_progress(
    sets: "Iterator[EstimatedSet[RecordedImage]]", seconds: float, quiet: bool
) -> "Iterator[EstimatedSet[RecordedImage]]":
    """Show on a terminal how much of the recording is done."""
    first = None
    with progress_bar(seconds, "s recorded", quiet=quiet) as show:
        show(0.0, "0 sets")
        for number, estimated in enumerate(sets, 1):
            yield estimated
            first = first or estimated.surround_set.stamp_ns
            show((estimated.surround_set.stamp_ns - first) / 1e9, f"{number} sets")


@contextmanager
def _stoppable() -> "Iterator[threading.Event]":
    """Yield an event that Ctrl-C or SIGTERM sets, so that the set in hand is still written; a second one interrupts."""
    stop = threading.Event()

    def handle(*_: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _outcome(replay: "SurroundReplay", depths: "DepthReplay", written: int, seconds: float) -> dict[str, Any]:
    statistics, anchor = replay.statistics, replay.layout.anchor_camera
    stages = {stage: summary.total_s for stage, summary in depths.latencies.summaries().items()}
    stages["read and match"] = seconds - sum(stages.values())
    return {
        "sets": {
            "written": written,
            "matched": statistics.sets,
            "incomplete": sum(statistics.cameras[anchor].dropped.values()),
            "refused": depths.refused.count,
        },
        "images": {name: asdict(camera) for name, camera in statistics.cameras.items()},
        "refinement": depths.refinement.summary(),
        "refused": depths.refused.reasons + replay.unreadable.reasons,
        "seconds": {"total": round(seconds, 3), **{stage: round(total, 3) for stage, total in stages.items()}},
    }


def _configuration(arguments: argparse.Namespace, settings: RunSettings, replay: "SurroundReplay") -> dict[str, Any]:
    """Everything that the result depends on, the rig as it was completed included."""
    layout = replay.layout
    return {
        **settings.model_dump(),
        "start": arguments.start,
        "duration": arguments.duration,
        "rig": str(arguments.rig) if arguments.rig else None,
        "base_frame": layout.base_frame,
        "anchor": layout.anchor_camera,
        "cameras": layout.model_dump(mode="json", exclude_defaults=True)["cameras"],
    }


def _text(result: dict[str, Any]) -> str:
    sets, seconds = result["sets"], result["seconds"]
    cameras = [
        (name, str(camera["received"]), str(camera["matched"]), _reasons(camera["dropped"]))
        for name, camera in result["images"].items()
    ]
    stages = ", ".join(f"{stage} {total:.1f}" for stage, total in seconds.items() if stage != "total")
    return "\n".join(
        [
            table(("camera", "images", "matched", "dropped"), cameras, apart=3),
            *(f"refused: {reason}" for reason in result["refused"]),
            *([f"not everything could be read: {result['damage']}"] if result["damage"] else []),
            *(f"note: {note}" for note in result["notes"]),
            f"{sets['written']} sets written of {sets['matched']} matched; {sets['incomplete']} incomplete, "
            f"{sets['refused']} refused",
            *([result["ground"]["told"]] if result["ground"] else []),
            *_refinement_text(result["refinement"]),
            f"{seconds['total']:.1f} s: {stages}",
            f"{result['output']}, by {result['model']}",
        ]
    )


def _refinement_text(summary: dict[str, Any] | None) -> list[str]:
    """Say where the motion came from that pictures were compared by."""
    if summary is None:
        return []
    counts = summary["motion"]
    told = [f"motion from {counts['odometry']} sets' odometry, {counts['alignment']} sets' pictures"]
    told = [f"{told[0]}; {counts['unknown']} sets compared with neighbours only"]
    return told + ([f"odometry not used: {summary['odometry_problem']}"] if summary["odometry_problem"] else [])


def _reasons(dropped: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in dropped.items()) or "0"
