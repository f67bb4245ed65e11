# SPDX-License-Identifier: Apache-2.0
"""True depth of a recording's sets at the network's size, by the code with which `evaluate` scores. No ROS here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.scoring.ground_truth import resized_truth
from cvcdepth_core.scoring.sparse_depth import OcclusionFilter
from cvcdepth_core.training.config import RecordingsConfig
from cvcdepth_ros.bags import Recording, open_recording
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.true_depth import RecordedDepthImages
from cvcdepth_ros.recordings.truth import RecordedTruth
from cvcdepth_ros.training_data.index import RecordingIndex

TruthSource = Literal["lidar", "depth"]


def truth_sources(
    indexes: Sequence[RecordingIndex], config: RecordingsConfig, lidar: tuple[str, ...] | None
) -> list[TruthSource | None]:
    """Return from where each recording has its truth by `recordings.supervise`; None where it has none.

    `lidar` names the LiDARs' topics (None: those of each recording). Raises RecordingError where no recording has
    such truth, and where one lacks the true depth of a camera.
    """
    kind = config.supervise
    if kind == "none":
        return [None] * len(indexes)
    has_truth = [kind == "depth" or _has_lidar(index, lidar) for index in indexes]
    for index in indexes if kind == "depth" else ():
        with open_recording(index.path) as recording:
            RecordedDepthImages(RecordedRig.from_recording(recording, index.layout))
    if not any(has_truth):
        paths = ", ".join(str(index.path) for index in indexes)
        raise RecordingError(
            f"{paths}: no LiDAR, but recordings.supervise is 'lidar'; 'none' learns from pictures alone"
        )
    return [kind if has else None for has in has_truth]


def _has_lidar(index: RecordingIndex, lidar: tuple[str, ...] | None) -> bool:
    if lidar is not None:
        return bool(lidar)
    with open_recording(index.path) as recording:
        return bool(RecordedRig.from_recording(recording, index.layout).lidars)


class TruthReader:
    """Random access to the true depth of one opened recording's sets."""

    def __init__(
        self, index: RecordingIndex, recording: Recording, source: TruthSource, lidar: tuple[str, ...] | None
    ) -> None:
        self._index, self._source, self._lidar = index, source, lidar
        self._recorded = RecordedRig.from_recording(recording, index.layout)
        self._rig = index.layout.complete()

    def read(self, row: int, height: int, width: int) -> NDArray[np.float32]:
        """Return a set's true depth [N, height, width] in metres; inf in the sky, NaN where it is not known."""
        source: RecordedTruth | RecordedDepthImages
        if self._source == "lidar":
            source = RecordedTruth(self._recorded, self._lidar)
        else:
            source = RecordedDepthImages(self._recorded)
        log_times = self._index.log_times[row]
        source.read(int(log_times.min()) - source.ahead_ns, int(log_times.max()) + source.ahead_ns + 1)
        times = dict(zip(self._rig.names, self._index.times[row].tolist(), strict=True))
        found = source.camera_depth(self._rig, times, OcclusionFilter())
        parts = [camera.network_part(height, width) for camera in self._rig.cameras]
        return np.stack([resized_truth(one, height, width, part) for one, part in zip(found, parts, strict=True)])
