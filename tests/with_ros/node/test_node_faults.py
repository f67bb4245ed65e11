# SPDX-License-Identifier: Apache-2.0
"""Faults injected over DDS into one running node: what is said, what is published meanwhile, and that it recovers."""

import time
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from camera_faults import FAULTS, sending
from camera_scene import DEPTH, Scene, running_scene, stamp_of
from faults.table import NODE, FaultTable
from recordings import CAMERAS

OTHERS = [name for name in CAMERAS if name != "left"]


QUICK = list(FAULTS)[::5]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    with running_scene(tmp_path_factory.mktemp("rig")) as scene:
        yield scene


@pytest.fixture(params=FAULTS)
def fault_name(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    if name not in QUICK and not request.config.getoption("--all-faults"):
        pytest.skip("needs --all-faults")
    return name


def test_a_fault_of_one_camera_is_named_and_the_others_go_on_until_it_recovers(
    scene: Scene, fault_name: str, fault_table: FaultTable
):
    fault = FAULTS[fault_name]
    begin = time.monotonic()
    scene.inject(left=fault)
    status = scene.await_state("left", fault.says)
    told = time.monotonic() - begin
    scene.await_cameras(OTHERS)
    begin = time.monotonic()
    scene.recover()
    back = time.monotonic() - begin
    fault_table.add(f"camera {fault_name}", NODE, status.message, told, back)
    for name, topic in DEPTH.items():
        stamps = [stamp_of(message) for message in scene.graph.received[topic]]
        assert set(stamps) <= scene.cameras.sent[name]
        assert len(set(stamps)) == len(stamps)


def test_the_log_does_not_repeat_a_lasting_fault_for_every_image(scene: Scene):
    reason = "neither JPEG nor PNG"
    before = scene.graph.log().count(reason)
    scene.fail(left=sending(lambda jpeg: b"rubbish"))
    scene.await_state("left", reason)
    for _ in range(100):
        scene.cameras.cycle()
        scene.graph.spin(0.05)
    assert 1 <= scene.graph.log().count(reason) - before < 50
    scene.recover()


def test_what_the_node_is_was_not_changed_by_all_of_this(scene: Scene):
    assert scene.node.resources().resident_mib < 2048
