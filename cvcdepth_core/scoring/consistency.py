# SPDX-License-Identifier: Apache-2.0
"""Label-free quality: whether depth agrees between cameras and along the vehicle's way, and explains the pictures."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.rendering.agreement import Agreement, PosedDepth, agreement
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.scoring.scores import mean

Kind = Literal["spatial", "temporal"]
Pair = tuple[Kind, str, str]
"""Kind, camera, other camera."""


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
        """The compared views."""
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
        """The compared views, in the order in which they were first added."""
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
