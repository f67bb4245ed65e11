# SPDX-License-Identifier: Apache-2.0
"""Refines each set's depth by what neighbours and earlier pictures show, and says how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvcdepth_core.refinement.confidence import (
    SHIPPED_MAPS,
    ConfidenceMap,
    ConfidenceMaps,
    checked_share,
    raw_confidence,
    trusted_share,
)
from cvcdepth_core.refinement.fusion import averaged, posterior
from cvcdepth_core.refinement.history import History
from cvcdepth_core.refinement.moments import GridSet, SurroundMoment, View, enlarged, to_grid
from cvcdepth_core.refinement.movers import guard_cost
from cvcdepth_core.refinement.plane_sweep import SweepCost, sweep
from cvcdepth_core.refinement.settings import RefinementSettings

_CONTRAST_SHARE = 0.055
"""Edge of the square in which there must be texture for a check, as a share of the grid's width."""
_LEAST_EVIDENCE = 0.05
"""Below, parallax is too little to tell anything: the prior stays bit for bit."""


@dataclass(frozen=True, eq=False)
class RefinedDepth:
    """A set's depth after refinement; cameras in the rig's order."""

    depth: NDArray[np.float32]
    """[N, H, W] metres, NaN where it was NaN before."""
    confidence: NDArray[np.float32]
    """[N, H, W] in [0, 1] of `depth`; 0 where nothing could be checked."""
    prior_confidence: NDArray[np.float32]
    """[N, H, W] in [0, 1] of the depth before refinement; 0 where nothing could be checked."""
    checked: NDArray[np.float32]
    """[N] share of each camera's pixels whose depth another picture could check."""
    earlier: NDArray[np.int64]
    """[N] how many earlier pictures of its own each camera was compared with."""
    beside: NDArray[np.int64]
    """[N] with how many of its neighbours."""


class _Sources(NamedTuple):
    """What one camera's picture is compared with."""

    earlier: list[View]
    """Its own, newest first."""
    beside: list[View]
    """Its neighbours' of the same set."""


class SurroundRefiner:
    """Refinement of one rig's depth, set after set; the state is the history of pictures only."""

    def __init__(
        self,
        neighbours: Sequence[tuple[int, int]],
        settings: RefinementSettings | None = None,
        device: torch.device | str = "cpu",
        confidence_maps: ConfidenceMaps = SHIPPED_MAPS,
    ) -> None:
        """`neighbours` are the rig's (camera, neighbour) indices, as `Rig.neighbour_indices` has them."""
        self.settings = settings or RefinementSettings()
        self._neighbours = tuple(neighbours)
        self._device = device
        self._maps = confidence_maps
        self._history = History()

    def reset(self) -> None:
        """Forget all earlier pictures: after a jump in time, or when the rig has changed."""
        self._history.clear()

    @torch.inference_mode()
    def refine(self, moment: SurroundMoment) -> RefinedDepth:
        """Refine the depth of the next set; a set that cannot follow the last one begins a new history."""
        grid = to_grid(moment, self.settings.max_grid_width, self._device)
        self._history.advance(grid, moment.present, moment.time_ns)
        refined = self._refined(moment, grid)
        if grid.placed:
            self._history.add(grid, moment.present, moment.time_ns)
        return refined

    def _refined(self, moment: SurroundMoment, grid: GridSet) -> RefinedDepth:
        sources = [self._sources(moment, grid, camera) for camera in range(len(grid.depth))]
        swept = self._swept_all(grid, sources)
        found = posterior(swept.cost, self.settings)
        checked = (swept.evidence >= _LEAST_EVIDENCE) & ~torch.isnan(grid.depth)
        depth = torch.from_numpy(moment.depth).to(self._device)
        raw = raw_confidence(found.peak, found.log_ratio, swept.fineness)
        share = checked_share(averaged(swept.contrast, _CONTRAST_SHARE))

        def on_picture(values: Tensor) -> Tensor:
            return enlarged(torch.where(checked, values, 0.0), grid.reduction)

        def confidence(raw: Tensor, mapped: ConfidenceMap) -> NDArray[np.float32]:
            return _to_numpy(on_picture(mapped(raw) * share) * ~torch.isnan(depth))

        return RefinedDepth(
            depth=_to_numpy(depth * on_picture(found.log_ratio * trusted_share(raw)).exp()),
            confidence=confidence(raw, self._maps.refined),
            prior_confidence=confidence(found.prior_right, self._maps.prior),
            checked=_to_numpy(checked.float().mean((1, 2))),
            earlier=np.array([len(found.earlier) for found in sources]),
            beside=np.array([len(found.beside) for found in sources]),
        )

    def _swept_all(self, grid: GridSet, sources: Sequence[_Sources]) -> SweepCost:
        """Return what is known of all cameras, stacked [N, ...]; costs include the prior's."""
        swept = (self._swept(grid, camera, found) for camera, found in enumerate(sources))
        found = SweepCost(*(torch.stack(parts) for parts in zip(*swept, strict=True)))
        prior = self.settings.prior_weight * self.settings.log_ratios(self._device).abs()
        found.cost.add_(prior[:, None, None])
        return found

    def _sources(self, moment: SurroundMoment, grid: GridSet, camera: int) -> _Sources:
        pose = grid.world_T_camera[camera]
        earlier = self._history.sources(camera, pose, self.settings.distances) if grid.placed else []
        return _Sources(earlier, self._beside(moment, grid, camera) if self.settings.use_neighbours else [])

    def _swept(self, grid: GridSet, camera: int, sources: _Sources) -> SweepCost:
        log_ratios = self.settings.log_ratios(self._device)
        view, depth = grid.view(camera), grid.depth[camera]
        found = sweep(view, depth, [*sources.earlier, *sources.beside], log_ratios)
        if sources.earlier:
            way = _way(view, sources.earlier[-1])
            found.cost.add_(guard_cost(way, view.intrinsics, (depth.shape[0], depth.shape[1]), log_ratios))
        return found

    def _beside(self, moment: SurroundMoment, grid: GridSet, camera: int) -> list[View]:
        others = [other for one, other in self._neighbours if one == camera]
        return [grid.view(other) for other in others if moment.present[other]]


def _way(view: View, earlier: View) -> NDArray[np.float64]:
    """Return how the camera moved since the earlier picture, [3] metres in its own frame."""
    moved = view.world_T_camera[:3, 3] - earlier.world_T_camera[:3, 3]
    return np.asarray(view.world_T_camera[:3, :3].T @ moved)


def _to_numpy(values: Tensor) -> NDArray[np.float32]:
    found: NDArray[np.float32] = values.cpu().numpy()
    return found
