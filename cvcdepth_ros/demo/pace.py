# SPDX-License-Identifier: Apache-2.0
"""The rate at which a recording may be played so that this machine keeps up with every set."""

import os
import time

import torch

from cvcdepth_core.estimator import SurroundDepthEstimator
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.bags import Recording
from cvcdepth_ros.end_to_end.processes import THREADS_VARIABLE, spared_threads
from cvcdepth_ros.settings import ModelSettings

_MARGIN = 4.0  # player and recorder want their share of the processor, and so may others
_FASTEST, _SLOWEST_SECONDS = 1.0, 6.0


def manageable_rate(recording: Recording, layout: RigLayout, model: ModelSettings) -> float:
    """Return the rate at which a set's inference takes a quarter of the time until the next set.

    That is measured, with the node's own network on this machine; at most real time, at least a set in six seconds.
    """
    inference = _inference_seconds(SurroundDepthEstimator(layout.complete(), model.build_estimator()))
    anchor = next(camera.image_topic for camera in layout.cameras if camera.name == layout.anchor_camera)
    seconds = (recording.end - recording.start) / NANOSECONDS
    period = seconds / max(recording.topics[anchor].count, 1)
    return min(period / min(_MARGIN * inference, _SLOWEST_SECONDS), _FASTEST)


def _inference_seconds(surround: SurroundDepthEstimator) -> float:
    """Return the seconds of one set's inference, on black pictures, after a first run that builds what is reused."""
    if THREADS_VARIABLE not in os.environ:
        torch.set_num_threads(spared_threads())
    surround.warm_up()
    began = time.monotonic()
    surround.warm_up()
    return time.monotonic() - began
