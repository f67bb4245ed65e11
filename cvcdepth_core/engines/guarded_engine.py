# SPDX-License-Identifier: Apache-2.0
"""How many cameras go through an engine at a time, and what happens when its device has too little memory, or fails."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from cvcdepth_core.engines.engine import DeviceMemoryError, DisparityEngine
from cvcdepth_core.errors import EngineError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.surround import to_tensor


class GuardedEngine:
    """Runs an engine on as many pictures at a time as it takes best and its memory holds, and replaces it if it fails.

    A GPU works behind the program's back and tells its faults later: a result counts when it has left the device whole.
    """

    def __init__(self, engine: DisparityEngine, fallback: Callable[[], DisparityEngine] | None = None) -> None:
        """`fallback` builds the engine to go on with when the device fails, or cannot hold even one picture."""
        self._engine = engine
        self._fallback = fallback
        self._chunk = engine.chunk

    @property
    def name(self) -> str:
        """The engine's name; another one from the moment when the fallback took over."""
        return self._engine.name

    @property
    def device(self) -> torch.device:
        """Where the engine computes."""
        return self._engine.device

    def disparity(self, pictures: Sequence[Picture]) -> Tensor:
        """Return the disparity [N, 1, H, W] in (0, 1), float32 on the CPU, of RGB pictures [H, W, 3].

        A number of pictures that the memory did not hold is not tried again. Raises EngineError when the device fails
        or does not hold one picture, and there is no fallback.
        """
        while True:
            chunk = min(self._chunk or len(pictures), len(pictures))
            try:
                return self._in_chunks(pictures, chunk)
            except (torch.cuda.OutOfMemoryError, DeviceMemoryError) as error:
                if chunk == 1:
                    self._replace("out of memory with a single picture", error)
                else:
                    torch.cuda.empty_cache()
                    self._chunk = chunk // 2
            except (RuntimeError, EngineError) as error:  # torch's word for a lost GPU is a RuntimeError
                self._replace("failed", error)

    def _in_chunks(self, pictures: Sequence[Picture], chunk: int) -> Tensor:
        chunks = [pictures[start : start + chunk] for start in range(0, len(pictures), chunk)]
        return torch.cat([self._engine.disparity(to_tensor(part, self.device)).cpu() for part in chunks])

    def _replace(self, what: str, error: Exception) -> None:
        if self._fallback is None:
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise EngineError(f"{self.name} on {self.device}: {what}: {reason}") from error
        self._engine, self._fallback = self._fallback(), None
        self._chunk = self._engine.chunk
