# SPDX-License-Identifier: Apache-2.0
"""Which engine runs the network: the one that was asked for, or the best that is there."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch

from cvcdepth_core.engines.engine import DisparityEngine
from cvcdepth_core.engines.guarded_engine import GuardedEngine
from cvcdepth_core.engines.parity import check_parity
from cvcdepth_core.engines.torch_engine import ConditionedTorchEngine, TorchEagerEngine, TorchEngine
from cvcdepth_core.errors import ConfigError, EngineError
from cvcdepth_core.model_choices import BACKENDS, Precision
from cvcdepth_core.networks import DepthNet, DepthNetwork
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.networks.rig_conditioned import RigConditionedNet
from cvcdepth_core.processor import instructions

# What has to be importable, and how to get it.
_PACKAGES = {
    "ncnn": (("ncnn",), "pip install ncnn"),
    "openvino": (("onnx", "openvino"), "pip install 'cvcdepth_ros[openvino]'"),
    "onnxruntime": (("onnx", "onnxruntime"), "pip install 'cvcdepth_ros[onnx]'"),
    "tensorrt": (("onnx", "onnxruntime"), "pip install onnx onnxruntime-gpu"),
}
_CPU_ONLY, _CUDA_ONLY = ("ncnn", "openvino"), ("torch_compiled", "tensorrt")
_HALF_PRECISION = ("torch", "torch_compiled", "tensorrt")

_DEPTHWISE_ENCODERS = ("efficientnet_lite0",)
_WIDE_VECTORS = "avx512f"

_logger = logging.getLogger(__name__)


def build_engine(
    network: DepthNetwork,
    spec: DepthModelSpec,
    device: str = "auto",
    backend: str = "auto",
    precision: Precision = "float32",
    cpu_fallback: bool = False,
) -> GuardedEngine:
    """Make the network ready to run, and check that its depth is still the network's.

    `device` auto is CUDA where there is one and the backend can use it. `backend` auto is the first of the network's
    engines that is installed, runs on the device and works: for the published network on a CPU ncnn, or openvino where
    that is quicker, else torch. With `cpu_fallback`, a GPU that fails or is out of memory is replaced by the CPU.
    Raises ConfigError when the three do not go together or the network has no such engine, EngineError when the engine
    is not installed, broken, or gives another depth.
    """
    place = _place(device, backend)
    engine = checked_engine(network, spec, place, backend, precision)
    fallback = partial(checked_engine, network, spec, torch.device("cpu"), "auto", "float32")
    return GuardedEngine(engine, network.independent, fallback if cpu_fallback and place.type == "cuda" else None)


def checked_engine(
    network: DepthNetwork, spec: DepthModelSpec, device: torch.device, backend: str, precision: Precision
) -> DisparityEngine:
    """Return the backend's engine, found to give the network's depth; errors as in `build_engine`.

    Of `auto`, an engine that is installed but broken is logged, and the next best one taken.
    """
    if backend != "auto":
        return _checked(network, spec, device, backend, precision)
    *better, last = choices_of_auto(network, spec, device)
    for chosen in better:
        try:
            return _checked(network, spec, device, chosen, precision)
        except EngineError as error:
            _logger.warning("backend auto: %s; going on with the next best", error)
    return _checked(network, spec, device, last, precision)


def _checked(
    network: DepthNetwork, spec: DepthModelSpec, device: torch.device, backend: str, precision: Precision
) -> DisparityEngine:
    _refuse_unknown_to(network, spec, backend)
    _refuse_impossible(backend, device, precision)
    _refuse_missing(backend)
    with _refusing_broken(backend):
        engine = _build(backend, network, spec, device, precision)
    if backend != "torch_eager":
        check_parity(engine, network, spec, precision)
    return engine


def export_onnx(network: DepthNetwork, spec: DepthModelSpec) -> tuple[bytes, float]:
    """Return the network as an ONNX model and its relative depth error, as ONNX Runtime runs it on the CPU.

    Raises ConfigError when the network has no such engine, EngineError when onnx or ONNX Runtime is not installed, or
    the depth is another one.
    """
    _refuse_unknown_to(network, spec, "onnxruntime")
    _refuse_missing("onnxruntime")
    from cvcdepth_core.engines.onnx_engine import OnnxRuntimeEngine

    engine = OnnxRuntimeEngine(network, spec, torch.device("cpu"))
    return engine.model, check_parity(engine, network, spec, "float32")


def build_tensorrt(
    network: DepthNetwork, spec: DepthModelSpec, device: str, precision: Precision
) -> tuple[Path, float]:
    """Build and keep the engine that the backend tensorrt uses; return its folder and its relative depth error.

    Raises ConfigError when `device` is no GPU or the network has no such engine, EngineError without TensorRT or when
    the depth is another one.
    """
    place = resolve_device(device)
    _refuse_unknown_to(network, spec, "tensorrt")
    _refuse_impossible("tensorrt", place, precision)
    _refuse_missing("tensorrt")
    from cvcdepth_core.engines.onnx_engine import TensorRtEngine, engine_folder

    published = _published(network, spec, "tensorrt")
    with _refusing_broken("tensorrt"):
        engine = TensorRtEngine(published, spec, place, precision, build=True)
    return engine_folder(published, spec, place, precision), check_parity(engine, network, spec, precision)


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


def choices_of_auto(network: DepthNetwork, spec: DepthModelSpec, device: torch.device) -> list[str]:
    """Return those of the network's engines that run here, the best first; EngineError says what each of them lacks.

    A rule, and no measurement when the program starts: that would depend on what else runs, and two programs on one
    machine (the node, `evaluate`) could take different engines, whose depths differ in the last bits. `cvcdepth bench
    engines` measures.
    """
    lacking = {}
    for backend in network.engines:
        place = _only_on(backend)
        if place not in (None, device.type):
            lacking[backend] = f"runs on {place} only"
        elif not is_installed(backend):
            lacking[backend] = f"not installed ({_PACKAGES[backend][1]})"
    found = [backend for backend in network.engines if backend not in lacking]
    if not found:
        reasons = ", ".join(f"{backend} {reason}" for backend, reason in lacking.items())
        raise EngineError(f"network {spec.kind}: none of its engines can run on '{device}': {reasons}")
    return sorted(found, key=lambda backend: backend != "openvino") if _suits_openvino(spec) else found


def _suits_openvino(spec: DepthModelSpec) -> bool:
    """Tell whether OpenVINO is quicker than NCNN, whose Winograd convolutions are what ResNets have most of.

    Measured with AVX-512 only (docs/performance.md).
    """
    return spec.encoder in _DEPTHWISE_ENCODERS and _WIDE_VECTORS in instructions()


def _only_on(backend: str) -> str | None:
    """Return the kind of device that the backend is bound to."""
    if backend in _CPU_ONLY:
        return "cpu"
    return "cuda" if backend in _CUDA_ONLY else None


def _refuse_unknown_to(network: DepthNetwork, spec: DepthModelSpec, backend: str) -> None:
    if backend in BACKENDS and backend not in network.engines:
        known = ", ".join(network.engines)
        raise ConfigError(f"backend {backend} cannot run the network {spec.kind}: expected auto or one of {known}")


def _published(network: DepthNetwork, spec: DepthModelSpec, backend: str) -> DepthNet:
    """Return the network if it is the one that the backend's rewriting is made for."""
    if not isinstance(network, DepthNet):
        raise EngineError(
            f"backend {backend} rewrites the published network (DepthNet), and the network {spec.kind} is a "
            f"{type(network).__name__}: take the backend out of its `engines`"
        )
    return network


def _refuse_impossible(backend: str, device: torch.device, precision: Precision) -> None:
    if backend not in BACKENDS:
        raise ConfigError(f"backend is '{backend}', expected one of {', '.join(BACKENDS)}")
    place = _only_on(backend)
    if place not in (None, device.type):
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


@contextmanager
def _refusing_broken(backend: str) -> Iterator[None]:
    """Turn what a broken installation, or a folder that cannot be written, raises into an EngineError of one line."""
    try:
        yield
    except (ImportError, OSError) as error:
        reason = " ".join(str(error).split())
        raise EngineError(f"backend {backend}: cannot be made ready: {reason}") from error


def _build(
    backend: str, network: DepthNetwork, spec: DepthModelSpec, device: torch.device, precision: Precision
) -> DisparityEngine:
    if backend == "torch_eager":
        return TorchEagerEngine(network, device)
    if backend == "onnxruntime":
        from cvcdepth_core.engines.onnx_engine import OnnxRuntimeEngine

        return OnnxRuntimeEngine(network, spec, device)
    if isinstance(network, RigConditionedNet):
        return _build_conditioned(backend, network, spec, device, precision)
    published = _published(network, spec, backend)
    if backend == "ncnn":
        from cvcdepth_core.engines.ncnn_engine import NcnnEngine

        return NcnnEngine(published)
    if backend == "openvino":
        from cvcdepth_core.engines.openvino_engine import OpenVinoEngine

        return OpenVinoEngine(published, spec)
    if backend == "tensorrt":
        from cvcdepth_core.engines.onnx_engine import TensorRtEngine

        return TensorRtEngine(published, spec, device, precision)
    return TorchEngine(published, device, precision, compiled=backend == "torch_compiled")


def _build_conditioned(
    backend: str, network: RigConditionedNet, spec: DepthModelSpec, device: torch.device, precision: Precision
) -> DisparityEngine:
    if backend == "ncnn":
        from cvcdepth_core.engines.ncnn_engine import ConditionedNcnnEngine

        return ConditionedNcnnEngine(network)
    if backend == "openvino":
        from cvcdepth_core.engines.openvino_engine import ConditionedOpenVinoEngine

        return ConditionedOpenVinoEngine(network, spec)
    return ConditionedTorchEngine(network, device, precision)
