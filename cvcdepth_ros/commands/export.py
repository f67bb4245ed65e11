# SPDX-License-Identifier: Apache-2.0
"""`export`: the depth network for other programs, and for TensorRT."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.model_choices import PRECISIONS, Precision
from cvcdepth_ros.commands.arguments import add_json, refuse_to_overwrite
from cvcdepth_ros.console import print_result
from cvcdepth_ros.installation import package_version

if TYPE_CHECKING:
    from cvcdepth_core.networks.checkpoint import Checkpoint

SUMMARY = """Write the depth network as ONNX, or build its TensorRT engine.

OUT.onnx takes `images` [B, 3, H, W], RGB in [0, 1], to `disparity` [B, 1, H, W]; OUT.json beside it says how disparity
becomes metres, and for which size the network was trained. With --tensorrt the engine that `--backend tensorrt` uses is
built for the GPU in this machine, which takes minutes, and is kept in ~/.cache/cvcdepth. Both are checked against the
network in float64 before they are kept."""
EXAMPLES: tuple[str, ...] = (
    "export model.safetensors -o model.onnx",
    "export model.safetensors --tensorrt --precision float16",
)

_ONE_IMAGE = {
    "input": "images [B, 3, H, W], float32 RGB in [0, 1], rectified; H and W multiples of 32",
    "output": "disparity [B, 1, H, W], float32 in (0, 1)",
}
_WHOLE_RIG = {
    "input": "images [1, N, 3, H, W], float32 RGB in [0, 1], rectified; and what else the network looks at: intrinsics "
    "[1, N, 3, 3] float32 in pixels of H x W, base_T_camera [1, N, 4, 4] float32 in metres, present [1, N] bool, "
    "masks [1, N, 1, H, W] float32, 1 = scene",
    "output": "disparity [1, N, 1, H, W], float32 in (0, 1)",
}
_TOLD_ITS_RIG: dict[str, Any] = {
    "input": "images [B, 3, H, W], float32 RGB in [0, 1], rectified; H and W multiples of 32; and conditioning "
    "[B, 11, H, W] float32, made once for each camera",
    "output": "disparity [B, 1, H, W], float32 in [0, 1], 0 in the sky; sky [B, 1, H, W], logit of its probability; "
    "log_uncertainty [B, 1, H, W], the natural logarithm of the error of log depth that is to be expected",
    "conditioning": {
        "x, y": "(u - cx) / fx and (v - cy) / fy of each pixel, centres at the integers",
        "forward, left, up": "the ray (x, y, 1), turned from the camera's optical frame into the vehicle's",
        "height": "metres of the camera above the ground",
        "level": "sqrt(forward**2 + left**2)",
        "ground": "-up / maximum(height, 0.2)",
        "near": "clip(ground, 0, 3)",
        "below": "where(ground > 1 / 150, 1.0, 0.0)",
        "channels": [
            "minimum(3 * near, 2)",
            "0.3 * log(maximum(near, 0.005)) + 0.6",
            "2 * up / sqrt(level**2 + up**2)",
            "forward / maximum(level, 0.05)",
            "left / maximum(level, 0.05)",
            "x",
            "y",
            "log(fx / focal_scale)",
            "height - 1.6",
            "below",
            "near * below * fx / focal_scale",
        ],
    },
}
_DEPTH = "depth = fx / (focal_scale * (1 / max_depth + (1 / min_depth - 1 / max_depth) * disparity))"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("checkpoint", type=Path, metavar="CHECKPOINT", help="checkpoint file (safetensors)")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="ONNX file to write [CHECKPOINT.onnx]")
    parser.add_argument("--force", action="store_true", help="overwrite the files")
    parser.add_argument("--tensorrt", action="store_true", help="build a TensorRT engine instead")
    parser.add_argument("--precision", choices=PRECISIONS, help="of the TensorRT engine [float32]")
    parser.add_argument("--device", metavar="TEXT", help="GPU to build the TensorRT engine for [cuda]")
    add_json(parser)


def execute(arguments: argparse.Namespace) -> None:
    """Export, and tell what was written."""
    from cvcdepth_core.networks.checkpoint import load_checkpoint

    unused = ("output", "force") if arguments.tensorrt else ("precision", "device")
    if given := [name for name in unused if getattr(arguments, name)]:
        arguments.usage_error(f"--{given[0]} is {'not ' if arguments.tensorrt else ''}for --tensorrt")
    checkpoint = load_checkpoint(arguments.checkpoint)
    if arguments.tensorrt:
        written, error = _build_tensorrt(checkpoint, arguments.precision or "float32", arguments.device or "cuda")
    else:
        written, error = _write_onnx(checkpoint, arguments.output, arguments.force)
    result = _description(checkpoint) | {"file": str(written), "relative_depth_error": error}
    print_result(result, f"{written}: relative depth error {error:.1e} against float64", arguments.json)


def _write_onnx(checkpoint: "Checkpoint", output: Path | None, force: bool) -> tuple[Path, float]:
    from cvcdepth_core.engines import export_onnx
    from cvcdepth_core.files import write_atomically, write_json

    path = output or checkpoint.path.with_suffix(".onnx")
    beside = path.with_suffix(".json")
    if beside == path:
        raise ConfigError(f"{path}: its description would take its place; choose another name")
    if not force:
        refuse_to_overwrite(path, beside)
    model, error = export_onnx(checkpoint.build_depth_net(), checkpoint.spec)
    write_atomically(path, model)
    write_json(beside, _description(checkpoint))
    return path, error


def _build_tensorrt(checkpoint: "Checkpoint", precision: Precision, device: str) -> tuple[Path, float]:
    from cvcdepth_core.engines import build_tensorrt

    return build_tensorrt(checkpoint.build_depth_net(), checkpoint.spec, device, precision)


def _description(checkpoint: "Checkpoint") -> dict[str, Any]:
    """Return what a program has to know to use the model."""
    from cvcdepth_core.networks.registry import PER_CAMERA, RIG_CONDITIONED

    known = {PER_CAMERA: _ONE_IMAGE, RIG_CONDITIONED: _TOLD_ITS_RIG}
    return {
        "version": package_version(),
        "checkpoint": checkpoint.path.name,
        "sha256": checkpoint.sha256,
        **checkpoint.spec.model_dump(),
        **known.get(checkpoint.spec.network, _WHOLE_RIG),
        "depth": _DEPTH,
        "fx": "each camera's focal length in pixels of H x W; depth is metres along the optical axis",
    }
