# SPDX-License-Identifier: Apache-2.0
"""A rewritten depth network in NCNN's two files: `param`, the layers as text, and `bin`, their weights.

The format is described in NCNN's documentation (param-and-model-file-structure, operators).
"""

from __future__ import annotations

import operator
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor, fx, nn, sigmoid
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.engines.rewriting import ConvolutionTracer
from cvcdepth_core.errors import EngineError
from cvcdepth_core.networks.efficientnet_lite import SameConv

INPUT, OUTPUT = "images", "disparity"

_MAGIC = 7767517
_FLOAT32 = struct.pack("<I", 0)
_REPEATED, _MIRRORED = 1, 2
_ARITHMETIC = {operator.add: 0, operator.sub: 1, operator.mul: 2, operator.truediv: 3}
# Activations that a convolution does on its way out.
_ACTIVATIONS: dict[Callable[..., Tensor], dict[int, Any]] = {F.relu: {9: 1}, F.relu6: {9: 3, 10: (0.0, 6.0)}}

Parameters = dict[int, Any]
"""NCNN's numbers for a layer's parameters, to int, float or a tuple of floats."""


def ncnn_model(network: nn.Module) -> tuple[str, bytes]:
    """Return the content of the `param` and of the `bin` file; EngineError names an operation that is not known here.

    The input blobs are called as the arguments of the network's `forward` are, `images` [3, H, W] the first; the output
    blob is `disparity`: [1, H, W], or whatever the network gives.
    """
    graph = fx.GraphModule(network, ConvolutionTracer().trace(network))
    writer = _Writer()
    for node in graph.graph.nodes:
        if node.op == "placeholder":
            writer.write(_Layer("Input"), [], node)
        elif node.op != "output":
            _write_operation(writer, graph, node)
    return writer.param(), bytes(writer.weights)


@dataclass(frozen=True)
class _Layer:
    type: str
    parameters: Parameters = field(default_factory=dict)
    weights: tuple[Tensor, ...] = ()


class _Writer:
    def __init__(self) -> None:
        self.weights = bytearray()
        self._lines: list[tuple[str, list[str], list[str], Parameters]] = []
        self._blobs: dict[fx.Node, list[str]] = {}

    def write(self, layer: _Layer, sources: list[fx.Node], result: fx.Node) -> None:
        """Write one layer. A blob can be read once: one with several readers is split."""
        readers = sum(user.op != "output" for user in result.users)
        blob = result.name if readers else OUTPUT
        blob = blob if sources else str(result.target)
        self._lines.append((layer.type, [self._blobs[source].pop() for source in sources], [blob], layer.parameters))
        self._blobs[result] = [blob]
        if readers > 1:
            self._blobs[result] = [f"{blob}/{reader}" for reader in range(readers)]
            self._lines.append(("Split", [blob], [*self._blobs[result]], {}))
        for index, weight in enumerate(layer.weights):
            self.weights += (_FLOAT32 if index == 0 else b"") + weight.detach().float().contiguous().numpy().tobytes()

    def param(self) -> str:
        """Return the text of the `param` file."""
        blobs = sum(len(results) for _, _, results, _ in self._lines)
        lines = [
            " ".join([kind, f"layer{number}", str(len(sources)), str(len(results)), *sources, *results, *_text(of)])
            for number, (kind, sources, results, of) in enumerate(self._lines)
        ]
        return "\n".join([str(_MAGIC), f"{len(lines)} {blobs}", *lines, ""])


def _text(parameters: Parameters) -> list[str]:
    return [
        f"{-23300 - key}={len(value)},{','.join(map(repr, value))}" if isinstance(value, tuple) else f"{key}={value!r}"
        for key, value in parameters.items()
    ]


def _write_operation(writer: _Writer, graph: fx.GraphModule, node: fx.Node) -> None:
    """Write the layer for a node; an activation is part of the convolution that it alone reads."""
    if node.op == "call_function" and node.target in _ACTIVATIONS and _is_convolution(graph, node.args[0]):
        return
    layer, result = _layer(graph, node), node
    reader = next(iter(node.users))
    if _is_convolution(graph, node) and reader.op == "call_function" and reader.target in _ACTIVATIONS:
        layer.parameters.update(_ACTIVATIONS[reader.target])
        result = reader
    writer.write(layer, [source for source in node.args if isinstance(source, fx.Node)], result)


def _is_convolution(graph: fx.GraphModule, node: Any) -> bool:
    """Tell whether the node is a convolution that one layer reads."""
    return node.op == "call_module" and isinstance(graph.get_submodule(node.target), nn.Conv2d) and len(node.users) == 1


def _layer(graph: fx.GraphModule, node: fx.Node) -> _Layer:
    if node.op == "call_module":
        module = graph.get_submodule(str(node.target))
        for kind, describe in _MODULES.items():
            if isinstance(module, kind):
                return describe(module)
        raise EngineError(f"ncnn: layer {node.target} is a {type(module).__name__}, which is not known here")
    if node.target in _ARITHMETIC:
        return _Layer("BinaryOp", {0: _ARITHMETIC[node.target], **_scalar(node.args[1])})
    if node.target in _FUNCTIONS:
        return _FUNCTIONS[node.target](*node.args[1:], **node.kwargs)
    raise EngineError(f"ncnn: operation {node.target} is not known here")


def _scalar(argument: Any) -> Parameters:
    return {} if isinstance(argument, fx.Node) else {1: 1, 2: float(argument)}


def _convolution(module: nn.Conv2d) -> _Layer:
    (stride, _), (kernel, _) = module.stride, module.kernel_size
    before = after = int(module.padding[0])
    if isinstance(module, SameConv) and stride > 1:
        before, after = (kernel - stride) // 2, kernel - stride - (kernel - stride) // 2
    grouped: Parameters = {7: module.groups} if module.groups > 1 else {}
    parameters = _filter(module, module.out_channels) | {4: before, 14: before, 15: after, 16: after} | grouped
    return _Layer("ConvolutionDepthWise" if grouped else "Convolution", parameters, _weights(module.weight, module))


def _transposed_convolution(module: nn.ConvTranspose2d) -> _Layer:
    cropped = int(module.padding[0])
    parameters = _filter(module, module.out_channels) | dict.fromkeys((4, 14, 15, 16), cropped)
    return _Layer("Deconvolution", parameters, _weights(module.weight.transpose(0, 1), module))


def _filter(module: nn.Conv2d | nn.ConvTranspose2d, channels: int) -> Parameters:
    (stride, _), (kernel, _) = module.stride, module.kernel_size
    size, bias = module.weight.numel(), int(module.bias is not None)
    return {0: channels, 1: kernel, 11: kernel, 3: stride, 13: stride, 5: bias, 6: size}


def _weights(weight: Tensor, module: nn.Conv2d | nn.ConvTranspose2d) -> tuple[Tensor, ...]:
    return (weight,) if module.bias is None else (weight, module.bias)


def _padding(kind: int) -> Callable[[Any], _Layer]:
    def describe(module: nn.ReflectionPad2d | nn.ReplicationPad2d) -> _Layer:
        left, right, top, bottom = module.padding
        return _Layer("Padding", {0: top, 1: bottom, 2: left, 3: right, 4: kind})

    return describe


def _nearest(module: nn.Upsample) -> _Layer:
    scale = float(module.scale_factor)  # type: ignore[arg-type]
    return _Layer("Interp", {0: 1, 1: scale, 2: scale})


def _max_pool(kernel_size: int, stride: int, padding: int, **_: Any) -> _Layer:
    return _Layer(
        "Pooling",
        {0: 0, 5: 1}
        | dict.fromkeys((1, 11), kernel_size)
        | dict.fromkeys((2, 12), stride)
        | dict.fromkeys((3, 13, 14, 15), padding),
    )


_MODULES: dict[type[nn.Module], Callable[[Any], _Layer]] = {
    nn.Conv2d: _convolution,
    nn.ConvTranspose2d: _transposed_convolution,
    nn.ReflectionPad2d: _padding(_MIRRORED),
    nn.ReplicationPad2d: _padding(_REPEATED),
    nn.Upsample: _nearest,
    nn.ELU: lambda module: _Layer("ELU", {0: module.alpha}),
}

_FUNCTIONS: dict[Any, Callable[..., _Layer]] = {
    F.relu: lambda *_, **__: _Layer("ReLU"),
    F.relu6: lambda *_, **__: _Layer("Clip", {0: 0.0, 1: 6.0}),
    F.elu: lambda *_, **__: _Layer("ELU", {0: 1.0}),
    F.max_pool2d: _max_pool,
    sigmoid: lambda: _Layer("Sigmoid"),
}
