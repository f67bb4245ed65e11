# SPDX-License-Identifier: Apache-2.0
"""How many cameras go through an engine at a time, and what happens when its device has too little memory, or fails."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvcdepth_core.engines.engine import DeviceMemoryError, DisparityEngine, details_of
from cvcdepth_core.errors import EngineError
from cvcdepth_core.networks import DepthOutputs, RigImages
from cvcdepth_core.surround_depth import SurroundPictures


class GuardedEngine:
    """Runs an engine on as many cameras at a time as it takes best and its memory holds, and replaces it if it fails.

    Of a network that looks at all cameras together, none is left out and none runs apart from the others.

    A GPU works behind the program's back and tells its faults later: a result counts when it has left the device whole.
    """

    def __init__(
        self, engine: DisparityEngine, independent: bool, fallback: Callable[[], DisparityEngine] | None = None
    ) -> None:
        """`independent` is as the network declares it.

        `fallback` builds the engine to go on with when the device fails, or cannot hold even one picture.
        """
        self.independent = independent
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

    def disparity(self, surround: SurroundPictures) -> Tensor:
        """Return the disparity [N, 1, H, W] in (0, 1); see `details`."""
        return self.details(surround).disparity

    def details(self, surround: SurroundPictures) -> DepthOutputs:
        """Return all that the network says, [N, 1, H, W] each, float32 on the CPU; absent cameras' means nothing.

        A number of cameras that the memory did not hold is not tried again. Raises EngineError when the device fails
        or does not hold the least that the network can take, and there is no fallback.
        """
        everyone = np.arange(len(surround.present))
        cameras = everyone[surround.present] if self.independent else everyone
        while True:
            chunk = max(1, min(self._chunk or len(cameras), len(cameras)))
            try:
                return self._in_chunks(surround, cameras, chunk)
            except (torch.cuda.OutOfMemoryError, DeviceMemoryError) as error:
                if not self.independent:
                    self._replace("out of memory with all cameras, which the network must see together", error)
                elif chunk == 1:
                    self._replace("out of memory with a single picture", error)
                else:
                    torch.cuda.empty_cache()
                    self._chunk = chunk // 2
            except (RuntimeError, EngineError) as error:  # torch's word for a lost GPU is a RuntimeError
                self._replace("failed", error)

    def _in_chunks(self, surround: SurroundPictures, cameras: NDArray[np.intp], chunk: int) -> DepthOutputs:
        found = []
        for start in range(0, len(cameras), chunk):
            rig = RigImages.from_pictures(surround, cameras[start : start + chunk], self.device)
            found.append(details_of(self._engine, rig).map(lambda part: part[0].cpu()))
        absent = torch.zeros(len(surround.present), 1, *surround.pictures.shape[1:3])
        if not found:
            return DepthOutputs(absent)
        placed = torch.from_numpy(cameras)
        return _joined(found).map(lambda part: absent.index_copy(0, placed, part))

    def _replace(self, what: str, error: Exception) -> None:
        if self._fallback is None:
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise EngineError(f"{self.name} on {self.device}: {what}: {reason}") from error
        self._engine, self._fallback = self._fallback(), None
        self._chunk = self._engine.chunk


def _joined(parts: Sequence[DepthOutputs]) -> DepthOutputs:
    """Return the outputs of some cameras after those of others, [M, 1, H, W] each."""
    sky, log_uncertainty = (_cat([part[kind] for part in parts]) for kind in (1, 2))
    return DepthOutputs(torch.cat([part.disparity for part in parts]), sky, log_uncertainty)


def _cat(parts: Sequence[Tensor | None]) -> Tensor | None:
    there = [part for part in parts if part is not None]
    return torch.cat(there) if there else None
