# SPDX-License-Identifier: Apache-2.0
"""PyTorch: the network as it was trained (the reference), rewritten, and compiled with CUDA graphs."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from cvcdepth_core.engines.engine import Precision
from cvcdepth_core.engines.rewriting import RewrittenDepthNet
from cvcdepth_core.networks import DepthNet


class TorchEagerEngine:
    """The network itself, operation by operation."""

    def __init__(self, network: DepthNet, device: torch.device) -> None:
        self.name = f"torch_eager {torch.__version__}"
        self.device = device
        self._network = copy.deepcopy(network).eval().to(device)

    @torch.inference_mode()
    def disparity(self, images: Tensor) -> Tensor:
        """See `DisparityEngine`."""
        disparity: Tensor = self._network(images)
        return disparity


class TorchEngine:
    """The rewritten network with channels last; compiled, its kernels are fused and replayed as one CUDA graph."""

    def __init__(
        self, network: DepthNet, device: torch.device, precision: Precision = "float32", compiled: bool = False
    ) -> None:
        self.name = f"{'torch_compiled' if compiled else 'torch'} {torch.__version__} {precision}"
        self.device = device
        rewritten = MixedPrecision(RewrittenDepthNet(network), getattr(torch, precision))
        self._network: nn.Module = rewritten.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if compiled:
            self._network = torch.compile(self._network, mode="reduce-overhead", dynamic=False)  # type: ignore[assignment]

    @torch.inference_mode()
    def disparity(self, images: Tensor) -> Tensor:
        """See `DisparityEngine`."""
        disparity: Tensor = self._network(images.contiguous(memory_format=torch.channels_last))
        return disparity.clone()  # a CUDA graph writes its next result where it wrote this one


class MixedPrecision(nn.Module):
    """Features in half precision, disparity from them in float32: far away, depth is made of its last digits."""

    def __init__(self, network: RewrittenDepthNet, dtype: torch.dtype) -> None:
        super().__init__()
        self._network = network.to(dtype)
        self._network.decoder.head.float()
        self._dtype = dtype

    def forward(self, images: Tensor) -> Tensor:
        """Map float32 images to float32 disparity."""
        features = self._network.features(images.to(self._dtype))
        return torch.sigmoid(self._network.decoder.head(features.float()))
