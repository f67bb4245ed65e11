# SPDX-License-Identifier: Apache-2.0
"""`evaluate`: score depth on recordings, against their LiDAR and without it, and compare results."""

import argparse
import json
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvcdepth_core.files import write_atomically, write_json
from cvcdepth_ros.commands.arguments import (
    add_json,
    add_lidar,
    add_quiet,
    add_recordings,
    add_rig,
    add_settings,
    add_window,
    lidar_topics,
    rig_layout,
    settings_from,
)
from cvcdepth_ros.console import count, paragraph, print_result, progress_bar, table, warn
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings, unique_names
from cvcdepth_ros.process_setup import prepare_long_work
from cvcdepth_ros.reports import REPORT_FILE, can_draw_report

if TYPE_CHECKING:
    from cvcdepth_ros.evaluation.measuring import RecordingScores
    from cvcdepth_ros.evaluation.result import EvaluationResult
    from cvcdepth_ros.evaluation.workers import Pool

SUMMARY = """Score depth on recordings: against their LiDAR, and without it; or compare two results.

BAG is a recording of any kind, a folder of them, a glob or a URL. Sets are matched, rectified and estimated as the live
node does it. OUT/metrics.json holds every number (docs/evaluation.md explains them), OUT/per_frame.csv a line per
image, OUT/report.html the tables and pictures. Recordings that were finished before are not done again."""
EXAMPLES: tuple[str, ...] = (
    "evaluate drives/ --checkpoint model.safetensors -o scores --workers 4",
    "evaluate drive.mcap --predictor ground_plane --ground-height -0.4 -o flat",
    "evaluate drives/ --checkpoint old.safetensors --checkpoint new.safetensors -o both",
    "evaluate --compare scores_old/metrics.json scores_new/metrics.json",
)

_METRICS_FILE, _FRAMES_FILE, _COMPARISON_FILE = "metrics.json", "per_frame.csv", "comparison.json"
_PARTS = "parts"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recordings(parser, required=False)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("evaluation"),
        metavar="OUT",
        help="folder of the results [evaluation]",
    )
    network = add_settings(parser, EvaluationSettings, repeatable=["checkpoint"])
    network.add_argument(
        "--compare", nargs=2, type=Path, metavar=("A", "B"), help="two metrics.json: is B better than A?"
    )
    add_lidar(parser)
    add_rig(parser)
    add_window(parser)
    parser.add_argument(
        "--workers", type=count, metavar="N", help="processes, a recording each [1; with --ray as many as CPUs]"
    )
    parser.add_argument("--ray", action="store_true", help="hand the recordings to Ray, on a cluster started here")
    parser.add_argument("--ray-address", metavar="ADDRESS", help="... on the cluster there, as many as its CPUs take")
    parser.add_argument("--no-report", action="store_true", help=f"numbers only, no {REPORT_FILE}")
    add_quiet(parser)
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Evaluate each model on all recordings, or compare; RecordingError when nothing could be evaluated."""
    if arguments.compare and arguments.recordings:
        arguments.usage_error("--compare takes two metrics.json and no recording")
    if not arguments.compare and not arguments.recordings:
        arguments.usage_error("the following arguments are required: BAG")
    if arguments.ray_address and arguments.workers:
        arguments.usage_error("--workers is for this machine; of a cluster (--ray-address) all CPUs are used")
    if arguments.compare:
        content, text = _comparison(*arguments.compare)
    else:
        prepare_long_work()
        content, text = _evaluation(arguments)
    print_result(content, text, arguments.json)


def _evaluation(arguments: argparse.Namespace) -> "tuple[dict[str, Any], str]":
    """Evaluate every model, and compare the others with the first; return what to print."""
    found = [_evaluated(arguments, settings, folder) for settings, folder in _folders(arguments)]
    if len(found) == 1:
        return found[0][1:]
    (first, *_), *others = found
    compared = []
    for folder, *_ in others:
        content, text = _comparison(first / _METRICS_FILE, folder / _METRICS_FILE)
        write_json(folder / _COMPARISON_FILE, content)
        compared.append((content, text))
    results = {"evaluations": [content for _, content, _ in found], "comparisons": [content for content, _ in compared]}
    return results, "\n\n".join([text for *_, text in found] + [text for _, text in compared])


def _folders(arguments: argparse.Namespace) -> list[tuple[EvaluationSettings, Path]]:
    """Return the settings for each model with its output folder: OUT itself for one, OUT/NAME for several."""
    checkpoints = getattr(arguments, "checkpoint", None)
    if not checkpoints:
        return [(settings_from(arguments, EvaluationSettings), arguments.output)]
    given = [argparse.Namespace(**vars(arguments) | {"checkpoint": checkpoint}) for checkpoint in checkpoints]
    settings = [settings_from(one, EvaluationSettings) for one in given]
    if len(checkpoints) == 1:
        return [(settings[0], arguments.output)]
    stems = [Path(checkpoint).stem for checkpoint in checkpoints]
    names = unique_names([(stem, f"{i}_{stem}") for i, stem in enumerate(stems, 1)])
    return [(one, arguments.output / name) for one, name in zip(settings, names, strict=True)]


def _evaluated(
    arguments: argparse.Namespace, settings: EvaluationSettings, folder: Path
) -> "tuple[Path, dict[str, Any], str]":
    """Write one model's results; return their folder and what to print."""
    from cvcdepth_ros.commands.evaluation_tables import evaluation_text
    from cvcdepth_ros.evaluation.image_scores import write_csv

    if settings.notice:
        warn(settings.notice)
    with_report = not arguments.no_report and can_draw_report()
    jobs = _jobs(arguments, settings)
    result = _result(arguments, settings, jobs, folder)
    content = result.to_json()
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / _METRICS_FILE, f"{json.dumps(content)}\n".encode())
    write_csv(folder / _FRAMES_FILE, result.images)
    if with_report:
        from cvcdepth_ros.reports.evaluation_page import write_report

        write_report(folder / REPORT_FILE, result, {job.name: job for job in jobs})
    return folder, {name: value for name, value in content.items() if name != "rows"}, evaluation_text(result, folder)


def _result(
    arguments: argparse.Namespace, settings: EvaluationSettings, jobs: Sequence[EvaluationJob], folder: Path
) -> "EvaluationResult":
    from cvcdepth_ros.evaluation.result import EvaluationResult, Failure
    from cvcdepth_ros.evaluation.workers import KeptScores, evaluate_all

    depends_on = settings.dependencies()
    kept = KeptScores(folder / _PARTS, depends_on)
    outcomes = []
    with _pool(arguments, settings) as pool, progress_bar(len(jobs), "recordings", quiet=arguments.quiet) as progress:
        for job, outcome in evaluate_all(jobs, arguments.workers or 1, kept, progress, pool):
            outcomes.append(outcome)
            if not isinstance(outcome, Failure):
                _warn_of_losses(job, outcome)
    failed = [outcome for outcome in outcomes if isinstance(outcome, Failure)]
    for failure in failed if len(failed) < len(outcomes) else failed[1:]:
        warn(f"not evaluated: {failure.reason}")
    models = sorted({outcome.summary["model"] for outcome in outcomes if not isinstance(outcome, Failure)})
    if len(models) > 1:
        warn(f"the recordings were not evaluated alike: {' and '.join(models)}")
    return EvaluationResult.from_outcomes(jobs, outcomes, depends_on)


def _pool(arguments: argparse.Namespace, settings: EvaluationSettings) -> "AbstractContextManager[Pool | None]":
    """Return where recordings are evaluated at the same time, when it is not this machine's processes."""
    if not arguments.ray and not arguments.ray_address:
        return nullcontext()
    from cvcdepth_ros.evaluation.cluster import ray_pool

    return ray_pool(settings, arguments.ray_address, arguments.workers)


def _jobs(arguments: argparse.Namespace, settings: EvaluationSettings) -> list[EvaluationJob]:
    from cvcdepth_ros.bags import find_recordings

    locations = find_recordings(arguments.recordings)
    names = unique_names([(location.name, str(location)) for location in locations])
    layout = rig_layout(arguments)
    lidar, window = lidar_topics(arguments), (arguments.start, arguments.duration)
    if settings.truth == "depth" and lidar is not None:
        arguments.usage_error("--truth depth: depth images are the truth, so --lidar and --no-lidar have no meaning")
    job = EvaluationJob("", "", settings, layout, arguments.base_frame, lidar, *window)
    return [replace(job, name=name, path=str(path)) for name, path in zip(names, locations, strict=True)]


def _comparison(first: Path, second: Path) -> tuple[dict[str, Any], str]:
    from cvcdepth_ros.evaluation.result import StoredResult, comparison_to_json

    content = comparison_to_json(StoredResult.read(first), StoredResult.read(second))
    if content["measured_differently"]:
        fields = ", ".join(content["measured_differently"])
        warn(f"{first} and {second} were measured differently ({fields}): not only the models make them differ")
    return content, _comparison_text(content)


def _warn_of_losses(job: EvaluationJob, scores: "RecordingScores") -> None:

    damage, sets = scores.summary["damage"], scores.summary["sets"]["scored"]
    if damage:
        seconds = scores.summary["seconds"]
        warn(f"{job.path}: not everything could be read: {damage}; evaluated {sets} sets of the {seconds:.1f} s there")
    for note in scores.summary.get("notes", ()):
        warn(f"{job.path}: {note}")
    ground = scores.summary["ground"]
    if ground["source"] == "assumed" and ground["told_to_network"]:
        warn(f"{job.path}: {ground['told']}")
    left_out = scores.summary.get("why_no_lidar")
    if left_out:
        warn(f"{job.path}: {left_out}")
    refusals = scores.summary["truth_refused"]
    if refusals["count"]:
        warn(f"{job.path}: {refusals['count']} times no truth, the first: {refusals['reasons'][0]}")


def _comparison_text(content: dict[str, Any]) -> str:
    header = ("", "A", "B", "B - A", f"{content['level']:.0%} interval", "")
    rows = [
        (
            f"{name}{', scaled' if scaling == 'median' else ''}",
            *_difference_cells(difference, content["can_prove"]),
        )
        for scaling, differences in content["differences"].items()
        for name, difference in differences.items()
    ]
    return "\n".join(
        [
            f"A: {content['first']}",
            f"B: {content['second']}",
            table(header, rows, numbers=range(1, 5), apart=5),
            paragraph(
                f"{content['sets']} sets in both; only in A {content['only_in_first']}, only in B "
                f"{content['only_in_second']}; paired bootstrap of {content['resamples']} draws of blocks of "
                f"{content['block']} sets; the same: 0 is within the interval; scaled: each image by "
                "median(truth) / median(prediction)"
            ),
        ]
    )


def _difference_cells(difference: dict[str, float | None], can_prove: bool) -> tuple[str, ...]:
    first, second, change, low, high = (difference[name] for name in ("first", "second", "difference", "low", "high"))
    if first is None or second is None or change is None or low is None or high is None:
        return ("", "", "", "", "not known")
    outside = "different" if can_prove else "too few sets to say"
    verdict = "the same" if low <= 0 <= high else outside
    return (f"{first:.4f}", f"{second:.4f}", f"{change:+.4f}", f"{low:+.4f}..{high:+.4f}", verdict)
