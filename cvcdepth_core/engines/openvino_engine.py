# SPDX-License-Identifier: Apache-2.0
"""OpenVINO: the exported network compiled for the CPU, quickest where a network has depthwise convolutions. 180 MB."""

from __future__ import annotations

import ctypes
import importlib
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cvcdepth_core.engines.engine import image_by_image
from cvcdepth_core.engines.onnx_engine import INPUT, onnx_model, rewritten_onnx_model
from cvcdepth_core.engines.rewriting_conditioned import ToldDetails
from cvcdepth_core.errors import EngineError
from cvcdepth_core.networks import DepthNet, DepthOutputs, RigImages
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.networks.rig_conditioned import RigConditionedNet

_TELEMETRY = "openvino_telemetry"


class OpenVinoEngine:
    """The rewritten network in OpenVINO, on as many threads as torch has when it is built.

    Several images are computed side by side, each on threads of its own; their number changes no bit of the result.
    """

    device = torch.device("cpu")
    chunk = None

    def __init__(self, network: DepthNet | RigConditionedNet, spec: DepthModelSpec) -> None:
        openvino = _import_openvino()
        self.name = f"openvino {openvino.__version__.partition('-')[0]} float32"
        self._openvino, self._core = openvino, openvino.Core()
        self._model = self._graph(network, spec)
        self._threads = torch.get_num_threads()
        self._size: tuple[int, ...] = ()
        self._streams = 0
        self._queue: Any = None

    def disparity(self, rig: RigImages) -> Tensor:
        """See `DisparityEngine`. The first set of a size, and the largest so far, have the network compiled."""
        return image_by_image(lambda images: self._each({INPUT: images}), rig)

    def _graph(self, network: Any, spec: DepthModelSpec) -> bytes:
        return onnx_model(network, spec)

    def _each(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Return the output of each image and of what belongs to it."""
        arrays = {name: np.ascontiguousarray(value.numpy()) for name, value in inputs.items()}
        found = [np.empty(0, np.float32)] * len(inputs[INPUT])
        try:
            queue = self._queue_for(inputs)
            queue.set_callback(lambda request, i: found.__setitem__(i, request.get_output_tensor().data[0].copy()))
            for number in range(len(found)):
                queue.start_async({name: array[number : number + 1] for name, array in arrays.items()}, number)
            queue.wait_all()
        except RuntimeError as error:  # what OpenVINO raises
            raise EngineError(f"{self.name}: inference failed: {' '.join(str(error).split())}") from error
        return torch.from_numpy(np.stack(found))

    def _queue_for(self, inputs: Mapping[str, Tensor]) -> Any:
        """Return a queue of requests for images of this size, as many side by side as there are, or threads."""
        images = inputs[INPUT]
        size, streams = tuple(images.shape[-2:]), max(1, min(self._threads, len(images)))
        if size != self._size or streams > self._streams:
            self._queue = None  # its memory first
            model = self._core.read_model(self._model)
            model.reshape({name: [1, *value.shape[1:]] for name, value in inputs.items()})
            options = {
                "INFERENCE_PRECISION_HINT": "f32",  # it would compute in bfloat16 where the CPU can
                "INFERENCE_NUM_THREADS": self._threads,
                "NUM_STREAMS": streams,
                "ENABLE_CPU_PINNING": False,  # other threads need the cores
            }
            with _signal_stack_kept():
                compiled = self._core.compile_model(model, "CPU", options)
                self._queue = self._openvino.AsyncInferQueue(compiled, streams)
            self._size, self._streams = size, streams
        return self._queue


class ConditionedOpenVinoEngine(OpenVinoEngine):
    """The network that is told its rig: OpenVINO is given what is made of each calibration once, beside the picture."""

    def __init__(self, network: RigConditionedNet, spec: DepthModelSpec) -> None:
        super().__init__(network, spec)
        self._details = ToldDetails(network, self.device)

    def disparity(self, rig: RigImages) -> Tensor:
        """See `DisparityEngine`."""
        return self.details(rig).disparity

    def details(self, rig: RigImages) -> DepthOutputs:
        """See `DetailedEngine`."""
        return self._details(rig, self._each)

    def _graph(self, network: Any, spec: DepthModelSpec) -> bytes:
        return rewritten_onnx_model(network, spec)


class _SignalStack(ctypes.Structure):
    """`stack_t` of sigaltstack(2)."""

    _fields_ = (("pointer", ctypes.c_void_p), ("flags", ctypes.c_int), ("size", ctypes.c_size_t))


@contextmanager
def _signal_stack_kept() -> Iterator[None]:
    """Leave this thread's alternate signal stack as it was.

    OpenVINO's CPU plugin puts one of its own in its place and frees that later. The next signal with a handler, such as
    the end of a child process, then ends the program without a word.
    """
    sigaltstack = getattr(ctypes.CDLL(None), "sigaltstack", None)
    if sigaltstack is None:
        yield
        return
    before = _SignalStack()
    sigaltstack(None, ctypes.byref(before))
    try:
        yield
    finally:
        sigaltstack(ctypes.byref(before), None)


def _import_openvino() -> Any:
    """Import it without its telemetry, which tells its maker of every import; it goes on where that is not installed.

    Raises EngineError when it is broken.
    """
    sys.modules.setdefault(_TELEMETRY, None)  # type: ignore[arg-type]
    try:
        return importlib.import_module("openvino")
    except (ImportError, OSError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise EngineError(f"backend openvino: openvino is installed, but cannot be imported: {reason}") from error
