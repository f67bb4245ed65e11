# SPDX-License-Identifier: Apache-2.0
"""PyTorch: the network as it was trained (the reference), rewritten, and compiled with CUDA graphs."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from cvcdepth_core.engines.conditioning import KeptForRig, KeptForWholeRig, conditioning_of
from cvcdepth_core.engines.engine import best_chunk, image_by_image
from cvcdepth_core.engines.rewriting import RewrittenDepthNet
from cvcdepth_core.engines.rewriting_conditioned import RewrittenRigConditionedNet, ToldDetails
from cvcdepth_core.model_choices import Precision
from cvcdepth_core.networks import ConditionedNetwork, DepthNet, DepthNetwork, DepthOutputs, RigImages
from cvcdepth_core.networks.rig_conditioned import RigConditionedNet
from cvcdepth_core.networks.vfdepth import FusedDepthNet


class TorchEagerEngine:
    """The network itself, operation by operation."""

    def __init__(self, network: DepthNetwork, device: torch.device) -> None:
        self.name = f"torch_eager {torch.__version__}"
        self.device = device
        self.chunk = best_chunk(network, device)
        self._network = copy.deepcopy(network).eval().to(device)
        self._told = (
            KeptForRig(conditioning_of(self._network)) if isinstance(self._network, ConditionedNetwork) else None
        )
        self._geometry = KeptForWholeRig(self._network.geometry) if isinstance(self._network, FusedDepthNet) else None

    def disparity(self, rig: RigImages) -> Tensor:
        """See `DisparityEngine`."""
        return self.details(rig).disparity

    @torch.inference_mode()
    def details(self, rig: RigImages) -> DepthOutputs:
        """See `DetailedEngine`."""
        if isinstance(self._network, ConditionedNetwork) and self._told is not None:
            found = self._network.outputs(rig.images.flatten(0, 1), *self._told(rig))
            return found.map(lambda part: part.view(*rig.images.shape[:2], *part.shape[1:]))
        if isinstance(self._network, FusedDepthNet) and self._geometry is not None:
            return DepthOutputs(self._network.disparity(rig.images, self._geometry(rig)))
        return self._network.details(rig)


class TorchEngine:
    """The rewritten network with channels last; compiled, its kernels are fused and replayed as a CUDA graph."""

    def __init__(
        self, network: DepthNet, device: torch.device, precision: Precision = "float32", compiled: bool = False
    ) -> None:
        self.name = f"{'torch_compiled' if compiled else 'torch'} {torch.__version__} {precision}"
        self.device = device
        self.chunk = best_chunk(network, device)
        mixed = MixedPrecision(RewrittenDepthNet(network), getattr(torch, precision))
        mixed = mixed.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._run: Callable[[Tensor], Tensor] = mixed
        if compiled:
            self._run = PaddedBatches(CudaGraphs(torch.compile(mixed, dynamic=False)))

    @torch.inference_mode()
    def disparity(self, rig: RigImages) -> Tensor:
        """See `DisparityEngine`."""
        return image_by_image(lambda images: self._run(images.contiguous(memory_format=torch.channels_last)), rig)


class ConditionedTorchEngine:
    """The rewritten network that is told its rig, with channels last; its head and all after it in float32."""

    def __init__(self, network: RigConditionedNet, device: torch.device, precision: Precision = "float32") -> None:
        self.name = f"torch {torch.__version__} {precision}"
        self.device = device
        self.chunk = best_chunk(network, device)
        self._dtype = getattr(torch, precision)
        rewritten = RewrittenRigConditionedNet(network).to(device, self._dtype)
        rewritten.head.float()
        self._rewritten = rewritten.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._details = ToldDetails(network, device)

    def disparity(self, rig: RigImages) -> Tensor:
        """See `DisparityEngine`."""
        return self.details(rig).disparity

    def details(self, rig: RigImages) -> DepthOutputs:
        """See `DetailedEngine`."""
        return self._details(rig, self._run)

    def _run(self, inputs: Mapping[str, Tensor]) -> Tensor:
        given = [part.to(self._dtype).contiguous(memory_format=torch.channels_last) for part in inputs.values()]
        head: Tensor = self._rewritten.head(self._rewritten.features(*given).float())
        return head


class PaddedBatches:
    """Fills batches up to a size that has come before, of at most twice theirs: each size is compiled anew.

    When a camera dies, the others must not wait for a compiler; where few cameras are wanted, few are computed.
    """

    def __init__(self, network: Callable[[Tensor], Tensor]) -> None:
        self._network = network
        self._sizes: set[int] = set()

    def __call__(self, images: Tensor) -> Tensor:
        """Return what the network gives for these images."""
        count = len(images)
        size = min((known for known in self._sizes if count <= known <= 2 * count), default=count)
        padded = torch.cat([images, images.new_zeros(size - count, *images.shape[1:])])
        try:
            given = self._network(padded.contiguous(memory_format=torch.channels_last))
        except RuntimeError:
            self._sizes.discard(size)  # memory that held so many pictures may not do so for ever
            raise
        self._sizes.add(size)
        return given[:count]


class CudaGraphs:
    """A network whose kernels are recorded once per shape of its input, and then started all at once.

    torch's own `reduce-overhead` does this too, but only in the thread that compiled; the node infers in another.
    """

    def __init__(self, network: Callable[[Tensor], Tensor]) -> None:
        self._network = network
        self._recorded: dict[torch.Size, tuple[torch.cuda.CUDAGraph, Tensor, Tensor]] = {}

    def __call__(self, images: Tensor) -> Tensor:
        """Return what the network gives, in memory of its own."""
        with torch.cuda.device(images.device):
            if images.shape not in self._recorded:
                self._recorded[images.shape] = self._record(images.clone())
            graph, taken, given = self._recorded[images.shape]
            taken.copy_(images)
            graph.replay()
            return given.clone()

    def _record(self, images: Tensor) -> tuple[torch.cuda.CUDAGraph, Tensor, Tensor]:
        """Run it aside until all is compiled and chosen, then record, as torch's documentation of CUDA graphs says."""
        aside = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(3):
                self._network(images)
        torch.cuda.current_stream().wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            given = self._network(images)
        return graph, images, given


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
