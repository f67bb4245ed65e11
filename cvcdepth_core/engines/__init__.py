# SPDX-License-Identifier: Apache-2.0
"""Engines that run the depth network: one file each, chosen in `selection`, checked in `parity`."""

from cvcdepth_core.engines.engine import DisparityEngine
from cvcdepth_core.engines.selection import (
    build_engine,
    build_tensorrt,
    export_onnx,
    is_installed,
    resolve_device,
)

__all__ = [
    "DisparityEngine",
    "build_engine",
    "build_tensorrt",
    "export_onnx",
    "is_installed",
    "resolve_device",
]
