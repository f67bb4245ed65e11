# SPDX-License-Identifier: Apache-2.0
"""Which engine runs the network: the one that was asked for, or the best that is there."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch

from cvcdepth_core.engines.engine import DisparityEngine
from cvcdepth_core.engines.guarded_engine import GuardedEngine
from cvcdepth_core.engines.parity import check_parity
from cvcdepth_core.engines.torch_engine import TorchEagerEngine, TorchEngine
from cvcdepth_core.errors import ConfigError, EngineError
from cvcdepth_core.model_choices import BACKENDS, Precision
from cvcdepth_core.networks import DepthNet
from cvcdepth_core.networks.checkpoint import DepthModelSpec

# What has to be importable, and how to get it.
_PACKAGES = {
    "ncnn": (("ncnn",), "pip install ncnn"),
    "onnxruntime": (("onnx", "onnxruntime"), "pip install 'cvcdepth_ros[onnx]'"),
    "tensorrt": (("onnx", "onnxruntime"), "pip install onnx onnxruntime-gpu"),
}
_CPU_ONLY, _CUDA_ONLY = ("ncnn",), ("torch_compiled", "tensorrt")
_HALF_PRECISION = ("torch", "torch_compiled", "tensorrt")


def build_engine(
    network: DepthNet,
    spec: DepthModelSpec,
    device: str = "auto",
    backend: str = "auto",
    precision: Precision = "float32",
    cpu_fallback: bool = False,
) -> GuardedEngine:
    """Make the network ready to run, and check that its depth is still the network's.

    `device` auto is CUDA where there is one and the backend can use it. `backend` auto is, on a CPU, ncnn where it is
    installed, else torch. With `cpu_fallback`, a GPU that fails or is out of memory is replaced by the CPU.
    Raises ConfigError when the three do not go together, EngineError when the engine is not installed or gives another
    depth.
    """
    place = _place(device, backend)
    engine = checked_engine(network, spec, place, backend, precision)
    fallback = partial(checked_engine, network, spec, torch.device("cpu"), "auto", "float32")
    return GuardedEngine(engine, fallback if cpu_fallback and place.type == "cuda" else None)


def checked_engine(
    network: DepthNet, spec: DepthModelSpec, device: torch.device, backend: str, precision: Precision
) -> DisparityEngine:
    """Return the backend's engine, found to give the network's depth; errors as in `build_engine`."""
    chosen = _choose(backend, device)
    _refuse_impossible(chosen, device, precision)
    _refuse_missing(chosen)
    engine = _build(chosen, network, spec, device, precision)
    if chosen != "torch_eager":
        check_parity(engine, network, spec, precision)
    return engine


def export_onnx(network: DepthNet, spec: DepthModelSpec) -> tuple[bytes, float]:
    """Return the network as an ONNX model and its relative depth error, as ONNX Runtime runs it on the CPU.

    Raises EngineError when onnx or ONNX Runtime is not installed, or the depth is another one.
    """
    _refuse_missing("onnxruntime")
    from cvcdepth_core.engines.onnx_engine import OnnxRuntimeEngine

    engine = OnnxRuntimeEngine(network, spec, torch.device("cpu"))
    return engine.model, check_parity(engine, network, spec, "float32")


def build_tensorrt(network: DepthNet, spec: DepthModelSpec, device: str, precision: Precision) -> tuple[Path, float]:
    """Build and keep the engine that the backend tensorrt uses; return its folder and its relative depth error.

    Raises ConfigError when `device` is no GPU, EngineError without TensorRT or when the depth is another one.
    """
    place = resolve_device(device)
    _refuse_impossible("tensorrt", place, precision)
    _refuse_missing("tensorrt")
    from cvcdepth_core.engines.onnx_engine import TensorRtEngine, engine_folder

    engine = TensorRtEngine(network, spec, place, precision, build=True)
    return engine_folder(network, spec, place, precision), check_parity(engine, network, spec, precision)


def resolve_device(name: str) -> torch.device:
    """Return the device of that name, `auto` being CUDA where there is one; ConfigError when it is not there."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"device: '{name}' is not available: {str(error).splitlines()[0]}") from error
    return device


def is_installed(backend: str) -> bool:
    """Tell whether the packages behind a backend are there."""
    return backend not in _PACKAGES or not _missing(backend)


def _missing(backend: str) -> list[str]:
    return [package for package in _PACKAGES[backend][0] if find_spec(package) is None]


def _place(device: str, backend: str) -> torch.device:
    return torch.device("cpu") if device == "auto" and backend in _CPU_ONLY else resolve_device(device)


def _choose(backend: str, device: torch.device) -> str:
    if backend != "auto":
        return backend
    return "ncnn" if device.type == "cpu" and is_installed("ncnn") else "torch"


def _refuse_impossible(backend: str, device: torch.device, precision: Precision) -> None:
    if backend not in BACKENDS:
        raise ConfigError(f"backend is '{backend}', expected one of {', '.join(BACKENDS)}")
    needs = {"cpu": backend in _CPU_ONLY, "cuda": backend in _CUDA_ONLY}
    for place, needed in needs.items():
        if needed and device.type != place:
            raise ConfigError(f"backend {backend} runs on {place} only, the device is '{device}'")
    if precision != "float32" and not (device.type == "cuda" and backend in _HALF_PRECISION):
        raise ConfigError(
            f"precision {precision} needs a CUDA device and one of {', '.join(_HALF_PRECISION)}, "
            f"found backend {backend} on '{device}'"
        )


def _refuse_missing(backend: str) -> None:
    if not is_installed(backend):
        missing, remedy = ", ".join(_missing(backend)), _PACKAGES[backend][1]
        raise EngineError(f"backend {backend}: {missing} is not installed here: {remedy}")


def _build(
    backend: str, network: DepthNet, spec: DepthModelSpec, device: torch.device, precision: Precision
) -> DisparityEngine:
    if backend == "torch_eager":
        return TorchEagerEngine(network, device)
    if backend == "ncnn":
        from cvcdepth_core.engines.ncnn_engine import NcnnEngine

        return NcnnEngine(network)
    if backend in ("onnxruntime", "tensorrt"):
        from cvcdepth_core.engines.onnx_engine import OnnxRuntimeEngine, TensorRtEngine

        if backend == "tensorrt":
            return TensorRtEngine(network, spec, device, precision)
        return OnnxRuntimeEngine(network, spec, device)
    return TorchEngine(network, device, precision, compiled=backend == "torch_compiled")
