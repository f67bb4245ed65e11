# SPDX-License-Identifier: Apache-2.0
"""From the image messages of one set to depth: what the live node, the bag tool and the evaluation all go through."""

from collections.abc import Sequence
from typing import Any

from cvcdepth_core.estimator import SurroundDepth, SurroundDepthEstimator
from cvcdepth_ros.latencies import StageLatencies
from cvcdepth_ros.messages import picture_from_message


def estimate_set(messages: Sequence[Any], surround: SurroundDepthEstimator, latencies: StageLatencies) -> SurroundDepth:
    """Decode, rectify and estimate one image message of every camera, in the rig's order.

    ImageError names the camera whose image is damaged, of an unknown encoding, or not of the calibration's size.
    """
    with latencies.measure("decode"):
        pictures = [picture_from_message(m, name) for m, name in zip(messages, surround.rig.names, strict=True)]
    with latencies.measure("rectify"):
        rectified = [surround.rectify(index, picture) for index, picture in enumerate(pictures)]
    with latencies.measure("inference"):
        return surround.estimate(rectified)
