# SPDX-License-Identifier: Apache-2.0
"""Refinement on the sample's real street, by the tool that measures it: better depth, and confidence that ranks."""

import importlib.util
import sys
from typing import Any

import numpy as np
import pytest
from recordings import SAMPLE
from repository import ROOT

TOOL = ROOT / "tools" / "refinement_trial.py"


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("refinement_trial", TOOL)
    module = importlib.util.module_from_spec(spec)
    sys.modules["refinement_trial"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["refinement_trial"]


@pytest.fixture(scope="module")
def recorded(tool: Any):
    return tool.read(str(SAMPLE), None)


@pytest.fixture(scope="module")
def still(tool: Any, recorded: Any):
    return {number: tool.standing_points(recorded.sets, number) for number in recorded.held_out}


def test_on_a_real_street_motion_makes_depth_more_exact_and_confidence_finds_the_errors(
    tool: Any, recorded: Any, still: Any
):
    result = tool.refine_all(recorded, 160, "odometry", None)
    before, after = (tool.scored(recorded, still, result, of_prior) for of_prior in (True, False))
    assert after.median < before.median  # though the default model knows these sets by heart
    assert after.abs_rel < 1.02 * before.abs_rel
    assert after.ause < 0.35
    assert after.calibration < 0.1
    assert after.surest_half < 0.75 * after.abs_rel


def test_without_odometry_alignment_finds_most_of_the_gain(tool: Any, recorded: Any, still: Any):
    by = {
        motion: tool.scored(recorded, still, tool.refine_all(recorded, 160, motion, None), False).median
        for motion in ("odometry", "alignment", "network")
    }
    assert by["alignment"] < 1.25 * by["odometry"]
    assert by["network"] > 1.1 * by["odometry"]  # the pose network tells half of the way


def test_mounts_of_neighbours_are_brought_to_agree(tool: Any, recorded: Any, capsys: pytest.CaptureFixture):
    mounts = tool.find_mounts(recorded)
    tool.print_mounts(recorded.rig, mounts)
    assert "| front in front_right |" in capsys.readouterr().out
    told = [pair for pair in mounts.pairs if pair.problem is None]
    assert len(told) >= 5
    assert np.mean([pair.after - pair.before for pair in told]) > 0.05


def test_what_moves_is_what_the_lidar_does_not_see_again(tool: Any):
    cloud = np.random.default_rng(0).uniform(-5, 5, (4000, 3))
    depth = np.full(100, 5.0)
    assert tool.seen_in(cloud[:100] + 0.05, depth, cloud).all()
    assert not tool.seen_in(cloud[:100] + 20.0, depth, cloud).any()
