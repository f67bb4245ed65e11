# SPDX-License-Identifier: Apache-2.0
"""Engines that run the depth network: one file each, chosen in `selection`, checked in `parity`."""

from cvcdepth_core.engines.engine import DisparityEngine, Precision
from cvcdepth_core.engines.selection import (
    BACKENDS,
    Backend,
    build_engine,
    build_tensorrt,
    export_onnx,
    is_installed,
    resolve_device,
)

__all__ = [
    "BACKENDS",
    "Backend",
    "DisparityEngine",
    "Precision",
    "build_engine",
    "build_tensorrt",
    "export_onnx",
    "is_installed",
    "resolve_device",
]
