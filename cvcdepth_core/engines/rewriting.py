# SPDX-License-Identifier: Apache-2.0
"""The depth network in a form that is quicker to run and gives the same depth.

Batch normalisations are part of the convolutions before them. The decoder neither stretches its feature maps nor joins
them with the encoder's: a convolution over [stretched x, skip] is the sum of one over skip and one over stretched x,
and the latter sees each pixel of x four times, so that a transposed convolution of x with sums of the same weights
gives it with 4/9 of the work. Mirroring the stretched map at its border is repeating the border of x. An engine that
convolves by Winograd's method multiplies still less over the stretched map.

What remains is written with plain modules and a few functions, which other engines' graphs are made from.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, fx, nn
from torch.nn import functional as F  # noqa: N812 - the field's name for it
from torch.nn.utils.fusion import fuse_conv_bn_eval

from cvcdepth_core.networks import DepthNet
from cvcdepth_core.networks.depth import DepthDecoder

# Row k: which of the three taps over a stretched line meet, in tap k of the transposed convolution, the same pixel.
_MEETING_TAPS = ((0, 0, 1), (0, 1, 1), (1, 1, 0), (1, 0, 0))


class RewrittenDepthNet(nn.Module):
    """A depth network for inference only, equal to the one it was made from up to rounding.

    With `transposed` False the feature maps are stretched after all.
    """

    def __init__(self, network: DepthNet, transposed: bool = True) -> None:
        super().__init__()
        network = copy.deepcopy(network).eval().requires_grad_(False)
        self.encoder = fold_batch_norms(network.depth_encoder)
        self.decoder = RewrittenDecoder(network.depth_decoder, transposed)

    def forward(self, images: Tensor) -> Tensor:
        """Return the disparity [B, 1, H, W] in (0, 1) of `images` [B, 3, H, W] in [0, 1]; H, W multiples of 32."""
        disparity: Tensor = torch.sigmoid(self.decoder.head(self.features(images)))
        return disparity

    def features(self, images: Tensor) -> Tensor:
        """Return what the last convolution, `decoder.head`, makes disparity from."""
        features: Tensor = self.decoder(self.encoder(images))
        return features


class RewrittenDecoder(nn.Module):
    """`DepthDecoder` without joined feature maps."""

    def __init__(self, decoder: DepthDecoder, transposed: bool) -> None:
        super().__init__()
        levels = len(decoder.decoder) // 2
        before = [_convolution(decoder, 2 * step) for step in range(levels)]
        after = [_convolution(decoder, 2 * step + 1) for step in range(levels)]
        widths = [convolution.out_channels for convolution in before]
        self.before_upsampling = nn.ModuleList(nn.Sequential(mirrored(c), nn.ELU(inplace=True)) for c in before)
        self.upsampling = nn.ModuleList(
            upsampled(_inputs(c, 0, n), transposed) for c, n in zip(after, widths, strict=True)
        )
        self.skips = nn.ModuleList(
            mirrored(_without_bias(_inputs(c, n, c.in_channels))) for c, n in zip(after[:-1], widths, strict=False)
        )
        self.head = mirrored(_convolution(decoder, -1))

    def forward(self, features: Sequence[Tensor]) -> Tensor:
        """Turn five feature maps, finest (H/2) first, into the one [B, C, H, W] that `head` takes."""
        x = features[-1]
        for level, (before, upsample) in enumerate(zip(self.before_upsampling, self.upsampling, strict=True)):
            x = upsample(before(x))
            if level < len(self.skips):
                x = x + self.skips[level](features[-2 - level])
            x = F.elu(x, inplace=True)
        return x


def fold_batch_norms(network: nn.Module) -> fx.GraphModule:
    """Return the network, in evaluation mode, with each batch normalisation folded into the convolution before it."""
    tracer = ConvolutionTracer()
    folded = fx.GraphModule(network.eval(), tracer.trace(network))
    for node in list(folded.graph.nodes):
        if node.op == "call_module" and isinstance(norm := folded.get_submodule(node.target), nn.BatchNorm2d):
            (convolution,) = node.args
            fused = fuse_conv_bn_eval(cast("nn.Conv2d", folded.get_submodule(convolution.target)), norm)
            folded.set_submodule(convolution.target, fused)
            node.replace_all_uses_with(convolution)
            folded.graph.erase_node(node)
    folded.delete_all_unused_submodules()
    folded.recompile()
    return folded


class ConvolutionTracer(fx.Tracer):
    """Follows a network down to its layers; also a convolution of a class of our own is one."""

    def is_leaf_module(self, m: nn.Module, module_qualified_name: str) -> bool:
        """Tell whether to stop here."""
        return isinstance(m, nn.Conv2d) or super().is_leaf_module(m, module_qualified_name)


def mirrored(convolution: nn.Conv2d) -> nn.Sequential:
    """Return a 3x3 convolution over a border that repeats the picture mirrored, as two plain layers."""
    plain = nn.Conv2d(convolution.in_channels, convolution.out_channels, 3, bias=convolution.bias is not None)
    plain.weight, plain.bias = convolution.weight, convolution.bias
    return nn.Sequential(nn.ReflectionPad2d(1), plain)


def upsampled(convolution: nn.Conv2d, transposed: bool) -> nn.Sequential:
    """Return what stretches x [B, in, h, w] to twice its size and then convolves it as `mirrored` does."""
    if not transposed:
        return nn.Sequential(nn.Upsample(scale_factor=2), *mirrored(convolution))
    joined = nn.ConvTranspose2d(convolution.in_channels, convolution.out_channels, 4, stride=2, padding=3)
    taps = torch.tensor(_MEETING_TAPS, dtype=torch.float64)
    weight = torch.einsum("ai,bj,ocij->coab", taps, taps, convolution.weight.double())
    joined.weight = nn.Parameter(weight.to(convolution.weight.dtype), requires_grad=False)
    joined.bias = convolution.bias
    return nn.Sequential(nn.ReplicationPad2d(1), joined)


def _convolution(decoder: DepthDecoder, index: int) -> nn.Conv2d:
    return next(layer for layer in decoder.decoder[index].modules() if isinstance(layer, nn.Conv2d))


def _inputs(convolution: nn.Conv2d, first: int, last: int) -> nn.Conv2d:
    """Return the part of a convolution that sees these input channels."""
    part = nn.Conv2d(last - first, convolution.out_channels, 3)
    part.weight = nn.Parameter(convolution.weight[:, first:last].contiguous(), requires_grad=False)
    part.bias = convolution.bias
    return part


def _without_bias(convolution: nn.Conv2d) -> nn.Conv2d:
    convolution.bias = None
    return convolution
