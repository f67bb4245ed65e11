# SPDX-License-Identifier: Apache-2.0
"""`finetune`: train a checkpoint further on recordings of one's own vehicle, without labels."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvcdepth_core.errors import ConfigError, NotPromotedError
from cvcdepth_core.files import write_json
from cvcdepth_ros.commands.arguments import (
    add_json,
    add_lidar,
    add_quiet,
    add_recordings,
    add_rig,
    add_skip,
    add_training_run,
    lidar_topics,
    refuse_unknown_checks,
    rig_layout,
    training_file,
)
from cvcdepth_ros.console import print_result, share, table, warn
from cvcdepth_ros.process_setup import prepare_long_work
from cvcdepth_ros.reports import REPORT_FILE, can_draw_report

if TYPE_CHECKING:
    from cvcdepth_core.networks.checkpoint import Checkpoint
    from cvcdepth_core.training.config import TrainingConfig
    from cvcdepth_core.training.distributed import Processes
    from cvcdepth_ros.finetuning.run import FinetuneJob, FinetuneResult

SUMMARY = """Train depth from recordings, without labels, and prove that it got better.

BAG needs overlapping cameras, their calibration and transforms, and a moving vehicle; what `check` finds wrong is told,
or refused, before the first step. RUN becomes a folder with the checkpoints, model_card.md, report.html and logs.
best.safetensors is there only when the held-out part of the recordings proves it better than the start: by the LiDAR,
or without one by how well the depth explains the pictures. Otherwise the exit code is 3; where too little is held out
to prove anything, nothing is trained, unless --no-promotion says so. The same command again goes on
where a run that was interrupted or killed stood; with more epochs in the configuration, a finished one too."""
EXAMPLES: tuple[str, ...] = (
    "finetune drives/ --config finetune --from model.safetensors -o run",
    "finetune drives/ --config finetune --from default --worlds shards/ --keep-general 0.5 -o run",
    "finetune monday.mcap tuesday.mcap --config shuttle.yaml --from-scratch --rig shuttle_rig.yaml -o run",
)

_RESULT_FILE = "finetune.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recordings(parser)
    add_training_run(parser, "finetune", "weights to start from; 'default' are the package's own")
    add_rig(parser)
    parser.add_argument(
        "--no-masks", action="store_true", help="do not look for the vehicle's own body in the recordings"
    )
    parser.add_argument(
        "--no-promotion",
        action="store_true",
        help="train even where too little is held out to prove anything; no best.safetensors is written",
    )
    parser.add_argument(
        "--worlds",
        action="append",
        default=[],
        type=Path,
        metavar="SHARDS",
        help="learn from rendered worlds too, a folder of simulate --many, and score them; can be repeated",
    )
    parser.add_argument(
        "--keep-general",
        type=share,
        metavar="RATIO",
        help="with --worlds: which share of the pictures comes from them, below 1 [worlds.share of the configuration]",
    )
    add_lidar(parser)
    add_skip(parser)
    parser.add_argument("--device", default="auto", help="auto (CUDA where there is one), cpu, cuda, cuda:1 ... [auto]")
    add_quiet(parser)
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Train and judge, with the other processes that torchrun started; CvcDepthError says why not."""
    from cvcdepth_core.training.config import load_training_config
    from cvcdepth_core.training.distributed import launched_processes
    from cvcdepth_ros.finetuning.run import BEST_FILE

    refuse_unknown_checks(arguments)
    if arguments.keep_general is not None and not arguments.worlds:
        arguments.usage_error("argument --keep-general: needs --worlds, of which that share is")
    prepare_long_work()
    path = training_file(arguments.config)
    _refuse_data_sets(path)
    start = _start(arguments)
    config = load_training_config(path, start.spec if start else None)
    if arguments.keep_general is not None:
        worlds = config.worlds.model_copy(update={"share": arguments.keep_general})
        config = config.model_copy(update={"worlds": worlds})
    with launched_processes() as processes:
        with_report = processes.is_first and can_draw_report()
        finished = _fine_tuned(_job(arguments, config, start), processes)
    if finished is None:
        return
    result = _written(finished, with_report)
    print_result(result, _text(result), arguments.json)
    if finished.job.with_promotion and not finished.verdict.promoted:
        raise NotPromotedError(f"{arguments.output / BEST_FILE} is not written: {finished.verdict.reason}")


def _start(arguments: argparse.Namespace) -> "Checkpoint | None":
    """Return the weights to start from; None: random ones."""
    from cvcdepth_core.model_choices import checkpoint_path
    from cvcdepth_core.networks.checkpoint import load_checkpoint

    return None if arguments.start is None else load_checkpoint(checkpoint_path(arguments.start))


def _refuse_data_sets(path: Path) -> None:
    """Raise ConfigError where the training file is not for recordings, before weights are looked for."""
    from cvcdepth_core.training.config import load_dataset

    dataset = load_dataset(path)
    if dataset in ("worlds", "ddad", "nuscenes"):
        why = "for `cvcdepth pretrain`" if dataset == "worlds" else "for which there is no reader yet"
        raise ConfigError(
            f"{path}: dataset is {dataset!r}, {why}; to train on recordings, write `dataset: recording` in this "
            f"file, or in a new one below `base: {path.resolve()}`"
        )


def _fine_tuned(job: "FinetuneJob", processes: "Processes") -> "FinetuneResult | None":
    from cvcdepth_ros.finetuning.run import fine_tune
    from cvcdepth_ros.finetuning.tensorboard import WITHOUT_TENSORBOARD, has_tensorboard

    if processes.is_first and not has_tensorboard():
        warn(WITHOUT_TENSORBOARD)
    try:
        return fine_tune(job, processes, warn)
    except KeyboardInterrupt:
        warn("interrupted; the same command goes on from the last checkpoint")
        raise


def _job(arguments: argparse.Namespace, config: "TrainingConfig", start: "Checkpoint | None") -> "FinetuneJob":
    from cvcdepth_core.model_choices import checkpoint_path
    from cvcdepth_ros.bags import find_recordings
    from cvcdepth_ros.finetuning.preparation import Source
    from cvcdepth_ros.finetuning.run import FinetuneJob
    from cvcdepth_ros.settings import MatchingSettings
    from cvcdepth_ros.training_data.world_views import find_shards

    judge = checkpoint_path(arguments.start or "")
    source = Source(
        find_recordings(arguments.recordings),
        rig_layout(arguments),
        MatchingSettings.model_validate({"tolerance": config.recordings.tolerance}),
        tuple(arguments.skip),
        not arguments.no_masks,
        lidar_topics(arguments),
        arguments.base_frame,
        config.recordings.motion,
        config.depth.is_told_its_rig,
        judge,
    )
    with_promotion = not arguments.no_promotion
    shards = find_shards(arguments.worlds)
    return FinetuneJob(
        source, config, arguments.output, start, arguments.device, arguments.quiet, with_promotion, shards
    )


def _written(finished: "FinetuneResult", with_report: bool) -> dict[str, Any]:
    """Write the card, the page if wanted, and the result; return the result."""
    from cvcdepth_ros.finetuning.card import model_card, write_card

    run, card = finished.job.run, model_card(finished)
    write_card(run, card)
    if with_report:
        from cvcdepth_ros.reports.finetuning_page import write_report

        write_report(run / REPORT_FILE, finished, card)
    shown = (
        "started_from",
        "version",
        "promoted",
        "verdict",
        "scores",
        "worlds",
        "left_out",
        "warnings",
        "configuration",
    )
    result = {
        "checkpoint": str(finished.weights),
        "sha256": card["weights"]["sha256"],
        "step": card["weights"]["step"],
        "recordings": card["data"],
        **card["training"],
        **{name: card[name] for name in (*shown, "configuration")},
    }
    write_json(run / _RESULT_FILE, result)
    return result


def _text(result: dict[str, Any]) -> str:
    from cvcdepth_ros.finetuning.card import pose_lines

    lines = [
        f"{entry['recording']}: {entry['training_samples']} training samples in {entry['sets']} sets of "
        f"{len(entry['cameras'])} cameras, {entry['held_out_sets']} sets held out, motion: {entry['motion']}"
        for entry in result["recordings"]
    ]
    counts = f"{result['skipped_steps']} skipped, {result['unreadable_batches']} batches unreadable"
    early = ", ended early" if result["ended_early"] else ""
    lines.append(f"{result['epochs']} epochs, {result['steps']} steps ({counts}){early}")
    if result["scores"]["after"]:
        lines += [_score_table(result["scores"]), *filter(None, pose_lines(result["scores"]))]
    if worlds := result["worlds"]:
        lines.append(f"{worlds['views_per_step']} views of worlds in each step, of {worlds['training_views']}")
        lines += [worlds["scores"]["verdict"]] if worlds["scores"] else []
    lines.append(f"{'promoted' if result['promoted'] else 'not promoted'}: {result['verdict']['reason']}")
    return "\n".join([*lines, f"{result['checkpoint']}, started from {result['started_from']}"])


def _score_table(scores: dict[str, Any]) -> str:
    from cvcdepth_ros.finetuning.card import SCORE_TITLES, score_pairs

    before, after = scores["before"]["cameras"], scores["after"]["cameras"]
    rows = [
        (camera, *score_pairs(numbers, after.get(camera, {}), arrow="→", unknown="-"))
        for camera, numbers in before.items()
    ]
    titles = [title.removesuffix(" error") for title in SCORE_TITLES.values()]
    return table(("before→after", *titles), rows, numbers=range(1, len(titles) + 1))
