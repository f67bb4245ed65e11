# SPDX-License-Identifier: Apache-2.0
"""Consistency of a ray-cast street: one row for each pair and each step, and means that no order changes."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from street_scene import RIG, seen

from cvcdepth_core.rendering.agreement import Agreement, PosedDepth
from cvcdepth_core.scoring.consistency import (
    AgreementRow,
    AgreementTable,
    spatial_rows,
    summarise_agreement,
    temporal_rows,
)


def test_depth_agrees_along_the_recorded_motion_and_not_along_a_wrong_one():
    far_away = np.array([5e5, 4e6, 30.0])  # UTM coordinates must not cost precision
    here, there = np.eye(4), np.eye(4)
    there[:3, 3] = 0.5, 0.1, 0.0
    earlier, later = seen(here), seen(there)
    shifted = [
        PosedDepth(p.surround, p.world_T_camera + np.pad(far_away[:, None], ((0, 1), (3, 0)))) for p in (earlier, later)
    ]
    for first, second in ((later, earlier), (shifted[1], shifted[0])):
        rows = temporal_rows(RIG, first, second, 80.0)
        assert [(row.camera, row.other, row.kind) for row in rows] == [
            ("left", "left", "temporal"),
            ("right", "right", "temporal"),
        ]
        for row in rows:
            assert row.travelled == pytest.approx(math.hypot(0.5, 0.1))
            assert row.agreement.median < 1e-3
            assert row.agreement.photometric < 0.03
    still = PosedDepth(later.surround, earlier.world_T_camera)
    assert temporal_rows(RIG, still, earlier, 80.0)[0].agreement.median > 0.02


def test_every_neighbour_pair_has_a_row():
    rows = spatial_rows(RIG, seen(), 80.0)
    assert [row.pair for row in rows] == [("spatial", "left", "right"), ("spatial", "right", "left")]
    assert rows[0].travelled == pytest.approx(0.8)


def compared(values: Sequence[float]) -> AgreementTable:
    """A comparison of the same pair in every set, with nothing to compare where a value is NaN."""
    table = AgreementTable()
    for number, value in enumerate(values):
        found = Agreement(0 if math.isnan(value) else 9, value, value, value)
        table.add(number, [AgreementRow("spatial", "left", "right", 0.8, found)])
    return table


@given(st.permutations(range(6)), st.integers(0, 6))
def test_the_summary_is_the_mean_over_sets_in_any_order_and_passes_over_empty_ones(order, cut):
    values = [0.1, 0.2, 0.7, 0.3, 1e-9, math.nan]
    shuffled = [values[i] for i in order]
    (summary,) = summarise_agreement([compared(shuffled[:cut]), compared(shuffled[cut:])]).values()
    assert summary == (5, *[math.fsum(values[:5]) / 5] * 3)


def test_a_table_keeps_every_number_and_can_be_made_again_from_its_columns():
    table = compared([0.1, math.nan])
    table.add(1, [AgreementRow("temporal", "left", "left", 1.5, Agreement(4_000_000, 0.5, 0.9, 1 / 3))])
    again = AgreementTable(table.pairs, table.columns)
    assert again.pairs == [("spatial", "left", "right"), ("temporal", "left", "left")]
    rows = again.columns.tolist()
    assert rows[0] == (0, 0, 0.8, 9, 0.1, 0.1, 0.1)
    assert rows[1][:4] == (1, 0, 0.8, 0)
    assert all(map(math.isnan, rows[1][4:]))
    assert rows[2] == (1, 1, 1.5, 4_000_000, 0.5, 0.9, 1 / 3)
