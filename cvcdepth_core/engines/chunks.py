# SPDX-License-Identifier: Apache-2.0
"""How many cameras go through an engine at a time, and what happens when the GPU's memory is too small for them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from cvcdepth_core.engines.engine import DeviceMemoryError, DisparityEngine
from cvcdepth_core.errors import EngineError


class ChunkedEngine:
    """Runs an engine on chunks of images: as many as it takes best, on a GPU as many as its memory takes."""

    chunk = None

    def __init__(self, engine: DisparityEngine, fallback: Callable[[], DisparityEngine] | None = None) -> None:
        """`fallback` builds the engine to go on with when the device has too little memory even for one image."""
        self._engine = engine
        self._fallback = fallback
        self._chunk = engine.chunk

    @property
    def name(self) -> str:
        """The engine's name; another one from the moment when the fallback took over."""
        return self._engine.name

    @property
    def device(self) -> torch.device:
        """Where the engine takes its images."""
        return self._engine.device

    def disparity(self, images: Tensor) -> Tensor:
        """See `DisparityEngine`. A size that the memory did not take is not tried again.

        Raises EngineError when it does not take one image and there is no fallback.
        """
        while True:
            try:
                chunks = images.to(self.device).split(self._chunk or len(images))  # type: ignore[no-untyped-call]
                return torch.cat([self._engine.disparity(chunk) for chunk in chunks])
            except (torch.cuda.OutOfMemoryError, DeviceMemoryError) as error:
                self._give_way(min(self._chunk or len(images), len(images)), error)

    def _give_way(self, tried: int, error: Exception) -> None:
        torch.cuda.empty_cache()
        if tried > 1:
            self._chunk = tried // 2
            return
        if self._fallback is None:
            raise EngineError(
                f"{self.name}: out of memory on {self.device} with a single image: {str(error).splitlines()[0]}"
            ) from error
        self._engine, self._fallback = self._fallback(), None
        self._chunk = self._engine.chunk
