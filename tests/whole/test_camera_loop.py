# SPDX-License-Identifier: Apache-2.0
"""The benchmark's baseline computes what the trainer computes, so that their times may be compared."""

import pytest
import torch
from repository import ROOT

from cvcdepth_core.networks import DepthNet, PoseNet
from cvcdepth_core.training.model import SurroundModel
from cvcdepth_core.training.objective import ObjectiveConfig, evaluate_objective

BENCHMARKS = ROOT / "benchmarks"


def test_one_view_after_the_other_gives_the_objectives_loss_and_gradient(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    from camera_loop import loss_one_by_one, predict_one_by_one
    from training_step import ring_of_cameras

    torch.manual_seed(0)
    batch = ring_of_cameras(2, 64, 96).to(dtype=torch.float64)
    model = SurroundModel(DepthNet("resnet18"), PoseNet("resnet18"), min_depth=0.5, max_depth=100.0).double().eval()
    noise, unmirrored = torch.randn(2, 2, 6, 1, 64, 96, dtype=torch.float64), torch.zeros(2, dtype=torch.bool)
    losses = (
        evaluate_objective(batch, model(batch, batch.frames, unmirrored, unmirrored), ObjectiveConfig(), noise).loss,
        loss_one_by_one(batch, predict_one_by_one(model, batch), ObjectiveConfig(), noise),
    )
    gradients = [torch.autograd.grad(loss, model.depth_net.parameters()) for loss in losses]
    torch.testing.assert_close(losses[1], losses[0], rtol=1e-8, atol=0)
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)
