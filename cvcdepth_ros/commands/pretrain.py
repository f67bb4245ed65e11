# SPDX-License-Identifier: Apache-2.0
"""`pretrain`: train depth on shards of simulated drives, for any rig."""

import argparse
from pathlib import Path
from typing import Any

from cvcdepth_core.errors import ConfigError
from cvcdepth_ros.commands.arguments import add_json, add_quiet, add_training_run, training_file
from cvcdepth_ros.console import print_result, warn

SUMMARY = """Train depth on simulated drives, where it is known exactly, for any rig.

SHARDS is a folder of drives that `simulate --many` wrote. RUN becomes a folder with last.safetensors, from which
`finetune` can go on, and log.jsonl, which holds the scores on the drives that are held out. The same command again goes
on where a run that was interrupted stood, as long as the drives are the same."""
EXAMPLES: tuple[str, ...] = (
    "pretrain shards/ --config pretrain --from imagenet.safetensors -o run",
    "pretrain shards/ more_shards/ --config own.yaml --from-scratch -o run",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("shards", type=Path, nargs="+", metavar="SHARDS", help="folder of simulate --many")
    add_training_run(parser, "pretrain", "weights to start from, as of `import`")
    parser.add_argument("--device", default="auto", help="auto (CUDA where there is one), cpu, cuda, cuda:1 ... [auto]")
    add_quiet(parser)
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Train, with the other processes that torchrun started; CvcDepthError says why not."""
    from cvcdepth_core.model_choices import checkpoint_path
    from cvcdepth_core.networks.checkpoint import load_checkpoint
    from cvcdepth_core.training.config import load_training_config
    from cvcdepth_core.training.distributed import launched_processes
    from cvcdepth_ros.finetuning.pretraining import PretrainJob, pretrain
    from cvcdepth_ros.training_data.world_views import find_shards

    path = training_file(arguments.config)
    config = load_training_config(path)
    if config.dataset != "worlds":
        raise ConfigError(f"{path}: dataset is {config.dataset!r}, expected 'worlds' for shards of simulated drives")
    start = None if arguments.start is None else load_checkpoint(checkpoint_path(arguments.start))
    shards = find_shards(arguments.shards)
    job = PretrainJob(shards, config, arguments.output, start, arguments.device, arguments.quiet)
    with launched_processes() as processes:
        trainer = pretrain(job, processes, warn)
        if not processes.is_first:
            return
    result = {
        "checkpoint": str(arguments.output / "last.safetensors"),
        "drives": len(shards),
        "steps": trainer.progress.step,
        "epochs": trainer.progress.epoch,
        "validations": trainer.validations,
    }
    print_result(result, _text(result), arguments.json)


def _text(result: dict[str, Any]) -> str:
    lines = [
        f"epoch {entry['epoch']}: " + ", ".join(f"{name} {score:g}" for name, score in entry["validation"].items())
        for entry in result["validations"]
    ]
    lines.append(
        f"{result['checkpoint']}: {result['epochs']} epochs, {result['steps']} steps, {result['drives']} drives"
    )
    return "\n".join(lines)
