# SPDX-License-Identifier: Apache-2.0
"""What every inference engine offers."""

from typing import Protocol

import torch
from torch import Tensor

from cvcdepth_core.errors import EngineError


class DeviceMemoryError(EngineError):
    """The device has too little memory for so many images at once."""


def best_chunk(device: torch.device) -> int | None:
    """Return how many images torch and ONNX Runtime take best at a time on the device: one on a CPU, all on a GPU.

    One by one, a camera's depth depends on no other camera, to the last bit; it is also quicker than all at once, for
    the feature maps of one stay in the cache.
    """
    return 1 if device.type == "cpu" else None


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
        """How many images it takes best at a time; None: all there are."""

    def disparity(self, images: Tensor) -> Tensor:
        """Return the disparity [B, 1, H, W] in (0, 1) of `images` [B, 3, H, W] in [0, 1], float32 on `device`.

        Raises DeviceMemoryError, or torch's own error, when the device's memory is too small for B images.
        """
