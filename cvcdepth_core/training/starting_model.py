# SPDX-License-Identifier: Apache-2.0
"""Both networks as a training begins with them: with random weights, or with those of a checkpoint."""

from __future__ import annotations

import torch

from cvcdepth_core.errors import CheckpointError
from cvcdepth_core.networks import PoseNet, build_depth_network
from cvcdepth_core.networks.checkpoint import Checkpoint, load_network_state
from cvcdepth_core.training.config import TrainingConfig
from cvcdepth_core.training.model import SurroundModel


def build_surround_model(config: TrainingConfig, start: Checkpoint | None = None) -> SurroundModel:
    """Return both networks of `config` with random weights by its seed, or with those of `start`.

    A checkpoint without a pose network leaves that random. Raises CheckpointError, naming the values, when `start` was
    built for another network, encoder or depth range: its disparities would mean other depths.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        depth_net, pose_net = build_depth_network(config.depth), PoseNet(config.pose.encoder)
    if start is not None:
        _refuse_other_meaning(start, config)
        load_network_state(depth_net, start.depth_net, origin=f"{start.path}: depth network")
        if start.pose_net:
            load_network_state(pose_net, start.pose_net, origin=f"{start.path}: pose network")
    return SurroundModel(
        depth_net,
        pose_net,
        min_depth=config.depth.min_depth,
        max_depth=config.depth.max_depth,
        focal_scale=config.depth.focal_scale,
        pose_method=config.pose.method,
    )


def _refuse_other_meaning(start: Checkpoint, config: TrainingConfig) -> None:
    # Depth goes with fx / focal_scale, and fx with the width: at another width, focal_scale has to follow.
    same_meaning = start.spec.focal_scale * config.depth.width / start.spec.width
    for name, found in (
        ("network", start.spec.network),
        ("encoder", start.spec.encoder),
        ("min_depth", start.spec.min_depth),
        ("max_depth", start.spec.max_depth),
        ("focal_scale", same_meaning),
    ):
        want = getattr(config.depth, name)
        if found != want:
            at = f" at a width of {config.depth.width}" if name == "focal_scale" else ""
            raise CheckpointError(
                f"{start.path}: {name} is {found}{at}, but the configuration's depth.{name} is {want}"
            )
