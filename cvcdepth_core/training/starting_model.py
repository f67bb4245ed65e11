# SPDX-License-Identifier: Apache-2.0
"""Both networks as a training begins with them: with random weights, those of a checkpoint, or ImageNet encoders."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from cvcdepth_core.errors import CheckpointError, ConfigError
from cvcdepth_core.networks import DepthNet, PoseNet, build_depth_network
from cvcdepth_core.networks.checkpoint import Checkpoint, load_imagenet_encoder, load_network_state
from cvcdepth_core.networks.cross_view import CrossViewDepthNet
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.networks.rig_conditioned import RigConditionedNet
from cvcdepth_core.networks.rig_images import DepthNetwork
from cvcdepth_core.networks.vfdepth import FusedDepthNet, VolumePoseNet
from cvcdepth_core.networks.volume import VolumeSpec
from cvcdepth_core.training.config import TrainingConfig
from cvcdepth_core.training.model import SurroundModel


def build_surround_model(config: TrainingConfig, start: Checkpoint | None = None) -> SurroundModel:
    """Return both networks of `config` with random weights by its seed, or with those of `start`.

    A checkpoint without a pose network leaves that random. Raises CheckpointError, naming the values, when `start` was
    built for another network, encoder or depth range: its disparities would mean other depths.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        depth_net, pose_net = build_depth_network(config.depth), build_pose_network(config)
    if start is not None:
        _refuse_other_meaning(start, config)
        load_network_state(depth_net, start.depth_net, origin=f"{start.path}: depth network")
        if start.pose_net:
            load_network_state(pose_net, start.pose_net, origin=f"{start.path}: pose network")
    return _surround_model(config, depth_net, pose_net)


def build_imagenet_model(config: TrainingConfig, classifier: Path, initial_depth: float) -> SurroundModel:
    """Return both networks of `config` with encoders from an ImageNet classifier's file, all else random by its seed.

    The published depth network begins with a constant depth of `initial_depth` metres for a camera with fx =
    focal_scale: from the sigmoid's middle, which is nearer than a metre, the first warps miss their images (on the
    sample: Abs Rel 0.90 after 130 steps, against 0.49 from 8 m). Raises ConfigError where that is outside of the depth
    range or the encoders differ, CheckpointError, naming the file, where it does not fit them.
    """
    if config.pose.encoder != config.depth.encoder:
        raise ConfigError(
            f"pose.encoder is {config.pose.encoder}, depth.encoder {config.depth.encoder}; one ImageNet file starts "
            "both only when they are the same"
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        depth_net, pose_net = build_depth_network(config.depth), build_pose_network(config)
    if not isinstance(depth_net, (DepthNet, RigConditionedNet, FusedDepthNet, CrossViewDepthNet)):
        raise ConfigError(f"depth.network is {config.depth.network}, which has no encoder that ImageNet could start")
    for encoder in (depth_net.depth_encoder, pose_net.pose_encoder):
        load_imagenet_encoder(encoder, classifier)
    if isinstance(depth_net, (DepthNet, FusedDepthNet)):
        _start_at_depth(depth_net, config.depth, initial_depth)
    return _surround_model(config, depth_net, pose_net)


def build_pose_network(config: TrainingConfig) -> PoseNet | VolumePoseNet:
    """Return the pose network of `config` with random weights."""
    if config.pose.method == "volume":
        return VolumePoseNet(config.pose.encoder, config.depth.volume or VolumeSpec())
    return PoseNet(config.pose.encoder)


def _start_at_depth(depth_net: DepthNet | FusedDepthNet, spec: DepthModelSpec, metres: float) -> None:
    """Set the head's bias so that a camera with fx = focal_scale begins near a depth of `metres`."""
    if not spec.min_depth < metres < spec.max_depth:
        raise ConfigError(f"initial depth is {metres}, expected between {spec.min_depth} and {spec.max_depth}")
    disparity = (1 / metres - 1 / spec.max_depth) / (1 / spec.min_depth - 1 / spec.max_depth)
    bias = depth_net.depth_decoder.decoder[-1].get_parameter("conv.bias")
    torch.nn.init.constant_(bias, math.log(disparity / (1 - disparity)))


def _surround_model(
    config: TrainingConfig, depth_net: DepthNetwork, pose_net: PoseNet | VolumePoseNet
) -> SurroundModel:
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
        ("volume", start.spec.volume),
        ("cross_view", start.spec.cross_view),
        ("focal_scale", same_meaning),
    ):
        want = getattr(config.depth, name)
        if found != want:
            at = f" at a width of {config.depth.width}" if name == "focal_scale" else ""
            raise CheckpointError(
                f"{start.path}: {name} is {found}{at}, but the configuration's depth.{name} is {want}; "
                "who starts from weights keeps that value"
            )
