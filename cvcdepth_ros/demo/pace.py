# SPDX-License-Identifier: Apache-2.0
"""The rate at which a recording may be played so that this machine keeps up with every set."""

import os
import time

import numpy as np
import torch

from cvcdepth_core.estimator import DepthEstimator
from cvcdepth_core.rig.rig import RigLayout
from cvcdepth_ros.bags import Recording
from cvcdepth_ros.end_to_end.processes import THREADS_VARIABLE, spared_threads
from cvcdepth_ros.settings import ModelSettings
from cvcdepth_ros.surround_sets.synchronizer import NANOSECONDS

_MARGIN = 4.0  # player and recorder want their share of the processor, and so may others
_FASTEST, _SLOWEST_SECONDS = 1.0, 6.0


def manageable_rate(recording: Recording, layout: RigLayout, model: ModelSettings) -> float:
    """Return the rate at which a set's inference takes a quarter of the time until the next set.

    That is measured, with the node's own network on this machine; at most real time, at least a set in six seconds.
    """
    inference = _inference_seconds(model.build_estimator(), len(layout.cameras))
    anchor = next(camera.image_topic for camera in layout.cameras if camera.name == layout.anchor_camera)
    seconds = (recording.end - recording.start) / NANOSECONDS
    period = seconds / max(recording.topics[anchor].count, 1)
    return min(period / min(_MARGIN * inference, _SLOWEST_SECONDS), _FASTEST)


def _inference_seconds(estimator: DepthEstimator, cameras: int) -> float:
    """Return the seconds of one set's inference, on grey pictures, after a first run that builds what is reused."""
    pictures = [np.full((estimator.spec.height, estimator.spec.width, 3), 127, dtype=np.uint8)] * cameras
    focal_lengths = np.full(cameras, float(estimator.spec.width))
    if THREADS_VARIABLE not in os.environ:
        torch.set_num_threads(spared_threads())
    estimator.estimate(pictures, focal_lengths)
    began = time.monotonic()
    estimator.estimate(pictures, focal_lengths)
    return time.monotonic() - began
