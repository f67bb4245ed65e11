# SPDX-License-Identifier: Apache-2.0
"""What a training did to the depth of worlds: proven worse, or not, over views that look alike in a drive."""

from types import SimpleNamespace

import numpy as np
import pytest

from cvcdepth_core.scoring.metrics import METRIC_NAMES
from cvcdepth_ros.finetuning.world_scores import WorldVerdict, compare_worlds
from cvcdepth_ros.training_data.world_views import View

VIEWS = [View(drive, number, camera) for drive in range(2) for camera in range(3) for number in range(4)]


def compared(change: float, noise: float = 0.01, views: list[View] = VIEWS) -> WorldVerdict:
    rng = np.random.default_rng(0)
    before = np.tile(rng.uniform(0.6, 0.9, (len(views), 1)), (1, len(METRIC_NAMES)))
    after = before + change + rng.normal(0, noise, (len(views), 1))
    after[3] = before[3] = np.nan  # a view of nothing but the sky
    return compare_worlds(SimpleNamespace(views=views), before, after)


def test_what_is_worse_on_all_views_is_told_with_the_numbers():
    found = compared(-0.05)
    assert found.is_worse
    assert found.difference.difference == pytest.approx(-0.05, abs=0.01)
    assert found.describe().startswith("worse than the start on worlds: δ < 1.25 0.")
    assert f"{len(VIEWS)} held-out views" in found.describe()
    assert found.to_json()["after"]["delta_1"] == pytest.approx(found.difference.second, abs=1e-4)


@pytest.mark.parametrize("change", [0.0, 0.05])
def test_what_is_as_good_or_better_is_not_called_forgotten(change: float):
    found = compared(change)
    assert not found.is_worse
    assert found.describe().startswith("not proven to be worse than the start on worlds")


def test_a_few_views_prove_nothing():
    assert not compared(-0.05, views=VIEWS[:5]).is_worse
