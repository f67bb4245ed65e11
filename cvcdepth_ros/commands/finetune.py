# SPDX-License-Identifier: Apache-2.0
"""`finetune`: train a checkpoint further on recordings of one's own vehicle, without labels."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvcdepth_core.errors import ConfigError, CvcDepthError, RecordingError
from cvcdepth_ros.commands.arguments import add_json, add_quiet, add_recordings, print_result, warn
from cvcdepth_ros.version import package_version

if TYPE_CHECKING:
    from cvcdepth_core.distributed import Processes
    from cvcdepth_core.training import Trainer
    from cvcdepth_core.training_config import TrainingConfig
    from cvcdepth_ros.training_index import RecordingIndex
    from cvcdepth_ros.training_samples import RecordingBatches

SUMMARY = """Train depth from recordings, without labels.

BAG needs overlapping cameras, their calibration and transforms, and a moving vehicle. RUN becomes a folder with the
checkpoint last.safetensors, its configuration, log.jsonl and an index of every recording. The same command again goes
on where a run that was interrupted or killed stood; with more epochs in the configuration, a finished one too."""
EXAMPLES: tuple[str, ...] = (
    "finetune drives/ --config config/training/finetune.yaml --from model.safetensors -o run",
    "finetune monday.mcap tuesday.mcap --config shuttle.yaml --from-scratch --rig shuttle_rig.yaml -o run",
)

_RESULT_FILE, _INDEX_FOLDER = "finetune.json", "index"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_recordings(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="RUN", help="the run's folder")
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="training configuration (YAML)")
    start = parser.add_mutually_exclusive_group(required=True)
    start.add_argument("--from", dest="start", type=Path, metavar="CHECKPOINT", help="weights to start from")
    start.add_argument("--from-scratch", action="store_true", help="start from random weights")
    parser.add_argument("--rig", type=Path, metavar="FILE", help="rig file [the cameras found in each recording]")
    parser.add_argument("--device", default="auto", help="auto (CUDA where there is one), cpu, cuda, cuda:1 ... [auto]")
    add_quiet(parser)
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Index the recordings and train, with the other processes that torchrun started; CvcDepthError says why not."""
    from cvcdepth_core.distributed import launched_processes

    with launched_processes() as processes:
        _finetune(arguments, processes)


def _finetune(arguments: argparse.Namespace, processes: "Processes") -> None:
    from cvcdepth_core.training_config import load_training_config
    from cvcdepth_ros.training_samples import RecordingBatches

    config = load_training_config(arguments.config)
    if config.dataset != "recording":
        raise ConfigError(f"{arguments.config}: dataset is {config.dataset!r}, finetune takes 'recording'")
    with processes.first_goes_ahead():
        indexes, left_out = _indexes(arguments, config)
    batches = RecordingBatches(indexes, config, processes)
    trainer = _trainer(arguments, config, batches, processes)
    try:
        trainer.train(quiet=arguments.quiet)
    except KeyboardInterrupt:
        warn(f"interrupted in step {trainer.progress.step + 1}; the same command goes on from the last checkpoint")
        raise
    if not processes.is_first:
        return
    result = _result(arguments, trainer, batches, indexes) | {"left_out": left_out}
    (arguments.output / _RESULT_FILE).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print_result(result, _text(result), arguments.json)


def _indexes(arguments: argparse.Namespace, config: "TrainingConfig") -> "tuple[list[RecordingIndex], dict[str, str]]":
    """Return an index for each recording, and why the others are left out; CvcDepthError when none remains."""
    from cvcdepth_core.rig import load_rig_layout
    from cvcdepth_ros.bags import find_recordings
    from cvcdepth_ros.settings import MatchingSettings
    from cvcdepth_ros.training_index import load_index

    layout = load_rig_layout(arguments.rig) if arguments.rig else None
    matching = MatchingSettings.model_validate({"tolerance": config.recordings.tolerance})
    indexes, left_out = [], {}
    for recording in find_recordings(arguments.recordings):
        try:
            indexes.append(load_index(recording, arguments.output / _INDEX_FOLDER, matching, layout))
        except CvcDepthError as error:
            left_out[str(recording)] = str(error)
    if not indexes:
        raise RecordingError("; ".join(left_out.values()))
    for reason in left_out.values():
        warn(f"left out: {reason}")
    return indexes, left_out


def _trainer(
    arguments: argparse.Namespace, config: "TrainingConfig", batches: "RecordingBatches", processes: "Processes"
) -> "Trainer":
    from cvcdepth_core.checkpoint import load_checkpoint
    from cvcdepth_core.distributed import own_device
    from cvcdepth_core.estimator import resolve_device
    from cvcdepth_core.training import Trainer, build_surround_model

    start = None if arguments.start is None else load_checkpoint(arguments.start)
    return Trainer(
        config,
        build_surround_model(config, start),
        batches,
        arguments.output,
        own_device(resolve_device(arguments.device)),
        metadata={
            "version": package_version(),
            "config": config.model_dump_json(),
            "start": "random weights" if start is None else f"{start.path.name} sha256:{start.sha256}",
        },
        processes=processes,
    )


def _result(
    arguments: argparse.Namespace, trainer: "Trainer", batches: "RecordingBatches", indexes: "Sequence[RecordingIndex]"
) -> dict[str, Any]:
    from cvcdepth_core.checkpoint import load_checkpoint
    from cvcdepth_core.training import CHECKPOINT_FILE

    checkpoint = load_checkpoint(arguments.output / CHECKPOINT_FILE)
    return {
        "version": package_version(),
        "checkpoint": str(checkpoint.path),
        "sha256": checkpoint.sha256,
        "started_from": checkpoint.metadata["start"],
        "recordings": [
            {
                "recording": str(index.path),
                "sets": len(index),
                "outside_of_recorded_motion": index.unplaced,
                "training_samples": sum(sample.recording == number for sample in batches.reader.samples),
                "cameras": index.layout.names,
            }
            for number, index in enumerate(indexes)
        ],
        "epochs": trainer.progress.epoch,
        "steps": trainer.progress.step,
        "skipped_steps": trainer.progress.skipped,
        "unreadable_batches": trainer.progress.unreadable,
        "configuration": trainer.config.model_dump(mode="json"),
    }


def _text(result: dict[str, Any]) -> str:
    lines = [
        f"{entry['recording']}: {entry['training_samples']} training samples in {entry['sets']} sets of "
        f"{len(entry['cameras'])} cameras"
        for entry in result["recordings"]
    ]
    counts = f"{result['skipped_steps']} skipped, {result['unreadable_batches']} batches unreadable"
    lines.append(f"{result['epochs']} epochs, {result['steps']} steps ({counts})")
    return "\n".join([*lines, f"{result['checkpoint']}, started from {result['started_from']}"])
