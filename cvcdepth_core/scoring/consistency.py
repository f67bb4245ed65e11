# SPDX-License-Identifier: Apache-2.0
"""Label-free quality: whether depth agrees between cameras and along the vehicle's way, and explains the pictures.

Every comparison is of a view with another one, at another place or moment, by true geometry: a point of the view is
back-projected, moved to the other view, and its distance there compared with the depth that was estimated there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import max_pool2d

from cvcdepth_core.images.surround import to_tensor
from cvcdepth_core.rendering.photometric import photometric_error
from cvcdepth_core.rendering.projection import back_project, transform
from cvcdepth_core.rendering.view_synthesis import align_intensity, sample, sampling_grid, warp_views
from cvcdepth_core.rig.poses import Pose, inverse
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.scoring.scores import mean
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_core.training.losses import masked_mean

Kind = Literal["spatial", "temporal"]
Pair = tuple[Kind, str, str]
"""Kind, camera, other camera."""

_OCCLUDER_MARGIN = 0.05
_EDGE = 0.1
_ALL_KNOWN = 0.999
_OUTSIDE = 2.0  # of a sampling grid, which spans -1 to 1


@dataclass(frozen=True, eq=False)
class PosedDepth:
    """A surround set's depth, and where each camera was when its picture was taken."""

    surround: SurroundDepth
    world_T_camera: NDArray[np.float64]
    """[N, 4, 4] metres, each at its camera's own moment, in any frame that several sets share."""

    @classmethod
    def of(cls, surround: SurroundDepth, rig: Rig, world_T_base: Sequence[Pose] | None) -> PosedDepth:
        """Place the cameras by the vehicle's pose [4, 4] at each one's moment; None: it stands still at the origin."""
        base_T_camera = np.stack([camera.base_T_camera for camera in rig.cameras])
        return cls(surround, base_T_camera if world_T_base is None else np.stack(world_T_base) @ base_T_camera)


class Agreement(NamedTuple):
    """How one view agrees with another."""

    pixels: int
    """Whose depth could be compared: the other view sees the point, nothing hides it there, and depth is smooth."""
    median: float
    """Median of the relative difference 2 |z - d| / (z + d) over these pixels; NaN for none."""
    percentile_90: float
    """Its 90th percentile."""
    photometric: float
    """Mean photometric error of the view rendered from the other's picture; NaN where that shows nothing of it."""


def agreement(view: PosedDepth, i: int, other: PosedDepth, j: int, max_depth: float = 80.0) -> Agreement:
    """Compare camera `i` of one set with camera `j` of the same or another set, over points nearer than `max_depth`."""
    pair = _Pair.of(view, i, other, j)
    difference, hidden = _compare(pair, max_depth)
    compared = difference[~torch.isnan(difference)].numpy()
    half, most = np.percentile(compared, [50, 90]).tolist() if compared.size else (math.nan, math.nan)
    return Agreement(compared.size, half, most, _photometric(pair, hidden, max_depth))


def disagreement(view: PosedDepth, i: int, other: PosedDepth, j: int, max_depth: float = 80.0) -> NDArray[np.float32]:
    """Return the relative difference 2 |z - d| / (z + d) of every pixel [H, W], NaN where it cannot be compared.

    z is the distance along the other's axis of the point seen in the view, d the other's depth where it is seen there.
    Not compared are points outside of the other picture or not nearer than `max_depth`, at depth edges there (more than
    10 % deviation among the four pixels), and hidden by a nearer surface of the other's depth, unless the view
    contradicts that surface by seeing through it.
    """
    difference, _ = _compare(_Pair.of(view, i, other, j), max_depth)
    found: NDArray[np.float32] = difference[0, 0].numpy()
    return found


class AgreementRow(NamedTuple):
    """One comparison of a set."""

    kind: Kind
    camera: str
    other: str
    """The neighbour (spatial), or the camera itself one set earlier (temporal)."""
    travelled: float
    """Metres between the two places that the pictures were taken from."""
    agreement: Agreement

    @property
    def pair(self) -> Pair:
        """What was compared with what."""
        return self.kind, self.camera, self.other


class AgreementTable:
    """All comparisons of one recording, in columns: 42 bytes each."""

    DTYPE = np.dtype(
        [
            ("set", "<u4"),
            ("pair", "<u2"),
            ("travelled", "<f8"),
            ("pixels", "<u4"),
            ("median", "<f8"),
            ("percentile_90", "<f8"),
            ("photometric", "<f8"),
        ]
    )
    """`set` counts the sets of the recording, `pair` those of `pairs`; the rest as in `AgreementRow`."""

    def __init__(self, pairs: Iterable[Pair] = (), columns: NDArray[np.void] | None = None) -> None:
        self._pairs = {pair: number for number, pair in enumerate(pairs)}
        self._columns = bytearray() if columns is None else bytearray(columns.astype(self.DTYPE).tobytes())

    @property
    def pairs(self) -> list[Pair]:
        """What was compared with what."""
        return list(self._pairs)

    @property
    def columns(self) -> NDArray[np.void]:
        """All comparisons [M] of dtype `DTYPE`, in the order in which they were added."""
        return np.frombuffer(bytes(self._columns), self.DTYPE)

    def add(self, number: int, rows: Iterable[AgreementRow]) -> None:
        """Add comparisons of the set of this number."""
        found = [
            (number, self._pairs.setdefault(row.pair, len(self._pairs)), row.travelled, *row.agreement) for row in rows
        ]
        self._columns += np.array(found, dtype=self.DTYPE).tobytes()


def spatial_rows(rig: Rig, view: PosedDepth, max_depth: float) -> list[AgreementRow]:
    """Compare every camera of a set with its neighbours."""
    return [_row("spatial", rig, (view, i), (view, j), max_depth) for i, j in rig.neighbour_indices]


def temporal_rows(rig: Rig, view: PosedDepth, earlier: PosedDepth, max_depth: float) -> list[AgreementRow]:
    """Compare every camera of a set with itself in an earlier set; both need poses in the same world."""
    return [_row("temporal", rig, (view, i), (earlier, i), max_depth) for i in range(len(rig.cameras))]


class AgreementSummary(NamedTuple):
    """The means over the sets in which a pair could be compared, every set counting the same; NaN for none."""

    sets: int
    median: float
    percentile_90: float
    photometric: float


def summarise_agreement(tables: Iterable[AgreementTable]) -> dict[Pair, AgreementSummary]:
    """Return the means of every pair; they depend neither on the order of the tables nor on that of the sets."""
    by_pair: dict[Pair, list[NDArray[np.void]]] = {}
    for table in tables:
        columns = table.columns
        for number, pair in enumerate(table.pairs):
            by_pair.setdefault(pair, []).append(columns[columns["pair"] == number])
    return {pair: _mean_agreement(np.concatenate(found)) for pair, found in by_pair.items()}


def _mean_agreement(found: NDArray[np.void]) -> AgreementSummary:
    compared = found[found["pixels"] > 0]
    photometric = found["photometric"][~np.isnan(found["photometric"])]
    half, most = (mean(compared[name].tolist()) for name in ("median", "percentile_90"))
    return AgreementSummary(len(compared), half, most, mean(photometric.tolist()))


def _row(
    kind: Kind, rig: Rig, first: tuple[PosedDepth, int], second: tuple[PosedDepth, int], max_depth: float
) -> AgreementRow:
    (view, i), (other, j) = first, second
    travelled = float(np.linalg.norm(view.world_T_camera[i, :3, 3] - other.world_T_camera[j, :3, 3]))
    return AgreementRow(kind, rig.names[i], rig.names[j], travelled, agreement(view, i, other, j, max_depth))


@dataclass(frozen=True)
class _Pair:
    """A view and the other one that it is compared with."""

    picture: Tensor  # [1, 3, H, W]
    other_picture: Tensor
    depth: Tensor  # [1, 1, H, W] metres, NaN unknown
    other_depth: Tensor
    intrinsics: Tensor  # [1, 3, 3]
    other_intrinsics: Tensor
    other_T_view: Tensor  # [1, 4, 4]

    @classmethod
    def of(cls, view: PosedDepth, i: int, other: PosedDepth, j: int) -> _Pair:
        other_T_view = inverse(other.world_T_camera[j]) @ view.world_T_camera[i]
        return cls(
            to_tensor([view.surround.pictures[i]]),
            to_tensor([other.surround.pictures[j]]),
            torch.from_numpy(view.surround.depth[[i], None]),
            torch.from_numpy(other.surround.depth[[j], None]),
            torch.from_numpy(view.surround.intrinsics[[i]]).float(),
            torch.from_numpy(other.surround.intrinsics[[j]]).float(),
            torch.from_numpy(other_T_view[None]).float(),
        )

    @property
    def points(self) -> Tensor:
        """[1, 3, H*W] metres in the view's frame, NaN where unknown."""
        return back_project(self.depth, torch.linalg.inv(self.intrinsics))


def _compare(pair: _Pair, max_depth: float) -> tuple[Tensor, Tensor]:
    """Return the relative difference [1, 1, H, W], NaN where not comparable, and where the point is hidden."""
    in_other = transform(pair.other_T_view, pair.points)
    grid, z = sampling_grid(in_other, pair.other_intrinsics, pair.other_depth.shape[-2:])
    z = z.view(pair.depth.shape)
    seen = (z > 0) & (z < max_depth) & (pair.depth < max_depth)
    d = _depth_at(pair.other_depth, grid)
    hidden = seen & (d < z * (1 - _OCCLUDER_MARGIN)) & ~_contradicted(pair, in_other, d / z)
    difference = 2 * (z - d).abs() / (z + d)
    return torch.where(seen & ~hidden, difference, torch.nan), hidden


def _contradicted(pair: _Pair, in_other: Tensor, shortening: Tensor) -> Tensor:
    """Where the view sees through the surface that the other view has on its ray to the point.

    The ray's points [1, 3, H*W] times `shortening` [1, 1, H, W] lie on that surface.
    """
    view_T_other = torch.linalg.inv(pair.other_T_view)
    surface = transform(view_T_other, in_other * shortening.flatten(-2))
    grid, z = sampling_grid(surface, pair.intrinsics, pair.depth.shape[-2:])
    z = z.view(pair.depth.shape)
    nearness = torch.where(torch.isnan(pair.depth), torch.inf, 1 / pair.depth)
    # Silhouettes fall between pixels: no pixel around may have a surface as near as that one.
    nearest = sample(max_pool2d(nearness, 3, stride=1, padding=1), grid.nan_to_num(_OUTSIDE), mode="nearest")
    contradicted: Tensor = (z > 0) & (nearest > 0) & (nearest * z * (1 + _OCCLUDER_MARGIN) < 1)
    return contradicted


def _depth_at(depth: Tensor, grid: Tensor) -> Tensor:
    """Interpolate depth [1, 1, H, W] at `grid`; NaN outside, next to unknown pixels and at depth edges.

    Inverse depth is interpolated: of a plane it is linear in the picture, so that planes are exact.
    """
    known = ~torch.isnan(depth)
    nearness = torch.where(known, 1 / depth, 0.0)
    moments = torch.cat([nearness, nearness.square(), known.to(depth)], dim=1)
    mean_nearness, squared, share = sample(moments, grid.nan_to_num(_OUTSIDE)).unsqueeze(2).unbind(dim=1)
    deviation = (squared - mean_nearness.square()).clamp(min=0).sqrt()
    smooth = (share >= _ALL_KNOWN) & (deviation <= _EDGE * mean_nearness)
    return torch.where(smooth, 1 / mean_nearness, torch.nan)


def _photometric(pair: _Pair, hidden: Tensor, max_depth: float) -> float:
    """Return the mean photometric error over what the other picture shows of the view, hidden points left out."""
    compared = (pair.depth < max_depth) & ~hidden
    everywhere = torch.ones_like(pair.other_depth)
    warp = warp_views(
        pair.points.nan_to_num(0.0),
        pair.other_picture,
        everywhere,
        pair.other_T_view,
        pair.other_intrinsics,
        in_front_only=True,
    )
    mask = warp.masks * compared
    if not mask.any():
        return math.nan
    aligned = align_intensity(warp.images, mask, pair.picture, compared.to(mask), masked_deviation=True)
    return float(masked_mean(photometric_error(aligned, pair.picture), mask))
