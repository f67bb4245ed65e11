# SPDX-License-Identifier: Apache-2.0
"""The node's pipeline without ROS: real messages in, published sets out, on real threads."""

import copy
import gc
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from mean_feature_network import register
from recordings import CAMERAS, SAMPLE

from cvcdepth_core.errors import EngineError, ImageError
from cvcdepth_core.estimator import DepthEstimator, SurroundDepthEstimator
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_core.networks import DepthModelSpec, build_depth_network
from cvcdepth_core.surround_depth import SurroundPictures
from cvcdepth_ros.bags import open_recording
from cvcdepth_ros.live.camera_states import CameraState, CameraWatch
from cvcdepth_ros.live.mailbox import Mailbox
from cvcdepth_ros.live.picture_preparation import CameraImage
from cvcdepth_ros.live.pipeline import SurroundPipeline
from cvcdepth_ros.recordings.rig import discover_rig
from cvcdepth_ros.settings import ModelSettings
from cvcdepth_ros.surround_sets.latencies import StageLatencies
from cvcdepth_ros.surround_sets.refinement import RefinementStage
from cvcdepth_ros.surround_sets.set_estimation import EncodedImage, EstimatedSet, estimate_set, picture_or_error
from cvcdepth_ros.surround_sets.synchronizer import SurroundSynchronizer

TIMEOUT = 60.0


@pytest.fixture(scope="module")
def recording():
    with open_recording(SAMPLE) as recording:
        yield recording


@pytest.fixture(scope="module")
def layout(recording):
    return discover_rig(recording)


@pytest.fixture(scope="module")
def images(recording, layout) -> list[tuple[str, Any]]:
    """The sample's images in their order: camera and message."""
    cameras = {camera.image_topic: camera.name for camera in layout.cameras}
    return [(cameras[m.topic], recording.deserialize(m)) for m in recording.messages(cameras)]


@pytest.fixture(scope="module")
def estimator():
    spec = DepthModelSpec(encoder="resnet18", height=96, width=160, min_depth=1.5, max_depth=200.0)
    return DepthEstimator.untrained(spec, "cpu")


class Slowed:
    """A depth predictor that waits until it is told to go on, but not with the black pictures that warm it up."""

    def __init__(self, predictor: DepthEstimator) -> None:
        self.spec, self.model_id, self.independent = predictor.spec, predictor.model_id, predictor.independent
        self._predictor = predictor
        self.gate = threading.Event()
        self.entered = threading.Event()
        self.warm_up_gate = threading.Event()
        self.warm_up_gate.set()
        self.cameras: list[int] = []
        self.warmed_up: list[int] = []

    def estimate(self, surround: SurroundPictures) -> Any:
        if not np.any(surround.pictures):
            self.warmed_up.append(int(surround.present.sum()))
            assert self.warm_up_gate.wait(TIMEOUT)
            return self._predictor.estimate(surround)
        self.cameras.append(int(surround.present.sum()))
        self.entered.set()
        assert self.gate.wait(TIMEOUT)
        return self._predictor.estimate(surround)


class Running:
    """A pipeline and what came out of it."""

    def __init__(self, layout: Any, predictor: Any, min_cameras: int = 0, refine: str = "off") -> None:
        self.published: list[EstimatedSet[CameraImage]] = []
        self.wanted = set(layout.names)
        self.watches = {name: CameraWatch(1000.0, 1.0) for name in layout.names}
        self.latencies = StageLatencies()
        self.mailbox: Mailbox[Any] = Mailbox()
        self.pipeline = SurroundPipeline(
            predictor,
            SurroundSynchronizer.from_layout(layout, 0.1, min_cameras=min_cameras),
            self.mailbox,
            self.watches,
            lambda camera: camera in self.wanted,
            self.published.append,
            lambda _: None,
            self.latencies,
            RefinementStage(ModelSettings.model_validate({"refine": refine})),
        )

    def feed(self, images: list[tuple[str, Any]]) -> None:
        for camera, message in images:
            self.pipeline.add([camera], message)

    def wait(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, (self.pipeline.counters, self.pipeline.problem)
            time.sleep(0.005)


@pytest.fixture
def start(layout) -> Iterator[Callable[..., Running]]:
    running: list[Running] = []

    def begin(predictor: Any, min_cameras: int = 0, refine: str = "off") -> Running:
        running.append(Running(layout, predictor, min_cameras, refine))
        running[-1].pipeline.set_rig(layout.complete())
        return running[-1]

    yield begin
    for one in running:
        one.pipeline.close()


def test_what_comes_out_is_what_the_bag_tool_computes_to_the_bit(start, estimator, layout, images):
    running = start(estimator)
    running.feed(images[:12])
    running.wait(lambda: running.published)
    first = running.published[0]
    by_stamp = {(c, m.header.stamp.sec * 10**9 + m.header.stamp.nanosec): m for c, m in images}
    messages = {camera: by_stamp[camera, stamp] for camera, stamp in first.surround_set.stamps_ns.items()}
    surround = SurroundDepthEstimator(layout.complete(), estimator)
    expected = estimate_set(messages, surround, StageLatencies(), required=6)
    np.testing.assert_array_equal(first.result.depth, expected.depth)
    np.testing.assert_array_equal(first.result.pictures, expected.pictures)


def test_refined_depth_of_one_subscribed_camera_is_what_it_is_when_all_are(start, estimator, layout, images):
    found = []
    for wanted in (set(layout.names), {"left"}):
        running = start(estimator, refine="geometry")
        running.wanted = wanted
        running.feed(images[:12])
        running.wait(lambda running=running: running.published)
        found.append(running.published[0].result)
    np.testing.assert_array_equal(found[0].depth, found[1].depth)
    np.testing.assert_array_equal(found[0].confidence, found[1].confidence)


def test_a_network_that_looks_at_all_cameras_gives_one_subscriber_what_it_gives_to_all(
    start, layout, images, monkeypatch
):
    spec = register(monkeypatch)
    predictor = DepthEstimator(build_depth_network(spec), spec, "toy", "cpu", "torch_eager")
    depth = []
    for wanted in (set(layout.names), {"left"}):
        running = start(predictor)
        running.wanted = wanted
        running.feed(images[:12])
        running.wait(lambda running=running: running.published)
        depth.append(running.published[0].result)
    assert all(one.present.all() for one in depth)
    np.testing.assert_array_equal(depth[0].depth, depth[1].depth)
    nobody = start(predictor)
    nobody.wanted = set()
    nobody.feed(images[:12])
    nobody.wait(lambda: nobody.pipeline.counters["skipped: no subscriber"])


def test_the_network_is_warmed_up_once_and_not_with_a_real_set(start, estimator, layout, images):
    slowed = Slowed(estimator)
    running = start(slowed)
    running.pipeline.set_rig(layout.complete())
    running.wait(lambda: slowed.warmed_up)
    slowed.gate.set()
    running.feed(images[:12])
    running.wait(lambda: running.published)
    assert slowed.warmed_up == [6]
    assert set(slowed.cameras) == {6}


def test_while_the_network_is_busy_only_the_newest_set_waits(start, estimator, images):
    slowed = Slowed(estimator)
    running = start(slowed)
    running.feed(images[:12])
    assert slowed.entered.wait(TIMEOUT)
    running.feed(images[12:])
    assert running.mailbox.statistics().replaced >= 6
    slowed.gate.set()
    running.wait(lambda: len(running.published) == 2)
    last = max(m.header.stamp.nanosec + 10**9 * m.header.stamp.sec for c, m in images[-12:-6] if c == "front")
    assert running.published[-1].surround_set.stamp_ns >= last
    assert running.pipeline.counters["published"] == 2


def test_images_are_decoded_while_the_network_is_busy_with_the_set_before(start, estimator, images):
    slowed = Slowed(estimator)
    running = start(slowed)
    running.feed(images[:12])
    assert slowed.entered.wait(TIMEOUT)
    decoded = running.latencies.summaries()["preprocess"].count
    running.feed(images[12:18])
    running.wait(lambda: running.latencies.summaries()["preprocess"].count >= decoded + 6)
    assert not running.published


def test_a_complete_set_is_decoded_where_the_network_will_be_free_before_the_next(
    start, estimator, images, monkeypatch: pytest.MonkeyPatch
):
    """When its images came, the network was busy for longer than the next ones would need to come."""
    slowed = Slowed(estimator)
    running = start(slowed)
    left = iter(images)

    def feed_until(sets: int) -> None:
        while running.mailbox.statistics().received < sets:
            running.feed([next(left)])

    is_free = lambda _: running.mailbox.statistics().received >= 2  # noqa: E731
    monkeypatch.setattr(running.pipeline._pace, "is_free_within", is_free)
    feed_until(sets=1)
    assert slowed.entered.wait(TIMEOUT)
    assert running.latencies.summaries()["preprocess"].count == 6
    feed_until(sets=2)
    running.wait(lambda: running.latencies.summaries()["preprocess"].count == 12)
    assert not running.published


def test_only_wanted_cameras_are_decoded_and_estimated(start, estimator, images):
    slowed = Slowed(estimator)
    slowed.gate.set()
    running = start(slowed)
    running.wanted = {"left", "back"}
    running.feed(images[:12])
    running.wait(lambda: running.published)
    assert slowed.cameras[0] == 2
    present = dict(zip(running.published[0].rig.names, running.published[0].result.present.tolist(), strict=True))
    assert present == {name: name in ("left", "back") for name in CAMERAS}
    assert running.latencies.summaries()["decode"].count <= 4


def test_nothing_runs_while_nobody_wants_anything(start, estimator, images):
    running = start(estimator)
    running.wanted = set()
    running.feed(images)
    running.wait(lambda: running.pipeline.counters["skipped: no subscriber"])
    assert not {"decode", "preprocess", "inference"} & running.latencies.summaries().keys()


def damage(images: list[tuple[str, Any]], camera: str) -> list[tuple[str, Any]]:
    cut = []
    for name, message in images:
        if name == camera:
            message = copy.copy(message)
            message.data = message.data[: len(message.data) // 2]
        cut.append((name, message))
    return cut


def test_a_damaged_image_holds_its_set_back_and_names_its_camera(start, estimator, images):
    running = start(estimator)
    running.feed(damage(images[:12], "left"))
    running.wait(lambda: running.pipeline.counters["refused"])
    assert "camera left" in running.pipeline.problem
    assert running.watches["left"].troubles()[0][0] == CameraState.REJECTED
    running.feed(images[12:])
    running.wait(lambda: running.published)
    assert running.watches["left"].troubles() == []


def test_with_min_cameras_a_damaged_image_costs_its_own_camera_only(start, estimator, images):
    running = start(estimator, min_cameras=4)
    running.feed(damage(images[:12], "left"))
    running.wait(lambda: running.published)
    result = running.published[0].result
    assert result.present.tolist() == [name != "left" for name in running.published[0].rig.names]
    assert np.isnan(result.depth[~result.present]).all()


def test_a_silent_camera_is_left_out_and_returns(start, estimator, images):
    running = start(estimator, min_cameras=5)
    running.feed([(c, m) for c, m in images[:48] if c != "back"])
    running.wait(lambda: running.published)
    assert "back" not in running.published[-1].surround_set.images
    running.feed(images[48:])
    running.wait(lambda: "back" in running.published[-1].surround_set.images)


def test_a_camera_without_calibration_is_left_out_until_it_has_one(start, estimator, layout, images):
    running = start(estimator, min_cameras=4)
    complete = layout.complete()
    without = layout.model_copy(update={"cameras": tuple(c for c in layout.cameras if c.name != "left")}).complete()
    running.pipeline.set_rig(without)
    running.feed(images[:12])
    running.wait(lambda: running.published)
    assert "left" not in running.published[-1].rig.names
    running.pipeline.set_rig(complete)
    running.feed(images[12:])
    running.wait(lambda: "left" in running.published[-1].rig.names)


def test_without_a_rig_sets_are_skipped_and_counted(start, estimator, images):
    running = start(estimator)
    running.pipeline.set_rig(None)
    running.feed(images[:12])
    running.wait(lambda: running.pipeline.counters["skipped: rig not complete"])
    assert not running.published


def test_a_failing_publisher_does_not_end_the_stream(start, estimator, images):
    running = start(estimator)
    failures = iter([True])

    def publish(one: EstimatedSet[CameraImage]) -> None:
        if next(failures, False):
            raise RuntimeError("no such luck")
        running.published.append(one)

    running.pipeline._publish = publish
    running.feed(images[:12])
    running.wait(lambda: running.pipeline.problem)
    assert running.pipeline.problem == "RuntimeError: no such luck"
    running.feed(images[12:])
    running.wait(lambda: running.published)
    running.wait(lambda: not running.pipeline.problem)


def test_closing_says_whether_the_last_set_is_done_with(start, estimator, images):
    slowed = Slowed(estimator)
    running = start(slowed)
    running.feed(images[:12])
    assert slowed.entered.wait(TIMEOUT)
    assert not running.pipeline.close()
    slowed.gate.set()
    running.wait(running.pipeline.close)


def test_closing_waits_for_no_build_and_says_that_one_is_still_running(layout, estimator):
    slowed = Slowed(estimator)
    slowed.warm_up_gate.clear()
    running = Running(layout, slowed)
    running.pipeline.set_rig(layout.complete())
    running.wait(lambda: slowed.warmed_up)
    assert not running.pipeline.close()
    slowed.warm_up_gate.set()
    running.wait(running.pipeline.close)


def test_closing_ends_the_wait_for_a_rig_that_will_never_be_built(layout, estimator, images):
    slowed = Slowed(estimator)
    slowed.warm_up_gate.clear()
    running = Running(layout, slowed)
    running.pipeline.set_rig(layout.complete())
    running.wait(lambda: slowed.warmed_up)
    for _ in range(8):  # all threads wait for the warm-up, and the last build for a thread
        running.pipeline.set_rig(layout.complete())
    running.feed(images[:12])
    running.wait(lambda: running.mailbox.statistics().delivered)
    running.pipeline.close()
    running.wait(lambda: not any(thread.is_alive() for thread in running.pipeline._threads))
    slowed.warm_up_gate.set()


class Failing:
    """A depth predictor whose device has failed."""

    def __init__(self, predictor: DepthEstimator) -> None:
        self.spec, self.model_id, self.independent = predictor.spec, predictor.model_id, predictor.independent

    def estimate(self, surround: SurroundPictures) -> Any:
        raise EngineError("torch on cuda: out of memory with a single picture")


def test_a_network_that_cannot_run_is_told_of_the_set_and_not_of_the_cameras_and_another_takes_over(
    start, estimator, layout, images
):
    running = start(Failing(estimator))
    running.feed(images[:12])
    running.wait(lambda: running.pipeline.problem)
    assert running.pipeline.problem == "torch on cuda: out of memory with a single picture"
    assert not running.pipeline.rig_problems
    with pytest.raises(EngineError):
        running.pipeline.set_model(Failing(estimator))
    running.pipeline.set_model(estimator)
    running.feed(images[12:])
    running.wait(lambda: running.published)


def test_another_network_is_warmed_up_before_it_gets_a_set(start, estimator, images):
    running = start(estimator)
    slowed = Slowed(estimator)
    slowed.gate.set()
    running.pipeline.set_model(slowed)
    assert slowed.warmed_up == [6]
    running.feed(images[:12])
    running.wait(lambda: slowed.cameras)


def test_a_network_that_was_replaced_or_refused_is_let_go(start, estimator):
    former, refused = Slowed(estimator), Failing(estimator)
    running = start(former)
    running.wait(lambda: running.pipeline._build.done())
    with pytest.raises(EngineError):
        running.pipeline.set_model(refused)
    running.pipeline.set_model(estimator)
    gone = [weakref.ref(network) for network in (former, refused)]
    del former, refused
    gc.collect()
    assert [network() for network in gone] == [None, None]


@pytest.fixture
def with_a_foreign_mask(layout, tmp_path) -> Any:
    """The layout with a mask for camera left that has another size than its images."""
    mask = tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.full((10, 20), 255, np.uint8))
    cameras = (c.model_copy(update={"mask": mask}) if c.name == "left" else c for c in layout.cameras)
    return layout.model_copy(update={"cameras": tuple(cameras)}).complete()


def test_a_camera_whose_maps_cannot_be_built_costs_the_others_nothing_with_min_cameras(
    start, estimator, images, with_a_foreign_mask
):
    running = start(estimator, min_cameras=4)
    running.pipeline.set_rig(with_a_foreign_mask)
    running.feed(images[:12])
    running.wait(lambda: running.published)
    assert "left" not in running.published[-1].rig.names
    assert running.pipeline.rig_problems.keys() == {"left"}
    assert "image of 20x10" in running.pipeline.rig_problems["left"]


def test_without_min_cameras_a_camera_whose_maps_cannot_be_built_is_named_alone(
    start, estimator, images, with_a_foreign_mask
):
    running = start(estimator)
    running.pipeline.set_rig(with_a_foreign_mask)
    running.feed(images[:12])
    running.wait(lambda: running.pipeline.counters["skipped: rig not complete"])
    assert running.pipeline.rig_problems.keys() == {"left"}


class TooWide(Rectifier):
    """Meets what OpenCV does not: more than 32767 columns."""

    def __call__(self, *_: Any) -> Any:
        return cv2.remap(np.zeros((1, 40_000), np.uint8), *self._maps, cv2.INTER_LINEAR)


def test_what_opencv_raises_costs_one_image_and_names_its_camera(layout, images):
    camera, message = images[0]
    calibration = next(c.calibration for c in layout.cameras if c.name == camera)
    outcome = picture_or_error(EncodedImage(message), camera, TooWide(calibration, 96, 160), StageLatencies())
    assert isinstance(outcome, ImageError)
    assert str(outcome).startswith(f"camera {camera}: error: OpenCV")


def test_an_image_of_another_size_than_its_calibrations_is_told_in_full_size(start, estimator, layout, images):
    running = start(estimator)
    left = next(camera for camera in layout.cameras if camera.name == "left")
    large = left.model_copy(update={"calibration": left.calibration.model_copy(update={"width": 3840, "height": 2160})})
    cameras = tuple(large if camera is left else camera for camera in layout.cameras)
    running.pipeline.set_rig(layout.model_copy(update={"cameras": cameras}).complete())
    running.feed(images[:12])
    running.wait(lambda: running.pipeline.counters["refused"])
    assert running.pipeline.problem == "camera left: image of 960x540, but its camera_info says 3840x2160"
