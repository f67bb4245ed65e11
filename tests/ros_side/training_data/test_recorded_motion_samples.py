# SPDX-License-Identifier: Apache-2.0
"""Samples by recorded motion: poses from exposure to exposure, contexts by distance, and which recording takes what."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recordings import SAMPLE, Entry, restamped, sample_entries, thinned, write_rosbag2

from cvcdepth_core.errors import RecordingError, RigError
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.training.config import OptimizerConfig, RecordingsConfig, TrainingConfig
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import RecordingIndex, build_index
from cvcdepth_ros.training_data.loader import RecordingBatches
from cvcdepth_ros.training_data.sample_choice import (
    describe_motion,
    describe_unprovable,
    find_samples,
    find_variants,
    held_out_sets,
    refuse_standstill,
)
from cvcdepth_ros.training_data.samples import SampleReader

MATCHING = MatchingSettings()
RECORDED = RecordingsConfig(held_out=0.0, motion="recorded")
AUTO = RecordingsConfig(held_out=0.0, motion="auto")
HEIGHT, WIDTH = 64, 96


@pytest.fixture(scope="module")
def index() -> RecordingIndex:
    return build_index(SAMPLE, MATCHING)


@pytest.fixture(scope="module")
def blind(tmp_path_factory) -> RecordingIndex:
    entries = without_motion()
    return build_index(write_rosbag2(tmp_path_factory.mktemp("blind") / "blind", entries), MATCHING)


def without_motion() -> list[Entry]:
    return [entry for entry in sample_entries() if entry.topic not in ("/odom", "/tf")]


def config(recordings: RecordingsConfig, samples_per_batch: int = 1) -> TrainingConfig:
    return TrainingConfig(
        dataset="recording",
        depth=DepthModelSpec(height=HEIGHT, width=WIDTH, min_depth=0.5, max_depth=80),
        recordings=recordings,
        optimizer=OptimizerConfig(samples_per_step=samples_per_batch, samples_per_batch=samples_per_batch),
    )


def reader(index: RecordingIndex, recordings: RecordingsConfig = RECORDED) -> SampleReader:
    return SampleReader([index], find_samples(index, recordings, "training"), HEIGHT, WIDTH, recordings)


def recorded_motions(index: RecordingIndex, target: int, context: int) -> np.ndarray:
    """context_T_target of each camera, by the index's own poses."""
    mounts = np.stack([camera.base_T_camera for camera in index.layout.complete().cameras])
    return np.linalg.inv(index.poses[context] @ mounts) @ (index.poses[target] @ mounts)


def test_motions_are_each_cameras_own_from_exposure_to_exposure(index):
    of = reader(index)
    sample = of.samples[3]
    batch = of.rigs[0].batch(*(torch.from_numpy(part)[None] for part in of[3][1:6]))
    for place, context in enumerate((sample.before, sample.after)):
        expected = recorded_motions(index, sample.target, context)
        np.testing.assert_allclose(batch.recorded_motions[0, place].numpy(), expected, atol=1e-5)
    torch.testing.assert_close(batch.base_T_camera, batch.recorded_poses[:, 0])
    assert batch.exposure_delays is None
    assert np.ptp(batch.recorded_motions[0, 0, :, :3, 3].norm(dim=-1).numpy()) > 0.001  # 81 ms apart, and speeding up


def test_without_exposure_motion_every_camera_moves_from_the_anchors_moment(index):
    of = reader(index, RECORDED.model_copy(update={"exposure_motion": "none"}))
    poses = of.recorded_poses(of.samples[3])
    np.testing.assert_allclose(poses[0], of.rigs[0].base_T_camera, atol=1e-9)
    anchor = recorded_motions(index, of.samples[3].target, of.samples[3].after)[index.anchor]
    found = np.linalg.inv(poses[2, index.anchor]) @ poses[0, index.anchor]
    np.testing.assert_allclose(found, anchor, atol=1e-9)


def test_a_camera_whose_clock_is_ahead_moves_as_it_did_when_it_fired(index, tmp_path):
    ahead = restamped(sample_entries(), "/camera/left/image_raw/compressed", lambda _, stamp: stamp + 3_200_000_000)
    cameras = [
        camera.model_copy(update={"stamp_offset": 3.2}) if camera.name == "left" else camera
        for camera in index.layout.cameras
    ]
    layout = index.layout.model_copy(update={"cameras": tuple(cameras)})
    shifted = build_index(write_rosbag2(tmp_path / "ahead", ahead), MATCHING, layout)
    found, expected = (reader(of).recorded_poses(reader(of).samples[3]) for of in (shifted, index))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_auto_takes_what_each_recording_has_and_says_which(index, blind):
    assert [describe_motion(of, AUTO) for of in (index, blind)] == [
        "recorded (/tf)",
        "pose network, for none is recorded",
    ]
    assert describe_motion(index, RecordingsConfig()) == "pose network"
    assert reader(blind, AUTO)[0].recorded_poses is None
    assert reader(index, RecordingsConfig(held_out=0.0))[0].recorded_poses is None
    with pytest.raises(RecordingError, match=r"blind: no motion is recorded, but recordings\.motion is 'recorded'"):
        RecordingBatches([index, blind], config(RECORDED))


def test_a_batch_never_mixes_recorded_and_unrecorded_motion(index, blind):
    together = RecordingBatches([index, blind], config(AUTO, samples_per_batch=4))
    found = [batch for batch in together.epoch(0) if batch is not None]
    assert sorted(len(batch.frames) for batch in found) == [4, 4, 4, 4]
    assert sorted(batch.recorded_poses is None for batch in found) == [False, False, True, True]


def test_every_epoch_draws_how_far_each_targets_contexts_are(index):
    further = RECORDED.model_copy(update={"further_travels": (0.6, 1.2)})
    batches = RecordingBatches([index], config(further))
    assert batches.samples == len(batches) == 8
    assert [len(of_target) for of_target in find_variants(index, further)] == [1, 2, 2, 3, 3, 3, 2, 1]
    taken = {
        (target.target, round(float(batch.context_times[0, 1]), 1))
        for epoch in range(6)
        for target, batch in zip(batches.targets, batches.epoch(epoch), strict=True)
        if batch is not None
    }
    assert {seconds for _, seconds in taken} >= {0.1, 0.2, 0.3}
    again = RecordingBatches([index], config(further))
    for one, other in zip(batches.epoch(3, first=2), list(again.epoch(3))[2:], strict=True):
        assert torch.equal(one.context_times, other.context_times)


def test_predicted_motion_knows_near_contexts_only(index):
    further = RecordingsConfig(held_out=0.0, further_travels=(0.6,))
    assert [len(of_target) for of_target in find_variants(index, further)] == [1] * 8


def test_contexts_beyond_the_greatest_travel_are_left_out_by_its_number(index):
    short = RECORDED.model_copy(update={"max_travel": 0.2})
    with pytest.raises(RecordingError, match=r"8 training samples are left out: .* their sets, max_travel is 0.2"):
        refuse_standstill([index], short)


def test_a_slow_recording_is_sampled_at_its_own_rate_where_the_way_is_known(tmp_path):
    """At 2 Hz, sets are half a second apart, give or take."""
    slow = build_index(write_rosbag2(tmp_path / "slow", thinned(sample_entries(), 3)), MATCHING)
    assert len(slow) == 4
    brief = RecordingsConfig(held_out=0.0, max_interval=0.25)
    assert [sample.target for sample in find_samples(slow, brief, "training")] == [1, 2]
    with pytest.raises(RecordingError, match="no training sample in 4 sets"):
        refuse_standstill([replace(slow, poses=None, thumbnails=np.zeros((4, 24, 40), np.uint8))], brief)


def test_cameras_without_overlap_are_taken_where_motion_gives_the_scale(index, tmp_path):
    alone = index.layout.model_copy(
        update={"cameras": tuple(c.model_copy(update={"neighbours": ()}) for c in index.layout.cameras)}
    )
    lonely = build_index(SAMPLE, MATCHING, alone, scale_from="overlaps or motion")
    (batch,) = [one for one in RecordingBatches([lonely], config(RECORDED, 8)).epoch(0) if one is not None]
    assert len(batch.targets) == 0
    assert batch.recorded_motions is not None
    entries = without_motion()
    with pytest.raises(RigError, match="shares no view with another camera"):
        build_index(write_rosbag2(tmp_path / "blind", entries), MATCHING, alone, scale_from="overlaps or motion")


def test_few_held_out_sets_can_prove_nothing(index):
    assert held_out_sets(index, RecordingsConfig()) == 3
    assert describe_unprovable(3) == "promotion impossible: 3 held-out sets, 6 are needed"
    assert describe_unprovable(held_out_sets(index, RecordingsConfig(held_out=0.6))) is None
