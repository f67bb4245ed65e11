# SPDX-License-Identifier: Apache-2.0
"""SurroundDepth: the per-camera network whose features look at those of all cameras (Wei et al., CoRL 2022).

At each of the encoder's five levels a transformer over the tokens of all cameras gives what is added to the features.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the field's name for it

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.networks.depth import ConvELU, ReflectConv, refuse_input_size
from cvcdepth_core.networks.encoders import build_encoder
from cvcdepth_core.networks.rig_images import DepthNetwork, RigImages

LEVELS = 5

_STRIDES = (16, 8, 4, 2, 1)
_DILATIONS = (7, 3, 1, 1, 1)
_KERNELS = (3, 3, 3, 1, 1)
_LONGEST_WAVE = 10000.0


class CrossViewSpec(BaseModel):
    """The transformers of a network that looks across its cameras; blocks, heads and layout of the tokens."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    blocks: int = Field(default=8, ge=1)
    """Transformer blocks at each level."""
    heads: int = Field(default=8, ge=1)
    """Heads of each block's attention; they divide the encoder's widths."""
    scales: int = Field(default=1, ge=1, le=4)
    """Resolutions that have a head for disparity, the full one first; the released weights have four."""
    released_layout: bool = False
    """Read each camera's tokens after every block as if they had been transposed, as the published program does, and as
    its weights have learnt."""
    added: bool = True
    """Whether the answer is added to the features, or replaces them."""


class CrossViewDepthNet(DepthNetwork):
    """SurroundDepth: every camera's features look at those of all cameras, at all five levels of the encoder."""

    independent: ClassVar[bool] = False
    engines: ClassVar[tuple[str, ...]] = ("torch_eager", "onnxruntime")

    def __init__(self, encoder: str, cross_view: CrossViewSpec) -> None:
        """ConfigError when the heads do not divide the encoder's widths."""
        super().__init__()
        self.cross_view = cross_view
        self.depth_encoder = build_encoder(encoder)
        widths = self.depth_encoder.channels
        if any(width % cross_view.heads for width in widths):
            raise ConfigError(
                f"depth.cross_view.heads is {cross_view.heads}, which does not divide the widths of {encoder}: {widths}"
            )
        self.fusion = nn.ModuleList(CrossViewTransformer(widths[level], level, cross_view) for level in range(LEVELS))
        self.depth_decoder = PyramidDecoder(widths, self.depth_encoder.decoder_channels, cross_view.scales)

    def forward(self, rig: RigImages) -> Tensor:
        """Return the disparity [B, N, 1, H, W]; ImageError when H or W is not a multiple of 32 or below 64."""
        return self.pyramid(rig)[0]

    def pyramid(self, rig: RigImages) -> list[Tensor]:
        """Return the disparity [B, N, 1, H / 2^s, W / 2^s] of every scale that has a head."""
        refuse_input_size(*rig.images.shape[-2:])
        disparities: list[Tensor] = self.depth_decoder(self.fused_features(rig))
        return [one.view(*rig.images.shape[:2], *one.shape[1:]) for one in disparities]

    def fused_features(self, rig: RigImages) -> list[Tensor]:
        """Return the feature maps [B N, C, h, w], finest (H/2) first, after what the other cameras gave."""
        features = self.depth_encoder(rig.images.flatten(0, 1))
        fused = []
        for own, transformer in zip(features, self.fusion, strict=True):
            answer = transformer(own.view(*rig.images.shape[:2], *own.shape[1:]), rig.present).flatten(0, 1)
            fused.append(own + answer if self.cross_view.added else answer)
        return fused


class CrossViewTransformer(nn.Module):
    """Attention of all cameras' tokens to each other, on a grid of 1/32 of the picture."""

    def __init__(self, channels: int, level: int, spec: CrossViewSpec) -> None:
        """`level` is that of the features, 0 at H/2 to 4 at H/32."""
        super().__init__()
        self._released_layout = spec.released_layout
        self.down = DownProjection(channels, _STRIDES[level])
        self.blocks = nn.ModuleList(Block(channels, spec.heads) for _ in range(spec.blocks))
        self.up = UpProjection(channels, _STRIDES[level], _DILATIONS[level], _KERNELS[level])

    def forward(self, features: Tensor, seen: Tensor) -> Tensor:
        """Return the answer [B, N, C, H, W] to features of that size; cameras not `seen` [B, N] give nothing."""
        samples, cameras = features.shape[:2]
        x = self.down(features.flatten(0, 1))
        height, width = x.shape[-2:]
        places = height * width
        tokens = x.view(samples, cameras, -1, places).transpose(2, 3)  # [B, N, h w, C]
        at = sine_positions(x).flatten(1).transpose(0, 1).repeat(cameras, 1)  # [N h w, C]
        # Where no camera is there at all, any answer will do, but a number.
        keys = (seen | ~seen.any(dim=1, keepdim=True)).repeat_interleave(places, dim=1)
        for block in self.blocks:
            tokens = block(tokens.flatten(1, 2), at, keys).view(samples, cameras, places, -1)
            if self._released_layout:
                tokens = tokens.reshape(samples, cameras, -1, places).transpose(2, 3)
        x = tokens.transpose(2, 3).reshape(samples * cameras, -1, height, width)
        answer: Tensor = self.up(x)
        return answer.view(samples, cameras, *answer.shape[1:])


def sine_positions(like: Tensor) -> Tensor:
    """Return the coded places [C, h, w] of a grid of the size of `like` [..., C, h, w], rows in the first channels."""
    channels, height, width = like.shape[-3:]
    half = channels // 2
    k = torch.arange(half, device=like.device, dtype=like.dtype)
    frequency = _LONGEST_WAVE ** (-2 * torch.div(k, 2, rounding_mode="floor") / half)
    waves = []
    for count in (height, width):
        phase = torch.arange(1, count + 1, device=like.device, dtype=like.dtype) * frequency[:, None]
        waves.append(torch.where((k % 2 == 0)[:, None], phase.sin(), phase.cos()))
    rows, columns = waves
    return torch.cat([rows[:, :, None].expand(-1, -1, width), columns[:, None].expand(-1, height, -1)])


class DownProjection(nn.Module):
    """Every r-th pixel, mixed."""

    def __init__(self, channels: int, stride: int) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(channels, channels, 1, stride, groups=channels, bias=False)
        self.pointwise = nn.Conv2d(channels, channels, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map [M, C, H, W] to [M, C, H / r, W / r]."""
        out: Tensor = self.pointwise(self.depthwise(x))
        return out


class UpProjection(nn.Module):
    """Each token given to the pixels around its place that a dilated kernel reaches; the others get a constant."""

    def __init__(self, channels: int, stride: int, dilation: int, kernel: int) -> None:
        super().__init__()
        self.depthwise = nn.ConvTranspose2d(
            channels,
            channels,
            kernel,
            stride,
            output_padding=stride - 1 - dilation * (kernel - 1),
            groups=channels,
            dilation=dilation,
        )
        self.pointwise = nn.Conv2d(channels, channels, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map [M, C, h, w] to [M, C, r h, r w]."""
        out: Tensor = self.pointwise(self.depthwise(x))
        return out


class Block(nn.Module):
    """Attention and a perceptron, each after a normalisation and added to what it was given."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.attention = Attention(channels, heads)
        self.hidden, self.out = nn.Linear(channels, 4 * channels), nn.Linear(4 * channels, channels)

    def forward(self, tokens: Tensor, at: Tensor, keys: Tensor) -> Tensor:
        """Return tokens [B, T, C]; `at` [T, C] are their coded places, `keys` [B, T] which of them may be looked at."""
        tokens = tokens + self.attention(self.norm1(tokens), at, keys)
        changed: Tensor = self.out(F.gelu(self.hidden(self.norm2(tokens))))
        return tokens + changed


class Attention(nn.Module):
    """Attention with several heads, whose queries and keys know their places."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self._heads = heads
        self.query, self.key, self.value = (nn.Linear(channels, channels, bias=False) for _ in range(3))
        self.answer = nn.Linear(channels, channels)

    def forward(self, tokens: Tensor, at: Tensor, keys: Tensor) -> Tensor:
        """See `Block`."""
        asked, told = tokens + at, tokens
        query, key, value = (
            layer(given).unflatten(-1, (self._heads, -1)).transpose(1, 2)
            for layer, given in ((self.query, asked), (self.key, asked), (self.value, told))
        )
        found = F.scaled_dot_product_attention(query, key, value, keys[:, None, None])
        answer: Tensor = self.answer(found.transpose(1, 2).flatten(2))
        return answer


class PyramidDecoder(nn.Module):
    """The published network's decoder, with a head at each of the finest scales."""

    def __init__(self, encoder_channels: Sequence[int], decoder_channels: Sequence[int], scales: int) -> None:
        """Take the widths at H/2 ... H/32 of the encoder and at H ... H/16 of this decoder."""
        super().__init__()
        in_channels = encoder_channels[-1]
        layers: list[nn.Module] = []
        for level in reversed(range(LEVELS)):
            out_channels = decoder_channels[level]
            skip_channels = encoder_channels[level - 1] if level > 0 else 0
            layers += [ConvELU(in_channels, out_channels), ConvELU(out_channels + skip_channels, out_channels)]
            in_channels = out_channels
        layers += [ReflectConv(decoder_channels[scale], 1) for scale in range(scales)]
        self._scales = scales
        self.decoder = nn.ModuleList(layers)

    def forward(self, features: Sequence[Tensor]) -> list[Tensor]:
        """Turn five feature maps, finest (H/2) first, into disparity in (0, 1) of each scale, [M, 1, H, W] first."""
        x, found = features[-1], []
        for step, level in enumerate(reversed(range(LEVELS))):
            x = F.interpolate(self.decoder[2 * step](x), scale_factor=2.0, mode="nearest")
            if level > 0:
                x = torch.cat([x, features[level - 1]], dim=1)
            x = self.decoder[2 * step + 1](x)
            if level < self._scales:
                found.append(torch.sigmoid(self.decoder[2 * LEVELS + level](x)))
        return found[::-1]


def _names_of_level(level: int) -> dict[str, str]:
    theirs, ours = f"decoder_cross.{level}.", f"fusion.{level}."
    within = {
        "sep_conv.conv1.": "down.depthwise.",
        "sep_conv.pointwise.": "down.pointwise.",
        "sep_deconv.conv1.": "up.depthwise.",
        "sep_deconv.pointwise.": "up.pointwise.",
        "attn.q_linear.": "attention.query.",
        "attn.k_linear.": "attention.key.",
        "attn.v_linear.": "attention.value.",
        "attn.proj.": "attention.answer.",
        "mlp.fc1.": "hidden.",
        "mlp.fc2.": "out.",
        "norm1.": "norm1.",
        "norm2.": "norm2.",
    }
    outside = [name for name in within if name.startswith("sep_")]
    names = {theirs + name: ours + within[name] for name in outside}
    for block in range(CrossViewSpec().blocks):
        for name in within.keys() - set(outside):
            names[f"{theirs}decoder.{block}.{name}"] = f"{ours}blocks.{block}.{within[name]}"
    return names


ENCODER_NAMES = {"encoder.": "depth_encoder.encoder."}
"""How the names of parameters begin in the released encoder.pth, and in ours."""

DECODER_NAMES = {
    "decoder.": "depth_decoder.decoder.",
    **{theirs: ours for level in range(LEVELS) for theirs, ours in _names_of_level(level).items()},
}
"""How the names of parameters begin in the released depth.pth, and in ours."""
