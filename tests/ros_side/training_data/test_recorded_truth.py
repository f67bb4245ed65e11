# SPDX-License-Identifier: Apache-2.0
"""True depth of a recording as something to learn from: the same that `evaluate` scores by, at the network's size."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from recordings import sample_entries, without, write_rosbag2
from repository import ROOT

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.scoring.sparse_depth import OcclusionFilter
from cvcdepth_core.training.config import OptimizerConfig, RecordingsConfig, Supervision, TrainingConfig
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.recordings.truth import RecordedTruth
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import RecordingIndex, build_index
from cvcdepth_ros.training_data.loader import RecordingBatches

WORLD = ROOT / "samples" / "world_excerpt"
HEIGHT, WIDTH = 64, 96


def config(supervise: Supervision) -> TrainingConfig:
    recordings = {"held_out": 0.0, "motion": "recorded", "supervise": supervise}
    return TrainingConfig(
        dataset="recording",
        depth=DepthModelSpec(height=HEIGHT, width=WIDTH, min_depth=0.5, max_depth=80),
        recordings=RecordingsConfig.model_validate(recordings),
        optimizer=OptimizerConfig(samples_per_step=1),
    )


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> RecordingIndex:
    bag = write_rosbag2(tmp_path_factory.mktemp("short") / "short", sample_entries(4))
    return build_index(bag, MatchingSettings())


def test_lidar_truth_is_that_of_evaluate(short: RecordingIndex):
    batches = RecordingBatches([short], config("lidar"))
    sample = batches.reader.samples[0]
    found = batches.reader.truth(0, sample.target)
    assert found.shape == (6, HEIGHT, WIDTH)
    with open_recording(short.path) as recording:
        recorded = RecordedRig.from_recording(recording, short.layout)
        truth = RecordedTruth(recorded)
        truth.read(0, 2**62)
        times = dict(zip(short.layout.names, short.times[sample.target].tolist(), strict=True))
        rig = short.layout.complete()
        expected = truth.camera_depth(rig, times, OcclusionFilter())
    for camera, full, small in zip(rig.cameras, expected, found, strict=True):
        part = camera.network_part(HEIGHT, WIDTH)
        row = np.floor((full.rows - part.top + 0.5) * HEIGHT / part.height).astype(int)
        column = np.floor((full.columns - part.left + 0.5) * WIDTH / part.width).astype(int)
        inside = (row >= 0) & (row < HEIGHT)
        cells = {(r, c) for r, c in zip(row[inside], column[inside], strict=True)}
        assert cells == set(zip(*np.nonzero(np.isfinite(small)), strict=True))
        for r, c in sorted(cells)[:200]:
            assert small[r, c] in full.depth[(row == r) & (column == c)].astype(np.float32)


def test_batches_have_it_where_the_picture_shows_the_scene_and_say_that_it_is_sparse(
    short: RecordingIndex, tmp_path: Path
):
    mask = np.full((540, 960), 255, np.uint8)
    mask[270:] = 0
    cv2.imwrite(str(tmp_path / "front.png"), mask)
    cameras = tuple(
        camera.model_copy(update={"mask": tmp_path / "front.png"}) if camera.name == "front" else camera
        for camera in short.layout.cameras
    )
    masked = replace(short, layout=short.layout.model_copy(update={"cameras": cameras}))
    (batch, *_) = RecordingBatches([masked], config("lidar")).epoch(0)
    assert batch.truth_is_sparse
    known = torch.isfinite(batch.truth)
    assert 0.01 < float(known.float().mean()) < 0.5
    assert not bool((known & (batch.masks == 0)).any())
    front = batch.camera_names.index("front")
    assert not bool(known[:, front, :, HEIGHT // 2 + 1 :].any())
    assert bool(known[:, front].any())
    plain = next(iter(RecordingBatches([masked], config("none")).epoch(0)))
    assert plain.truth is None
    assert torch.equal(plain.frames, batch.frames)


def test_recorded_depth_images_are_dense_truth_with_the_sky():
    index = build_index(WORLD, MatchingSettings())
    (batch, *_) = RecordingBatches([index], config("depth")).epoch(0)
    assert not batch.truth_is_sparse
    shown = batch.masks > 0
    assert float(batch.truth.isnan()[shown].float().mean()) < 0.02
    assert 0.05 < float(batch.truth.isinf().float().mean()) < 0.6
    # Most of what lies below the horizon, low in the picture, is the ground where the calibration has it.
    below = (torch.arange(HEIGHT) - batch.intrinsics[..., 1, 2:]) / batch.intrinsics[..., 1, 1:2]
    flat = batch.base_T_camera[..., 2, 3, None] / below.clamp(min=1e-3)
    truth = batch.truth[..., 0, :, :]
    low = (below > 0.25)[..., None] & torch.isfinite(truth)
    assert float((((truth / flat[..., None])[low] - 1).abs() < 0.1).float().mean()) > 0.5


def test_recordings_with_and_without_a_lidar_may_be_learned_from_together_but_not_only_without(
    short: RecordingIndex, tmp_path: Path
):
    bag = write_rosbag2(tmp_path / "blind", without(sample_entries(4), "/lidar"))
    blind = build_index(bag, MatchingSettings())
    batches = list(RecordingBatches([short, blind], config("lidar")).epoch(0))
    assert sorted(batch.truth is None for batch in batches) == [False, False, True, True]
    with pytest.raises(RecordingError, match=r"blind: no LiDAR, but recordings.supervise is 'lidar'"):
        RecordingBatches([blind], config("lidar"))
    with pytest.raises(RecordingError, match="no LiDAR, but"):
        RecordingBatches([short], config("lidar"), lidar=())
    with pytest.raises(RecordingError, match=r"short: no true depth on /camera/front/truth/depth"):
        RecordingBatches([short], config("depth"))
