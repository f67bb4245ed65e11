# SPDX-License-Identifier: Apache-2.0
"""What a network is told of its rig, made once for each calibration and kept."""

from __future__ import annotations

import torch
from torch import Tensor

from cvcdepth_core.networks import ConditionedNetwork, RigImages

_KEPT = 32  # cameras; a rig that changes for ever does not fill the memory


class KeptConditioning:
    """The conditioning of the cameras that were asked for last; of each camera on its own, to the last bit."""

    def __init__(self, network: ConditionedNetwork) -> None:
        self._network = network
        self._kept: dict[bytes, Tensor] = {}

    @torch.inference_mode()
    def __call__(self, rig: RigImages) -> Tensor:
        """Return [B*N, C, H, W] of a rig's cameras."""
        samples, cameras = rig.images.shape[:2]
        each = [rig.of_cameras([camera]) for camera in range(cameras)]
        parts = [RigImages(*(part[b : b + 1] for part in one)) for b in range(samples) for one in each]
        return torch.cat([self._of_camera(part) for part in parts])

    def _of_camera(self, rig: RigImages) -> Tensor:
        size = torch.tensor(rig.images.shape[-2:])
        key = b"".join(p.cpu().numpy().tobytes() for p in (size, rig.intrinsics, rig.base_T_camera))
        found = self._kept.pop(key, None)
        if found is None:
            found = self._network.conditioning(rig).flatten(0, 1)
        self._kept[key] = found  # at the end: the first is the one that was not asked for longest
        if len(self._kept) > _KEPT:
            del self._kept[next(iter(self._kept))]
        return found
