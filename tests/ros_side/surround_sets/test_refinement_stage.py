# SPDX-License-Identifier: Apache-2.0
"""The stage between the network's depth and what becomes of it."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import SAMPLE

from cvcdepth_core.estimator import DepthEstimator, SurroundDepthEstimator
from cvcdepth_core.networks import DepthModelSpec
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.messages.conversion import bag_message_factory
from cvcdepth_ros.recordings.replay import DepthReplay, SurroundReplay
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.settings import MatchingSettings, ModelSettings
from cvcdepth_ros.surround_sets.output_messages import OutputLimits, SurroundMessages
from cvcdepth_ros.surround_sets.refinement import RefinementStage

GEOMETRY = ModelSettings.model_validate({"refine": "geometry"})
OFF = ModelSettings.model_validate({"refine": "off"})
AUTO = ModelSettings.model_validate({"refine": "auto"})


@pytest.fixture(scope="module")
def drive():
    """The sample's sets with the depth of a small network, and what estimated them."""
    spec = DepthModelSpec(encoder="resnet18", height=96, width=160, min_depth=1.5, max_depth=200.0)
    with open_recording(SAMPLE) as recording:
        replay = SurroundReplay(RecordedRig.from_recording(recording), MatchingSettings())
        depths = DepthReplay(replay, DepthEstimator.untrained(spec, "cpu"))
        sets = list(depths.sets())[:3]
    return depths.surround, sets


def finished(stage: RefinementStage, surround: SurroundDepthEstimator, sets: list):
    return [stage.finished(surround, one.surround_set, one.result) for one in sets]


def test_switched_off_it_gives_what_it_is_given(drive):
    surround, sets = drive
    stage = RefinementStage(OFF)
    assert not stage.is_active
    assert [one.result for one in finished(stage, surround, sets)] == [one.result for one in sets]
    assert stage.summary() is None


def test_auto_refines_from_when_on_something_tells_the_motion(drive):
    surround, sets = drive
    motion = [False, True, True]
    stage = RefinementStage(AUTO, knows_motion=lambda: motion[0])
    assert stage.needs_motion
    for before in sets:
        is_known = motion[0]
        (after,) = finished(stage, surround, [before])
        assert (after.result.depth is before.result.depth) is not is_known
        motion.pop(0)
        motion.append(True)


def test_confidence_alone_leaves_depth_as_it_is(drive):
    surround, sets = drive
    stage = RefinementStage(OFF, wants_confidence=lambda: True)
    for before, after in zip(sets, finished(stage, surround, sets), strict=True):
        np.testing.assert_array_equal(after.result.depth, before.result.depth)
        assert after.result.confidence.shape == before.result.depth.shape
        assert 0 < after.result.confidence.max() <= 1
        assert not after.result.confidence[np.isnan(after.result.depth)].any()


def test_depth_stays_where_it_was_and_nowhere_becomes_unknown(drive):
    surround, sets = drive
    for before, after in zip(sets, finished(RefinementStage(GEOMETRY), surround, sets), strict=True):
        np.testing.assert_array_equal(np.isnan(after.result.depth), np.isnan(before.result.depth))
        assert (after.result.depth != before.result.depth).any()


def test_another_rig_or_network_begins_anew(drive):
    surround, sets = drive
    stage = RefinementStage(GEOMETRY)
    first = finished(stage, surround, sets)
    other = SurroundDepthEstimator(surround.rig, surround.estimator, surround)
    again = finished(stage, other, sets)
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.result.depth, two.result.depth)


def test_a_camera_that_is_absent_is_compared_with_nothing(drive):
    surround, (one, *_) = drive
    present = np.arange(len(surround.rig.names)) != 2
    depth = np.where(present[:, None, None], one.result.depth, np.float32(np.nan))
    pictures = one.result.pictures * present[:, None, None, None].astype(np.uint8)
    result = replace(one.result, depth=depth, pictures=pictures, present=present)
    stage = RefinementStage(GEOMETRY)
    found = stage.finished(surround, one.surround_set, result)
    assert np.isnan(found.result.depth[2]).all()
    assert not found.result.confidence[2].any()
    neighbours = dict(zip(stage.last.cameras, stage.last.refined.depth.beside.tolist(), strict=True))
    assert neighbours["front_left"] == 1  # two but for the one that is absent


def test_depth_that_is_not_sure_enough_is_left_out_of_images_and_not_of_what_is_kept(drive):
    surround, (one, *_) = drive
    found = RefinementStage(GEOMETRY).finished(surround, one.surround_set, one.result)
    messages = SurroundMessages(bag_message_factory(), "32FC1", depth_min_confidence=0.5)
    frames = dict.fromkeys(surround.rig.names, "frame")
    wanted = {"left/depth/image_rect", "left/depth/confidence"}
    built = {m.topic: m.message for m in messages.of_set(found, frames, OutputLimits(), wanted.__contains__)}
    assert built.keys() == wanted
    images = {topic: m.data.view(np.float32).reshape(m.height, m.width) for topic, m in built.items()}
    sure = images["left/depth/confidence"] >= 0.5
    np.testing.assert_array_equal(np.isnan(images["left/depth/image_rect"]), ~sure)
    stamps = {(m.header.stamp.sec, m.header.stamp.nanosec, m.header.frame_id) for m in built.values()}
    assert len(stamps) == 1


def test_whoever_asks_is_told_where_the_vehicle_was_at_each_exposure(drive):
    surround, (one, *_) = drive
    poses = {name: np.eye(4) * (index + 1) for index, name in enumerate(surround.rig.names)}
    asked: list[set[str]] = []

    def poses_at(times_ns):
        asked.append(set(times_ns))
        return poses

    stage = RefinementStage(OFF, poses_at, wants_poses=True)
    found = stage.finished(surround, one.surround_set, one.result)
    np.testing.assert_array_equal(found.world_T_base[:, 0, 0], 1 + np.arange(len(poses)))
    assert RefinementStage(OFF, poses_at).finished(surround, one.surround_set, one.result).world_T_base is None
    assert asked == [set(surround.rig.names)]
    unknown = RefinementStage(OFF, lambda _: None, wants_poses=True)
    assert unknown.finished(surround, one.surround_set, one.result).world_T_base is None
