# SPDX-License-Identifier: Apache-2.0
"""Cameras that die, freeze, change and return while the node runs: what is published and what is said. One node."""

import copy
import itertools
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from recordings import CAMERAS

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from camera_faults import FAULTS, frozen, silent
from camera_scene import CLOUD, DEPTH, Scene, running_scene, stamp_of
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import CameraInfo


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    with running_scene(tmp_path_factory.mktemp("rig")) as scene:
        yield scene


@pytest.fixture
def scene(running: Scene) -> Iterator[Scene]:
    yield running
    running.recover()


def test_a_dead_camera_is_told_and_the_others_go_on_until_it_returns(scene):
    scene.fail(left=silent)
    scene.await_cameras([name for name in CAMERAS if name != "left"])
    status = scene.await_state("left", "stale: no image for more than 1 s")
    assert status.level == DiagnosticStatus.ERROR


def test_another_camera_stands_in_for_a_dead_anchor(scene):
    anchor = CAMERAS[0]
    scene.fail(**{anchor: silent})
    scene.await_cameras(list(CAMERAS[1:]))
    cloud = scene.graph.received[CLOUD][-1]
    assert stamp_of(cloud) in scene.cameras.sent[CAMERAS[1]]
    scene.recover()
    assert stamp_of(scene.graph.received[CLOUD][-1]) in scene.cameras.sent[anchor]


@pytest.mark.parametrize("camera", CAMERAS[:2])
def test_a_camera_whose_clock_is_an_hour_ahead_is_told_and_left_out_even_when_it_is_the_anchor(scene, camera):
    scene.fail(**{camera: FAULTS["stamps an hour ahead"].image})
    scene.await_state(camera, "unmatched")
    scene.await_cameras([name for name in CAMERAS if name != camera])


def test_a_wrong_clock_is_told_beside_a_dead_camera(scene):
    scene.fail(left=silent, right=FAULTS["stamps an hour ahead"].image)
    scene.await_state("right", "unmatched")
    scene.await_state("left", "stale")


def test_too_few_cameras_hold_everything_back(scene):
    scene.fail(left=silent, right=silent, back=silent)
    last = max(scene.cameras.sent["back"])
    scene.await_state("back", "stale")
    for _ in range(5):
        scene.cameras.cycle()
        scene.graph.spin(0.1)
    assert max(map(stamp_of, scene.graph.received[CLOUD])) <= last


def test_a_camera_that_sends_the_same_picture_for_ever_is_frozen_and_left_out(scene):
    scene.fail(left=frozen())
    scene.await_state("left", "frozen: the same picture or stamp again and again")
    scene.await_cameras([name for name in CAMERAS if name != "left"])


def test_a_camera_whose_stamps_stand_still_is_frozen_and_left_out(scene):
    stamps = []

    def stop_the_clock(image: Any) -> Any:
        stamps.append(image.header.stamp)
        image.header.stamp = stamps[0]
        return image

    scene.fail(left=stop_the_clock)
    scene.await_state("left", "frozen")
    scene.await_cameras([name for name in CAMERAS if name != "left"])


def test_a_camera_that_sends_rubbish_is_rejected_and_left_out(scene):
    def cut(image: Any) -> Any:
        image.data = image.data[:1000]
        return image

    scene.fail(left=cut)
    status = scene.await_state("left", "rejected: ")
    assert status.level == DiagnosticStatus.ERROR
    scene.await_cameras([name for name in CAMERAS if name != "left"])


def test_a_camera_whose_calibration_becomes_impossible_is_left_out_at_once(scene):
    bad = copy.deepcopy(scene.cameras.infos["left"])
    bad.k = np.zeros(9)
    scene.cameras.infos["left"] = bad
    scene.await_state("left", "K[0] = 0: the camera is not calibrated")
    scene.await_cameras([name for name in CAMERAS if name != "left"])


def test_a_camera_that_changes_its_calibration_goes_on_with_the_new_one(scene):
    good = scene.cameras.infos["left"]
    wider = copy.deepcopy(good)
    wider.k[0] = wider.k[4] = wider.p[0] = wider.p[5] = good.k[0] / 2
    scene.cameras.infos["left"] = wider
    info_topic = "/surround_depth/left/depth/camera_info"
    scene.graph.subscribe(CameraInfo, info_topic)
    received = scene.graph.received[info_topic]

    def shows(info: CameraInfo) -> bool:
        return bool(received) and received[-1].k[0] == pytest.approx(info.k[0] * 96 / info.width)

    scene.cameras.run_until(lambda: shows(wider), "the new focal length")
    scene.cameras.infos["left"] = good
    scene.cameras.run_until(lambda: shows(good), "the old one")


def test_a_camera_whose_calibration_changes_with_every_image_holds_up_no_other(scene):
    good = scene.cameras.good_infos["left"]
    wider = copy.deepcopy(good)
    wider.k[0] = wider.k[4] = wider.p[0] = wider.p[5] = good.k[0] / 2
    both = itertools.cycle([wider, good])

    def recalibrated(image: Any) -> Any:
        for _ in range(20):
            scene.cameras.infos["left"] = next(both)
            scene.cameras.publish_info("left")
        return image

    before = scene.node.resources()
    scene.fail(left=recalibrated)
    topic = DEPTH["right"]
    for _ in range(5):
        scene.graph.received[topic].clear()
        scene.cameras.run_until(lambda: len(scene.graph.received[topic]) > 5, "depth of another camera")
    assert scene.node.resources().resident_mib < before.resident_mib + 200


def test_a_camera_whose_clock_jumps_away_is_told_and_left_out(scene):
    def late_by_an_hour(image: Any) -> Any:
        image.header.stamp.sec += 3600
        return image

    scene.fail(left=late_by_an_hour)
    scene.await_cameras([name for name in CAMERAS if name != "left"])
    scene.await_state("left", "unmatched: its images come, but their stamps fit no set")


def test_every_published_depth_belongs_to_an_image_of_that_camera_and_stamp(scene):
    received = scene.graph.received
    scene.cameras.run_until(lambda: all(len(received[topic]) > 10 for topic in DEPTH.values()), "some depth of each")
    for name, topic in DEPTH.items():
        stamps = [stamp_of(message) for message in received[topic]]
        assert set(stamps) <= scene.cameras.sent[name]
        assert len(set(stamps)) == len(stamps)


def test_the_trace_tells_what_ran_on_which_thread_also_while_the_node_runs(scene):
    events = json.loads(scene.trace.read_text().rpartition("},")[0] + "}]")
    threads = {event["tid"]: event["args"]["name"] for event in events if event["name"] == "thread_name"}
    where = {(event["name"], threads[event["tid"]].partition("_")[0]) for event in events if event["ph"] == "X"}
    assert {("decode", "prepare"), ("preprocess", "prepare"), ("inference", "inference")} <= where
    assert {("postprocess", "publish"), ("publish", "publish")} <= where
