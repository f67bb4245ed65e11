# SPDX-License-Identifier: Apache-2.0
"""What can be chosen of a model by name: encoder, engine, precision, and the checkpoint that comes with the package.

Settings and command lines are made of these names; nothing here imports torch, so that `--help` stays quick.
"""

from pathlib import Path
from typing import Literal, get_args

EncoderName = Literal["resnet18", "resnet34", "efficientnet_lite0"]
"""Backbone of a depth or pose network."""
ENCODERS: tuple[EncoderName, ...] = get_args(EncoderName)

Backend = Literal["auto", "ncnn", "torch", "torch_eager", "torch_compiled", "onnxruntime", "tensorrt"]
"""Engine that runs a depth network; `auto` takes the best that is there."""
BACKENDS: tuple[Backend, ...] = get_args(Backend)

Precision = Literal["float32", "bfloat16", "float16"]
"""In what an engine computes; depth is float32 always."""
PRECISIONS: tuple[Precision, ...] = get_args(Precision)

DEFAULT = "default"
"""What may stand for a checkpoint's path: the small model that lets people see depth before anybody has trained."""

NOTICE = (
    "default model: trained on three seconds of one street, to try the software and to start training from, not for "
    "driving"
)

_PATH = Path(__file__).parent / "models" / "default.safetensors"


def checkpoint_path(name: str) -> Path:
    """Return the file that `name` stands for; nothing and 'default' stand for the model that comes with the package."""
    return _PATH if name in ("", DEFAULT) else Path(name).expanduser()
