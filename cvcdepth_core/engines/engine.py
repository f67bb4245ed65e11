# SPDX-License-Identifier: Apache-2.0
"""What every inference engine offers."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from cvcdepth_core.errors import EngineError
from cvcdepth_core.networks import DepthNetwork, DepthOutputs, RigImages


class DeviceMemoryError(EngineError):
    """The device has too little memory for so many cameras at once."""


def best_chunk(network: DepthNetwork, device: torch.device) -> int | None:
    """Return how many cameras torch and ONNX Runtime take best at a time: one on a CPU, all on a GPU.

    One by one, a camera's depth depends on no other camera, to the last bit; it is also quicker than all at once, for
    the feature maps of one stay in the cache. A network whose cameras are not independent has to see all.
    """
    return 1 if network.independent and device.type == "cpu" else None


def image_by_image(run: Callable[[Tensor], Tensor], rig: RigImages) -> Tensor:
    """Return the disparity [B, N, 1, H, W] by an engine's `run`, which takes images [B*N, 3, H, W] alone."""
    disparity = run(rig.images.flatten(0, 1))
    return disparity.view(*rig.images.shape[:2], *disparity.shape[1:])


class DisparityEngine(Protocol):
    """A depth network made ready to run on one device."""

    @property
    def name(self) -> str:
        """Say what computes, with its version and precision, for results and diagnostics."""

    @property
    def device(self) -> torch.device:
        """Where it takes its images."""

    @property
    def chunk(self) -> int | None:
        """How many cameras it takes best at a time; None: all there are."""

    def disparity(self, rig: RigImages) -> Tensor:
        """Return the disparity [B, N, 1, H, W] in (0, 1) of a rig's images, float32 on `device`.

        Raises DeviceMemoryError, or torch's own error, when the device's memory is too small for so many cameras.
        """


@runtime_checkable
class DetailedEngine(DisparityEngine, Protocol):
    """An engine that also gives what the network says beside disparity."""

    def details(self, rig: RigImages) -> DepthOutputs:
        """Return all outputs [B, N, 1, H, W] of a rig's images, of which `disparity` returns the first."""


def details_of(engine: DisparityEngine, rig: RigImages) -> DepthOutputs:
    """Return all that an engine gives for a rig's images, [B, N, 1, H, W]."""
    return engine.details(rig) if isinstance(engine, DetailedEngine) else DepthOutputs(engine.disparity(rig))
