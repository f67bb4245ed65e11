# SPDX-License-Identifier: Apache-2.0
"""Names of encoders, engines and precisions, and of the checkpoint that comes with the package.

Settings and command lines are made of these names; nothing here imports torch, so that `--help` stays quick.
"""

from pathlib import Path
from typing import Literal, get_args

EncoderName = Literal["resnet18", "resnet34", "efficientnet_lite0"]
"""Backbone of a depth or pose network."""
ENCODERS: tuple[EncoderName, ...] = get_args(EncoderName)

Backend = Literal["auto", "ncnn", "openvino", "torch", "torch_eager", "torch_compiled", "onnxruntime", "tensorrt"]
"""Engine that runs a depth network; `auto` takes the best that is there."""
BACKENDS: tuple[Backend, ...] = get_args(Backend)

Precision = Literal["float32", "bfloat16", "float16"]
"""In what an engine computes; depth is float32 always."""
PRECISIONS: tuple[Precision, ...] = get_args(Precision)

FlipFusion = Literal["none", "depth", "inverse_depth"]
"""What of the usual and of the mirrored pictures is fused."""

DEFAULT = "default"
"""Name of the small model that comes with the package, in the place of a checkpoint's path."""

NOTICE = "default model: small, to try the software and to start training from, not for driving"

_PATH = Path(__file__).parent / "models" / "default.safetensors"


def checkpoint_path(name: str) -> Path:
    """Return the file that `name` stands for; an empty name and 'default' stand for the package's own model."""
    return _PATH if name in ("", DEFAULT) else Path(name).expanduser()
