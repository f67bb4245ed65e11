# SPDX-License-Identifier: Apache-2.0
"""The network that is told its rig in a form that is quicker to run and gives the same depth.

A convolution over [x, skip, told] is the sum of three, and that over what the network is told is the same for every
picture of a camera: it is made once for each calibration, and only added when the network runs.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the field's name for it
from torch.nn.utils.fusion import fuse_conv_bn_eval

from cvcdepth_core.engines.conditioning import KeptForRig
from cvcdepth_core.engines.rewriting import fold_batch_norms, mirrored
from cvcdepth_core.networks import DepthOutputs, RigImages
from cvcdepth_core.networks.efficientnet_lite import EfficientNetLite0Encoder
from cvcdepth_core.networks.rig_conditioned import CHANNELS, RigConditionedNet

IMAGES = "images"
"""The first input of a rewritten network; `ToldConstants.names` are the others."""

_LEVELS = 5  # H/2 ... H/32


class RewrittenRigConditionedNet(nn.Module):
    """The part of the network that runs for every picture, equal to the one it was made from up to rounding."""

    def __init__(self, network: RigConditionedNet) -> None:
        super().__init__()
        network = copy.deepcopy(network).eval().requires_grad_(False)
        self.encoder = fold_batch_norms(_Encoder(network.depth_encoder))
        decoder = network.depth_decoder
        top, steps = _convolution(decoder.top), [_convolution(step) for step in decoder.steps]
        widths = [top.out_channels, *(step.out_channels for step in steps)]
        skips = [step.in_channels - CHANNELS - width for step, width in zip(steps, widths, strict=False)]
        self.top = mirrored(_part(top, 0, top.in_channels - CHANNELS))
        self.upsampling = nn.ModuleList(
            nn.Sequential(nn.Upsample(scale_factor=2), *mirrored(_part(step, 0, width)))
            for step, width in zip(steps, widths, strict=False)
        )
        self.skips = nn.ModuleList(
            mirrored(_part(step, width, width + skip, bias=False))
            for step, width, skip in zip(steps, widths, skips, strict=False)
        )
        self.head = mirrored(_convolution(decoder.head))

    def forward(
        self, images: Tensor, told_stem: Tensor, told_4: Tensor, told_3: Tensor, told_2: Tensor, told_1: Tensor,
        told_0: Tensor,
    ) -> Tensor:  # fmt: skip
        """Map images [M, 3, H, W] and what `ToldConstants` made of their cameras to the decoder's head."""
        head: Tensor = self.head(self.features(images, told_stem, told_4, told_3, told_2, told_1, told_0))
        return head

    def features(
        self, images: Tensor, told_stem: Tensor, told_4: Tensor, told_3: Tensor, told_2: Tensor, told_1: Tensor,
        told_0: Tensor,
    ) -> Tensor:  # fmt: skip
        """Return what the last convolution, `head`, makes its result from."""
        features = self.encoder(images, told_stem)
        x = F.elu(self.top(features[4]) + told_4)
        for step, (level, told) in enumerate(((3, told_3), (2, told_2), (1, told_1), (0, told_0))):
            x = F.elu(self.upsampling[step](x) + self.skips[step](features[level]) + told)
        return x


class ToldConstants(nn.Module):
    """What a rewritten network adds to its feature maps, of the conditioning."""

    names = ("told_stem", "told_4", "told_3", "told_2", "told_1", "told_0")
    """As `RewrittenRigConditionedNet.forward` calls them."""

    def __init__(self, network: RigConditionedNet) -> None:
        super().__init__()
        network = copy.deepcopy(network).eval().requires_grad_(False)
        self.stem = network.rig_stem
        self.register_buffer("stem_scale", _scale(network.depth_encoder.encoder.stem_norm))
        decoder = network.depth_decoder
        convolutions = [_convolution(layer) for layer in (decoder.top, *decoder.steps)]
        self.levels = nn.ModuleList(
            mirrored(_part(layer, layer.in_channels - CHANNELS, layer.in_channels, bias=False))
            for layer in convolutions
        )

    def forward(self, conditioning: Tensor) -> tuple[Tensor, ...]:
        """Map [M, C, H, W] to the six, and to the ground [M, 1, H, W] at the end."""
        told, ground = conditioning[:, :CHANNELS], conditioning[:, CHANNELS:]
        levels = [
            layer(F.avg_pool2d(told, 2 ** (level + 1)))
            for layer, level in zip(self.levels, reversed(range(_LEVELS)), strict=True)
        ]
        return (self.stem(told) * self.stem_scale, *levels, ground)


class ToldDetails:
    """The outputs of a network by an engine that runs its rewritten part, of pictures and of what it is told."""

    def __init__(self, network: RigConditionedNet, device: torch.device) -> None:
        constants = ToldConstants(network).to(device)
        self._network = network
        self._told = KeptForRig(lambda rig: constants(network.conditioning(rig).flatten(0, 1)))

    @torch.inference_mode()
    def __call__(self, rig: RigImages, run: Callable[[Mapping[str, Tensor]], Tensor]) -> DepthOutputs:
        """Return [B, N, 1, H, W] each; `run` takes what the rewritten network takes, by name, to the head."""
        *told, ground = self._told(rig)
        inputs = {IMAGES: rig.images.flatten(0, 1), **dict(zip(ToldConstants.names, told, strict=True))}
        outputs = self._network.from_head(run(inputs), ground)
        return outputs.map(lambda part: part.view(*rig.images.shape[:2], *part.shape[1:]))


class _Encoder(nn.Module):
    """The encoder with something added before its first activation; the batch normalisation there is folded."""

    def __init__(self, encoder: EfficientNetLite0Encoder) -> None:
        super().__init__()
        self.encoder = encoder
        self.stem = fuse_conv_bn_eval(encoder.encoder.stem, encoder.encoder.stem_norm)

    def forward(self, images: Tensor, added: Tensor) -> list[Tensor]:
        features: list[Tensor] = self.encoder.encoder.features(
            F.relu6(self.stem(self.encoder.normalised(images)) + added)
        )
        return features


def _scale(norm: nn.BatchNorm2d) -> Tensor:
    """Return by what a batch normalisation multiplies, [C, 1, 1]."""
    if norm.running_var is None:
        raise ValueError("a batch normalisation without statistics cannot be folded")
    return (norm.weight / torch.sqrt(norm.running_var + norm.eps))[:, None, None]


def _convolution(layer: nn.Module) -> nn.Conv2d:
    return next(found for found in layer.modules() if isinstance(found, nn.Conv2d))


def _part(convolution: nn.Conv2d, first: int, last: int, bias: bool = True) -> nn.Conv2d:
    """Return the part of a convolution that sees these input channels."""
    part = nn.Conv2d(last - first, convolution.out_channels, 3)
    part.weight = nn.Parameter(convolution.weight[:, first:last].contiguous(), requires_grad=False)
    part.bias = convolution.bias if bias else None
    return part
