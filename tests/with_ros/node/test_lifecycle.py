# SPDX-License-Identifier: Apache-2.0
"""The node as a lifecycle manager meets it: transitions in any order, and what is left of them."""

import random
import signal
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from camera_scene import DEPTH, Cameras, rig_without_calibrations
from faults.table import NODE, FaultTable
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from ros_graph import NodeProcess, Resources, RosGraph
from sensor_msgs.msg import Image

FRONT = DEPTH["front"]
SMALL = {"untrained": True, "height": 64, "width": 96}
SLOW = {"untrained": True, "height": 1152, "width": 2048}
"""So large that the signal comes while the node computes."""
TRANSITIONS = {
    "configure": (Transition.TRANSITION_CONFIGURE, {State.PRIMARY_STATE_UNCONFIGURED: State.PRIMARY_STATE_INACTIVE}),
    "activate": (Transition.TRANSITION_ACTIVATE, {State.PRIMARY_STATE_INACTIVE: State.PRIMARY_STATE_ACTIVE}),
    "deactivate": (Transition.TRANSITION_DEACTIVATE, {State.PRIMARY_STATE_ACTIVE: State.PRIMARY_STATE_INACTIVE}),
    "cleanup": (Transition.TRANSITION_CLEANUP, {State.PRIMARY_STATE_INACTIVE: State.PRIMARY_STATE_UNCONFIGURED}),
}
"""Number, and where it leads from where; from elsewhere it is impossible."""


class Manager:
    """Asks the node for transitions, and what it is."""

    def __init__(self, graph: RosGraph, process: NodeProcess) -> None:
        self._graph, self.process = graph, process

    def change(self, name: str) -> bool:
        return self.change_by_id(TRANSITIONS[name][0])

    def change_by_id(self, number: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=number))
        return bool(self._graph.call(ChangeState, "/surround_depth/change_state", request).success)

    def state(self) -> int:
        return int(self._graph.call(GetState, "/surround_depth/get_state", GetState.Request()).current_state.id)

    def set(self, **parameters: object) -> None:
        results = self._graph.set_parameters(**parameters)
        assert all(result.successful for result in results), results


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return rig_without_calibrations(tmp_path / "rig.yaml")


def start(graph: RosGraph, **parameters: object) -> Manager:
    process = graph.start_node(autostart=False, max_age=0.0, **(SMALL | parameters))
    graph.await_status("node", "unconfigured")
    return Manager(graph, process)


def await_no_more(process: NodeProcess, before: Resources, graph: RosGraph) -> None:
    """Wait until the node has no more files and threads than before; a thread may be in the middle of its last work."""

    def has_no_more() -> bool:
        now = process.resources()
        return now.files <= before.files and now.threads <= before.threads

    graph.spin_until(has_no_more, f"no more than {before}", 20)


def test_an_impossible_transition_is_refused_and_the_node_goes_on(graph: RosGraph, rig: Path, fault_table: FaultTable):
    manager = start(graph, rig=rig)
    begin = time.monotonic()
    for name in ("activate", "deactivate", "cleanup"):
        assert not manager.change(name)
    assert not manager.change_by_id(99)
    told = (time.monotonic() - begin) / 4
    assert manager.state() == State.PRIMARY_STATE_UNCONFIGURED
    assert "transition 3 is impossible now" in graph.log()
    assert manager.change("configure")
    fault_table.add("impossible transition", NODE, "answered: no; the state stays", told)


def test_a_hundred_transitions_in_any_order_leave_nothing_behind(graph: RosGraph, rig: Path):
    graph.subscribe(Image, FRONT)
    cameras, choose = Cameras(graph), random.Random(0)
    manager = start(graph, rig=rig)
    state, kept = State.PRIMARY_STATE_UNCONFIGURED, []
    for _ in range(100):
        name = choose.choice(list(TRANSITIONS))
        allowed = TRANSITIONS[name][1]
        assert manager.change(name) == (state in allowed)
        state = allowed.get(state, state)
        assert manager.state() == state
        if state == State.PRIMARY_STATE_ACTIVE and name == "activate":
            graph.received[FRONT].clear()
            cameras.run_until(lambda: graph.received[FRONT], "depth while active")
        if state == State.PRIMARY_STATE_UNCONFIGURED and name == "cleanup":
            kept.append(manager.process.resources())
    for name in ("deactivate", "cleanup"):
        manager.change(name)
    # At first libraries load what they need but once; a single network that was kept would be more than 60 MiB.
    early = kept[len(kept) // 3]
    await_no_more(manager.process, early, graph)
    assert manager.process.resources().resident_mib < early.resident_mib + 100, kept


def test_what_cannot_be_configured_leaves_nothing_of_itself(graph: RosGraph, rig: Path, tmp_path: Path):
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"\xff" * 64)
    manager = start(graph, rig=rig, untrained=False, checkpoint=damaged)
    assert not manager.change("configure")
    assert manager.state() == State.PRIMARY_STATE_UNCONFIGURED
    graph.await_status("node", "is damaged or not a safetensors file")
    manager.set(rig=str(tmp_path / "nowhere.yaml"), checkpoint="")
    assert not manager.change("configure")
    graph.await_status("node", "nowhere.yaml")
    manager.set(rig=str(rig))
    assert manager.change("configure")
    assert manager.change("activate")
    graph.await_status("node", "active")


@pytest.mark.parametrize(
    ("parameter", "value", "reason"),
    [
        ("trace", "/nowhere/trace.json", "trace /nowhere/trace.json: cannot be written"),
        ("min_cameras", 7, "min_cameras"),
        ("qos_overrides./camera/back/camera_info.subscription.reliability", "mostly", "/camera/back/camera_info: "),
        ("qos_overrides./surround_depth/points.publisher.reliability", "mostly", "points: "),
    ],
)
def test_what_cannot_be_activated_says_why_and_leaves_nothing_of_itself(
    parameter: str, value: object, reason: str, graph: RosGraph, rig: Path
):
    manager = start(graph, rig=rig, **{parameter: value})
    assert manager.change("configure")
    before = manager.process.resources()
    for _ in range(3):
        assert not manager.change("activate")
        assert manager.state() == State.PRIMARY_STATE_INACTIVE, graph.log()
    graph.await_status("node", reason)
    await_no_more(manager.process, before, graph)
    graph.spin_until(lambda: FRONT not in dict(graph.node.get_topic_names_and_types()), "the topics to be gone")


def test_after_a_failed_activation_a_mended_parameter_is_enough(graph: RosGraph, rig: Path):
    manager = start(graph, rig=rig, trace="/nowhere/trace.json")
    assert manager.change("configure")
    assert not manager.change("activate")
    assert manager.change("cleanup")
    manager.set(trace="")
    assert manager.change("configure")
    assert manager.change("activate")
    graph.await_status("node", "active")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_also_in_the_middle_of_inference(
    number: signal.Signals, graph: RosGraph, rig: Path, fault_table: FaultTable
):
    graph.subscribe(Image, FRONT)
    cameras = Cameras(graph)
    process = graph.start_node(rig=rig, max_age=0.0, **SLOW)
    cameras.run_until(lambda: int(graph.values("synchronisation").get("delivered", 0)), "a set in the worker")
    seconds = end(process, number, graph)
    assert not graph.received[FRONT]
    fault_table.add(f"{number.name} in the middle of inference", NODE, "ends with exit code 0", seconds)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_also_while_it_builds_its_network(
    number: signal.Signals, graph: RosGraph, rig: Path, fault_table: FaultTable
):
    process = graph.start_node(rig=rig, **SLOW)
    graph.spin_until(lambda: "building the network" in graph.log(), "the building to begin")
    seconds = end(process, number, graph)
    assert "model:" not in graph.log()
    fault_table.add(f"{number.name} while the network is built", NODE, "ends with exit code 0", seconds)


def end(process: NodeProcess, number: int, graph: RosGraph) -> float:
    """Send the signal; return how long the node took to end."""
    begin = time.monotonic()
    process.send_signal(number)
    assert process.wait(30) == 0, graph.log()
    assert "Traceback" not in graph.log()
    return time.monotonic() - begin
