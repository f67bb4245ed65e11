# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from cvcdepth_ros.live.camera_states import CameraState, CameraWatch, condition

PERIOD = 0.1


class Camera:
    """A camera on a clock of its own."""

    def __init__(self, stale_after: float = 1.0, frozen_after: float = 1.0) -> None:
        self.now = 100.0
        self.watch = CameraWatch(stale_after, frozen_after, lambda: self.now)
        self._pictures = np.random.default_rng(0).integers(0, 256, (200, 50_000), dtype=np.uint8)
        self._sent = 0

    def send(
        self, count: int = 1, period: float = PERIOD, frozen: bool = False, same_stamp: bool = False
    ) -> list[bool]:
        """Send images; return which of them were accepted."""
        accepted = []
        for _ in range(count):
            self.now += period
            self._sent += not frozen
            stamp = 0 if same_stamp else round(self.now * 1e9)
            accepted.append(self.watch.accept(stamp, self._pictures[self._sent].copy()))
        return accepted

    @property
    def state(self) -> CameraState:
        return condition("left", self.watch.troubles()).state


def test_a_camera_is_awaited_then_fine_then_stale_then_fine_again():
    camera = Camera()
    assert camera.state == CameraState.WAITING_FOR_IMAGES
    assert all(camera.send(20))
    assert camera.state == CameraState.OK
    camera.now += 0.9
    assert camera.state == CameraState.OK
    camera.now += 0.2
    assert camera.state == CameraState.STALE
    assert camera.send() == [True]
    assert camera.state == CameraState.OK


def test_a_slow_camera_is_not_stale_between_its_images():
    camera = Camera(stale_after=1.0)
    camera.send(5, period=5.0)
    camera.now += 14.0
    assert camera.state == CameraState.OK
    camera.now += 2.0
    assert camera.state == CameraState.STALE


@pytest.mark.parametrize("how", [{"frozen": True}, {"same_stamp": True}])
def test_a_camera_that_repeats_itself_is_left_out_until_something_new_comes(how):
    camera = Camera()
    camera.send(5)
    accepted = camera.send(20, **how)
    assert accepted[:9] == [True] * 9
    assert accepted[12:] == [False] * 8
    assert camera.state == CameraState.FROZEN
    assert camera.watch.repeated == accepted.count(False)
    assert camera.send() == [True]
    assert camera.state == CameraState.OK


def test_a_few_equal_pictures_and_a_standing_simulation_on_demand_are_no_frozen_camera():
    camera = Camera()
    assert all(camera.send(1) + camera.send(5, frozen=True) + camera.send(1))
    standing = Camera(frozen_after=0.0)
    assert all(standing.send(100, frozen=True))
    assert standing.state == CameraState.OK


def test_pictures_that_differ_in_one_late_byte_are_different():
    camera = Camera()
    picture = np.zeros(50_000, np.uint8)
    for number in range(30):
        camera.now += PERIOD
        picture[40_000] = number
        assert camera.watch.accept(number, picture.copy())


def test_an_image_that_cannot_be_used_rejects_the_camera_until_one_can():
    camera = Camera()
    camera.send(3)
    camera.watch.used("camera left: image of 1x1")
    found = condition("left", camera.watch.troubles())
    assert (found.state, found.text) == (CameraState.REJECTED, "rejected: image of 1x1")
    assert camera.watch.refused == 1
    camera.watch.used("")
    assert camera.state == CameraState.OK


def test_the_most_specific_trouble_comes_first_and_the_others_are_told_too():
    found = condition(
        "left",
        [
            (CameraState.WAITING_FOR_IMAGES, "no publisher on /left"),
            (CameraState.REJECTED, "camera left: K[0] = 0"),
            (CameraState.WAITING_FOR_CAMERA_INFO, "camera left: waiting for camera_info on /info"),
        ],
    )
    assert found.text == "rejected: K[0] = 0; waiting for camera_info on /info; no publisher on /left"
    waiting = condition(
        "left", [(CameraState.WAITING_FOR_CAMERA_INFO, "camera left: waiting for camera_info on /info")]
    )
    assert waiting.text == "waiting for camera_info on /info"
    assert condition("left", []).text == "ok"


def test_images_of_which_none_becomes_part_of_a_set_are_told_after_a_while():
    camera = Camera()
    camera.send(10)
    assert camera.watch.unmatched(10) == []
    camera.send(25)
    assert camera.watch.unmatched(10) == []
    camera.send(10)
    [(state, _)] = camera.watch.unmatched(10)
    assert state == CameraState.UNMATCHED
    assert camera.watch.unmatched(11) == []


def test_images_that_another_reason_kept_out_of_sets_get_their_time_again_when_it_has_gone():
    camera = Camera()
    camera.send(50)
    assert camera.watch.unmatched(0, is_explained=True) == []
    assert camera.watch.unmatched(0) == []
    camera.send(50)
    assert camera.watch.unmatched(0)


def test_silence_while_nobody_could_listen_does_not_count():
    camera = Camera()
    camera.send(10)
    camera.now += 5.0
    camera.watch.resume_listening()
    assert camera.state == CameraState.OK
    camera.now += 1.1
    assert camera.state == CameraState.STALE


def test_a_refusal_is_forgotten_where_later_images_fit_no_set():
    camera = Camera()
    camera.send(5)
    camera.watch.used("it was cut")
    camera.send(25)
    assert camera.state == CameraState.REJECTED
    camera.send(10)
    assert camera.state == CameraState.OK


def test_a_refusal_stays_while_images_join_sets_and_wait_to_be_judged():
    camera = Camera()
    camera.send(5)
    camera.watch.used("it was cut")
    for joined in range(60):
        camera.send()
        camera.watch.unmatched(joined)
    assert camera.state == CameraState.REJECTED
