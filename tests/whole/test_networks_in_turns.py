# SPDX-License-Identifier: Apache-2.0
"""`tools/networks_in_turns.py`: checkpoints at their size or another, and the ratios of rounds that took turns."""

from pathlib import Path

import torch
from repository import load_tool

from cvcdepth_core.networks import DepthModelSpec, build_depth_network
from cvcdepth_core.networks.checkpoint import save_checkpoint

TOOL = load_tool("networks_in_turns")
SPEC = DepthModelSpec(
    network="rig_conditioned", encoder="efficientnet_lite0", height=64, width=96, min_depth=0.4, max_depth=250.0,
    focal_scale=48.0,
)  # fmt: skip


def test_a_checkpoint_runs_at_its_size_or_at_the_one_that_is_named(tmp_path: Path):
    torch.manual_seed(0)
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, SPEC, build_depth_network(SPEC).state_dict())
    network, spec = TOOL.network_at(str(path))
    assert spec == SPEC
    network, spec = TOOL.network_at(f"{path}:96x192")
    assert (spec.height, spec.width, spec.focal_scale, spec.max_depth) == (96, 192, 96.0, 250.0)
    assert network._focal_scale == 96.0
    case = TOOL.prepared(f"{path}:64x64", "torch")
    assert case.error < 1e-4
    assert case.name == "rig_conditioned, efficientnet_lite0, 64 x 64"


def test_ratios_are_those_of_rounds_that_took_turns():
    ran = []
    cases = [TOOL.Case(name, "torch", 1e-6, lambda name=name: ran.append(name)) for name in ("first", "other")]
    assert [len(times) for times in TOOL.cpu_times(cases, 3)] == [3, 3]
    assert ran == ["first", "other"] * 3
    table = TOOL.table(cases, [[10.0, 20.0, 40.0], [5.0, 30.0, 20.0]])
    assert "| first | 20.0 | 1.00 | 1.0e-06 | torch |" in table
    assert "| other | 20.0 | 0.50 | 1.0e-06 | torch |" in table
