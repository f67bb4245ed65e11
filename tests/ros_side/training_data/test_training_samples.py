# SPDX-License-Identifier: Apache-2.0
"""Training samples from recordings: which moments, what pictures, where each camera was."""

import os
import re
from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
import torch
from recordings import CAMERAS, JAZZY, SAMPLE, Entry, changed, cut, restamped, sample_entries, write_rosbag2

from cvcdepth_core.errors import RecordingError, RigError
from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.networks.registry import DepthModelSpec
from cvcdepth_core.training.config import OptimizerConfig, RecordingsConfig, TrainingConfig
from cvcdepth_core.training.distributed import Processes
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.finetuning.held_out import held_out_parts
from cvcdepth_ros.messages.conversion import picture_from_message, stamp_ns
from cvcdepth_ros.recordings.rig import discover_rig
from cvcdepth_ros.settings import MatchingSettings
from cvcdepth_ros.training_data.index import build_index, load_index
from cvcdepth_ros.training_data.loader import RecordingBatches, _collate
from cvcdepth_ros.training_data.sample_choice import describe_skipped_samples, find_samples, refuse_standstill
from cvcdepth_ros.training_data.samples import SampleReader

MATCHING = MatchingSettings()
EVERYTHING = RecordingsConfig(held_out=0.0)
HEIGHT, WIDTH = 64, 96
ONE_STEP_NS = 100_000_000


def config(samples_per_batch: int = 1, recordings: RecordingsConfig = EVERYTHING) -> TrainingConfig:
    return TrainingConfig(
        dataset="recording",
        depth=DepthModelSpec(height=HEIGHT, width=WIDTH, min_depth=0.5, max_depth=80),
        recordings=recordings,
        optimizer=OptimizerConfig(samples_per_step=samples_per_batch, samples_per_batch=samples_per_batch),
    )


def without(entries: Iterable[Entry], *topics: str) -> list[Entry]:
    return [entry for entry in entries if entry.topic not in topics]


@pytest.fixture(scope="module")
def index():
    return build_index(SAMPLE, MATCHING)


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A recording without motion topics whose front camera always shows the same picture."""
    entries = without(sample_entries(), "/odom", "/tf")
    first = next(entry for entry in entries if entry.topic == "/camera/front/image_raw/compressed")
    picture = JAZZY.deserialize_cdr(first.cdr, first.type).data

    def show_the_first(message):
        message.data = picture

    return write_rosbag2(tmp_path_factory.mktemp("still") / "still", changed(entries, first.topic, show_the_first))


def reader(index, recordings=EVERYTHING):
    return SampleReader([index], find_samples(index, recordings, "training"), HEIGHT, WIDTH, recordings)


def test_an_index_knows_every_set_and_where_the_vehicle_was(index):
    assert index.stamps.shape == index.log_times.shape == (10, 6)
    assert (np.diff(index.stamps[:, index.anchor]) > 0.9 * ONE_STEP_NS).all()
    assert index.poses.shape == (10, 6, 4, 4)
    travelled = np.linalg.norm(np.diff(index.poses[:, 0, :3, 3], axis=0), axis=1)
    assert ((travelled > 0.3) & (travelled < 0.5)).all()  # 3 to 5 m/s at 10 Hz


def test_contexts_are_the_nearest_sets_that_are_far_enough(index):
    near = find_samples(index, EVERYTHING, "training")
    assert [tuple(sample[1:]) for sample in near] == [(i, i - 1, i + 1) for i in range(1, 9)]
    far = find_samples(index, EVERYTHING.model_copy(update={"min_travel": 0.6}), "training")
    assert [tuple(sample[1:]) for sample in far] == [(i, i - 2, i + 2) for i in range(2, 8)]


def test_no_sample_reaches_from_one_part_into_the_other(index):
    part = RecordingsConfig(held_out=0.4)
    training, held_out = (find_samples(index, part, name) for name in ("training", "held_out"))
    assert training
    assert held_out
    assert max(chain.from_iterable(sample[1:] for sample in training)) == 5
    assert min(chain.from_iterable(sample[1:] for sample in held_out)) == 6


def test_samples_between_whose_sets_the_vehicle_moves_too_far_are_left_out_and_told(index):
    poses = index.poses.copy()
    poses[6:, :, 0, 3] += 5.0
    jumping = replace(index, poses=poses)
    samples = find_samples(jumping, EVERYTHING, "training")
    assert [sample.target for sample in samples] == [1, 2, 3, 4, 7, 8]
    told = describe_skipped_samples(jumping, EVERYTHING)
    assert re.match(r"2 training samples are left out: the vehicle moves up to 5\.\d m between two", told)
    assert describe_skipped_samples(index, EVERYTHING) is None
    fast = replace(index, poses=np.where(np.arange(4) == 3, 20 * index.poses, index.poses))
    with pytest.raises(RecordingError, match=r"no training sample in 10 sets: 8 training samples are left out"):
        RecordingBatches([fast], config())


def test_a_clock_that_is_set_meanwhile_does_not_change_what_is_held_out(tmp_path):
    entries = without(sample_entries(), "/odom", "/tf")
    for topic in [f"/camera/{name}/image_raw/compressed" for name in CAMERAS]:
        entries = list(restamped(entries, topic, lambda number, ns: ns % 10**15 if number < 4 else ns))
    index = build_index(write_rosbag2(tmp_path / "set", entries), MATCHING)
    assert np.ptp(index.stamps[:, index.anchor]) > 10**18
    part = RecordingsConfig(held_out=0.4)
    training, held_out = (find_samples(index, part, name) for name in ("training", "held_out"))
    assert max(chain.from_iterable(sample[1:] for sample in training)) == 3
    assert min(chain.from_iterable(sample[1:] for sample in held_out)) == len(index) - 4 == 6
    (found,) = held_out_parts([index], config(recordings=part), "cpu", None)
    assert found.spans[0][0] > index.log_times[:6].max()


def test_a_gap_is_not_bridged(tmp_path):
    entries = sample_entries()
    start = entries[0].log_time
    gap = [e for e in entries if not (4 <= (e.log_time - start) // ONE_STEP_NS < 8) or "image" not in e.topic]
    recording = build_index(write_rosbag2(tmp_path / "gap", gap), MATCHING)
    found = find_samples(recording, EVERYTHING.model_copy(update={"max_interval": 0.3}), "training")
    stamps = recording.stamps[:, recording.anchor]
    assert found
    assert all(stamps[s.after] - stamps[s.before] < 3 * ONE_STEP_NS for s in found)


def test_standing_still_is_refused_by_the_recordings_name_and_the_values(index, still):
    with pytest.raises(RecordingError, match=r"pandaset_002_excerpt: no training sample in 10 sets.*min_travel is 9"):
        refuse_standstill([index], RecordingsConfig(min_travel=9))
    standing = build_index(still, MATCHING)
    assert standing.poses is None
    with pytest.raises(RecordingError, match=r"still: .*pictures change by 0.00 at most, min_image_change is 2"):
        RecordingBatches([standing], config())


def test_without_recorded_motion_the_pictures_tell_it(tmp_path):
    recording = build_index(write_rosbag2(tmp_path / "blind", without(sample_entries(), "/odom", "/tf")), MATCHING)
    assert recording.poses is None
    assert len(find_samples(recording, EVERYTHING, "training")) == 8


def test_pictures_are_those_that_the_node_would_see(index):
    preprocessor = SurroundPreprocessor(index.layout.complete(), HEIGHT, WIDTH)
    pictures = reader(index).pictures(0, 7)
    with open_recording(SAMPLE) as recording:
        for camera, entry in enumerate(index.layout.cameras):
            messages = [recording.deserialize(m) for m in recording.messages([entry.image_topic])]
            message = next(m for m in messages if stamp_ns(m) == index.stamps[7, camera])
            reduction = preprocessor.rectifiers[entry.name].reduction
            picture = picture_from_message(message, entry.name, reduction)
            expected = preprocessor.rectify(camera, picture, reduction)
            np.testing.assert_array_equal(pictures[camera], expected)


def test_a_camera_that_fires_later_stands_further_along_the_way(index):
    moved = reader(index).camera_poses(0, 5)
    fixed = reader(index, EVERYTHING.model_copy(update={"exposure_motion": "none"})).camera_poses(0, 5)
    delays = (index.stamps[5] - index.stamps[5, index.anchor]) / 1e9
    speed = np.linalg.norm(index.poses[6, 0, :3, 3] - index.poses[4, 0, :3, 3]) / 0.2
    ahead = (moved - fixed)[:, 0, 3]  # the base frame's x is forward
    np.testing.assert_allclose(ahead, delays * speed, atol=0.02)
    np.testing.assert_allclose(moved[index.anchor], fixed[index.anchor], atol=1e-9)
    in_world = index.poses[5, index.anchor] @ moved
    np.testing.assert_allclose(in_world, index.poses[5] @ fixed, atol=1e-9)
    assert np.ptp(ahead) > 0.2


@pytest.mark.parametrize("motion", ["recorded", "network"])
def test_a_camera_whose_clock_is_ahead_stands_where_it_was_when_it_fired(index, motion, tmp_path):
    ahead = restamped(sample_entries(), "/camera/left/image_raw/compressed", lambda _, stamp: stamp + 3_200_000_000)
    cameras = [
        camera.model_copy(update={"stamp_offset": 3.2}) if camera.name == "left" else camera
        for camera in index.layout.cameras
    ]
    layout = index.layout.model_copy(update={"cameras": tuple(cameras)})
    shifted = build_index(write_rosbag2(tmp_path / "ahead", ahead), MATCHING, layout)
    settings = EVERYTHING.model_copy(update={"exposure_motion": motion})
    found, expected = (reader(of, settings)[3] for of in (shifted, build_index(SAMPLE, MATCHING, index.layout)))
    for shown, there in zip(found, expected, strict=True):
        np.testing.assert_array_equal(shown, there)


def test_the_network_is_told_the_delays_that_no_recorded_motion_makes_good_for(index, tmp_path):
    blind = build_index(write_rosbag2(tmp_path / "blind", without(sample_entries(), "/odom", "/tf")), MATCHING)
    delays = (index.stamps[3] - index.stamps[3, index.anchor]) / 1e9

    def third(recording, motion):
        settings = EVERYTHING.model_copy(update={"exposure_motion": motion})
        batches = RecordingBatches([recording], config(recordings=settings))
        item = next(i for i, sample in enumerate(batches.reader.samples) if sample.target == 3)
        return _collate(batches.reader.rigs, [None], [batches.reader[item]])

    told = {
        (name, motion): third(recording, motion).exposure_delays
        for name, recording, motion in (
            ("moved", index, "auto"),
            ("moved", index, "recorded"),
            ("moved", index, "none"),
            ("blind", blind, "none"),
        )
    }
    assert set(told.values()) == {None}
    for recording, motion in ((index, "network"), (blind, "auto"), (blind, "network")):
        batch = third(recording, motion)
        torch.testing.assert_close(batch.exposure_delays[0].double(), torch.from_numpy(delays), rtol=0, atol=1e-7)
        torch.testing.assert_close(batch.context_times, torch.tensor([[-0.1, 0.1]]), rtol=0, atol=0.002)
    with pytest.raises(RecordingError, match=r"blind: no motion is recorded, but recordings.exposure_motion is"):
        third(blind, "recorded")


def test_exposure_poses_lead_from_set_to_set_as_the_recorded_motion_does(index):
    """What the objective takes for granted: a camera's motion is the anchor's, conjugated with these poses."""
    poses = reader(index).camera_poses(0, 5)
    world_T_camera = index.poses[:, :] @ np.stack([c.base_T_camera for c in index.layout.complete().cameras])
    anchor = index.anchor
    anchor_motion = np.linalg.inv(world_T_camera[6, anchor]) @ world_T_camera[5, anchor]
    for camera in range(6):
        anchor_T_camera = np.linalg.inv(poses[anchor]) @ poses[camera]
        distributed = np.linalg.inv(anchor_T_camera) @ anchor_motion @ anchor_T_camera
        recorded = np.linalg.inv(world_T_camera[6, camera]) @ world_T_camera[5, camera]
        np.testing.assert_allclose(distributed, recorded, atol=0.01)


def test_a_batch_holds_the_target_first_and_the_rigs_constants(index):
    batches = RecordingBatches([index], config(samples_per_batch=3))
    found = list(batches.epoch(0))
    assert [len(batch.frames) for batch in found] == [3, 3, 2]
    assert found[0].frames.shape[1:] == (3, 6, 3, HEIGHT, WIDTH)
    first = batches.reader[batches._shuffled(0)[0][0]]
    expected = torch.from_numpy(first.pictures).permute(0, 1, 4, 2, 3) / 255
    torch.testing.assert_close(found[0].frames[0], expected)
    assert tuple(found[0].camera_names) == tuple(index.layout.names)


def test_an_epoch_has_every_sample_once_in_an_order_of_its_own_and_can_be_entered_anywhere(index):
    batches = RecordingBatches([index], config())
    orders = [list(chain.from_iterable(batches._shuffled(epoch))) for epoch in (0, 1, 0)]
    assert sorted(orders[0]) == list(range(batches.samples))
    assert orders[0] == orders[2] != orders[1]
    whole, rest = list(batches.epoch(1)), list(batches.epoch(1, first=5))
    assert len(rest) == len(whole) - 5
    for late, batch in zip(rest, whole[5:], strict=True):
        assert torch.equal(late.frames, batch.frames)


def test_workers_read_what_the_process_itself_reads(index):
    alone = list(RecordingBatches([index], config()).epoch(0))
    spread = list(RecordingBatches([index], config(recordings=RecordingsConfig(held_out=0, workers=2))).epoch(0))
    for one, other in zip(alone, spread, strict=True):
        assert torch.equal(one.frames, other.frames)
        assert torch.equal(one.base_T_camera, other.base_T_camera)


def test_every_batch_is_of_one_rig(index):
    with open_recording(SAMPLE) as recording:
        layout = discover_rig(recording)
    three = layout.model_copy(update={"cameras": layout.cameras[:3]})
    batches = RecordingBatches([index, build_index(SAMPLE, MATCHING, three)], config(samples_per_batch=3))
    names = [tuple(batch.camera_names) for batch in batches.epoch(0)]
    assert sorted(map(len, names)) == [3, 3, 3, 6, 6, 6]


def test_processes_share_an_epoch_and_none_is_left_without_a_batch(index):
    with open_recording(SAMPLE) as recording:
        layout = discover_rig(recording)
    three = layout.model_copy(update={"cameras": layout.cameras[:3]})
    indexes = [index, build_index(SAMPLE, MATCHING, three)]
    shares = [RecordingBatches(indexes, config(), Processes(rank, 3)) for rank in range(3)]
    parts = []
    for share in shares:
        list(share.epoch(4))
        parts.append(share._order.batches)
    together = [list(chain.from_iterable(batches)) for batches in zip(*parts, strict=True)]
    assert [len(samples) for samples in together] == [3] * 6
    assert sorted(set(chain.from_iterable(together))) == list(range(16))
    whole = RecordingBatches(indexes, config(samples_per_batch=3))
    assert [set(samples) for samples in together] == [set(samples) for samples in whole._shuffled(4)]


def test_a_damaged_image_costs_its_samples_only(tmp_path):
    entries = sample_entries()
    left = [i for i, entry in enumerate(entries) if entry.topic == "/camera/left/image_raw/compressed"]

    def cut(message):
        message.data = message.data[: len(message.data) // 2]

    entries[left[4]] = next(iter(changed([entries[left[4]]], entries[left[4]].topic, cut)))
    batches = RecordingBatches([build_index(write_rosbag2(tmp_path / "cut", entries), MATCHING)], config())
    found = list(batches.epoch(0))
    assert (len(found), found.count(None)) == (8, 3)


def test_an_index_is_kept_and_built_anew_when_the_recording_changes(tmp_path, index):
    bag = write_rosbag2(tmp_path / "drive", sample_entries(4))
    load_index(bag, tmp_path / "index", MATCHING)
    (kept,) = (tmp_path / "index").iterdir()
    written = kept.stat().st_mtime_ns
    again = load_index(bag, tmp_path / "index", MATCHING)
    assert kept.stat().st_mtime_ns == written
    fresh = build_index(bag, MATCHING)
    for name in ("stamps", "log_times", "poses"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fresh, name))
    assert again.layout == fresh.layout
    os.utime(next(bag.glob("*.mcap")))
    load_index(bag, tmp_path / "index", MATCHING)
    assert kept.stat().st_mtime_ns > written
    kept.write_bytes(kept.read_bytes()[:1000])
    assert len(load_index(bag, tmp_path / "index", MATCHING)) == len(fresh)


def spoiled(entries: list[Entry], topic: str, number: int, spoil: Callable[[Entry], Entry]) -> list[Entry]:
    """The same recording with one message of a topic spoiled."""
    at = [i for i, entry in enumerate(entries) if entry.topic == topic][number]
    return [spoil(entry) if i == at else entry for i, entry in enumerate(entries)]


def without_direction(entry: Entry) -> Entry:
    message = JAZZY.deserialize_cdr(entry.cdr, entry.type)
    turn = message.transforms[0].transform.rotation if entry.topic == "/tf" else message.pose.pose.orientation
    turn.x = turn.y = turn.z = turn.w = 0.0
    return entry._replace(cdr=bytes(JAZZY.serialize_cdr(message, entry.type)))


def cut_short(entry: Entry) -> Entry:
    return entry._replace(cdr=entry.cdr[:40])


@pytest.mark.parametrize("spoil", [without_direction, cut_short])
@pytest.mark.parametrize(("topic", "other"), [("/tf", "/odom"), ("/odom", "/tf")])
def test_an_impossible_pose_costs_itself_only_and_is_told(spoil, topic, other, index, tmp_path):
    for number, placed in ((0, 9), (13, 10)):
        entries = spoiled(without(sample_entries(), other), topic, number, spoil)
        recording = load_index(write_rosbag2(tmp_path / f"{number}", entries), tmp_path / "index", MATCHING)
        assert (len(recording), recording.without_motion) == (placed, 10 - placed)
        np.testing.assert_allclose(recording.poses, index.poses[-placed:], atol=0.02)
        (told,) = recording.unread
        assert told.startswith("1 refused, the first: ")
        assert topic in told
        again = load_index(tmp_path / f"{number}", tmp_path / "index", MATCHING)
        assert again.unread == recording.unread


def test_a_broken_link_of_a_wheel_does_not_cost_the_vehicles_pose_beside_it(index, tmp_path):
    def with_wheel(message):
        wheel = deepcopy(message.transforms[0])
        wheel.header.frame_id, wheel.child_frame_id, wheel.transform.rotation.w = "base_link", "wheel", 9.0
        message.transforms = [wheel, *message.transforms]

    recording = build_index(write_rosbag2(tmp_path / "bag", changed(sample_entries(), "/tf", with_wheel)), MATCHING)
    np.testing.assert_array_equal(recording.poses, index.poses)


def test_a_camera_info_that_cannot_be_read_costs_no_set_and_is_told(tmp_path):
    entries = spoiled(sample_entries(3), "/camera/left/camera_info", 1, cut_short)
    recording = build_index(write_rosbag2(tmp_path / "bag", entries), MATCHING)
    assert len(recording) == 3
    assert "1 refused, the first:" in recording.unread[0]
    assert "/camera/left/camera_info at" in recording.unread[0]


def test_a_camera_without_images_is_refused_by_name(tmp_path):
    entries = without(sample_entries(2), "/camera/left/image_raw/compressed")
    with pytest.raises(RecordingError, match=r"lame: /camera/left/camera_info is recorded, but no image"):
        build_index(write_rosbag2(tmp_path / "lame", entries), MATCHING)


def test_a_camera_without_overlap_is_refused_by_name(index):
    alone = [c.model_copy(update={"neighbours": ()}) if c.name == "back" else c for c in index.layout.cameras]
    layout = index.layout.model_copy(update={"cameras": tuple(alone)})
    with pytest.raises(RigError, match=r"excerpt: camera back: shares no view"):
        build_index(SAMPLE, MATCHING, layout)


def test_sets_that_the_recorded_motion_does_not_reach_are_left_out(tmp_path):
    entries = sample_entries()
    last = max(entry.log_time for entry in entries)
    short = [e for e in entries if e.topic not in ("/tf", "/odom") or last - e.log_time > 3 * ONE_STEP_NS]
    recording = build_index(write_rosbag2(tmp_path / "short", short), MATCHING)
    assert len(recording) + recording.without_motion == 10
    assert recording.without_motion >= 3
    assert recording.losses == [f"{recording.without_motion} sets lie outside of the recorded motion"]


def test_an_index_tells_what_of_the_recording_was_not_there_to_learn_from(index, tmp_path):
    assert index.losses == []
    topic = "/camera/front/image_raw/compressed"
    entries = without(sample_entries(), "/odom", "/tf")
    front = [i for i, entry in enumerate(entries) if entry.topic == topic]
    entries[front[4]] = next(iter(changed([entries[front[4]]], topic, lambda m: setattr(m, "data", m.data[:1000]))))
    entries[front[7]] = entries[front[7]]._replace(cdr=entries[front[7]].cdr[:20])
    whole = write_rosbag2(tmp_path / "whole", entries) / "whole.mcap"
    recording = cut(whole, tmp_path / "cut.mcap", 0.95)
    for found in (build_index(recording, MATCHING), *(load_index(recording, tmp_path, MATCHING) for _ in range(2))):
        damage, unreadable, undecodable = found.losses
        assert damage.startswith(f"not everything could be read: {recording}: ")
        assert unreadable.startswith(f"1 refused, the first: camera front: {recording}: {topic} at ")
        assert undecodable == "1 sets are left out: no picture of camera front could be decoded"


def test_motion_that_reaches_no_set_is_refused_by_the_recordings_name(tmp_path):
    entries = sample_entries(3)
    first = next(entry for entry in entries if entry.topic == "/tf")
    odd = [first, *without(entries, "/tf", "/odom")]
    with pytest.raises(RecordingError, match=r"odd: none of its 3 surround sets lies within the recorded motion"):
        build_index(write_rosbag2(tmp_path / "odd", odd), MATCHING)


def test_a_recording_that_lost_its_messages_since_gives_no_batch(index, tmp_path):
    shorter = replace(index, path=write_rosbag2(tmp_path / "shorter", sample_entries(1)))
    assert list(RecordingBatches([shorter], config()).epoch(0)) == [None] * 8


def on_ground(index, height):
    return replace(index, layout=index.layout.model_copy(update={"ground_height": height}))


def test_poses_are_those_above_the_ground_of_the_rig_file(index):
    plain, lowered = (next(RecordingBatches([on_ground(index, h)], config()).epoch(0)) for h in (0.0, -0.4))
    above = plain.base_T_camera.clone()
    above[..., 2, 3] += 0.4
    torch.testing.assert_close(lowered.base_T_camera, above)


def test_a_ground_that_cannot_be_is_refused_where_the_network_is_told_it(index):
    spec = DepthModelSpec(
        network="rig_conditioned",
        encoder="efficientnet_lite0",
        height=HEIGHT,
        width=WIDTH,
        min_depth=0.4,
        max_depth=250,
    )
    buried = on_ground(index, 1.7)
    RecordingBatches([buried], config())
    with pytest.raises(RigError, match=r"pandaset_002_excerpt: camera front: 0\.11 m above the ground, .* 0\.2 to 6"):
        RecordingBatches([buried], config().model_copy(update={"depth": spec}))
