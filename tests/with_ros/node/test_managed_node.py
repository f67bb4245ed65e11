# SPDX-License-Identifier: Apache-2.0
"""A managed node whose own code is wrong: nothing of it ends the process, and all of it is told."""

import threading
import time
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="these tests need a ROS environment")

from domains import own_domain
from rclpy.context import Context
from rclpy.lifecycle import TransitionCallbackReturn

from cvcdepth_core.errors import ConfigError
from cvcdepth_ros.node.managed_node import ManagedNode

SUCCESS, FAILURE, ERROR = (getattr(TransitionCallbackReturn, name) for name in ("SUCCESS", "FAILURE", "ERROR"))


class WrongNode(ManagedNode):
    """Raises `wrong`, if there is something, when it is configured and whenever its timer fires."""

    def __init__(self, context: Context) -> None:
        super().__init__("wrong", context=context)
        self.wrong: Exception | None = None
        self.fired = 0
        self.released = 0

    def on_configure(self, state):
        return self.attempt(self.work)

    def on_error(self, state):
        self.released += 1
        return SUCCESS

    def work(self) -> None:
        self.fired += 1
        if self.wrong is not None:
            raise self.wrong


@pytest.fixture
def context() -> Iterator[Context]:
    with own_domain() as domain:
        context = Context()
        context.init(domain_id=domain)
        yield context
        context.try_shutdown()


@pytest.fixture
def node(context: Context) -> Iterator[WrongNode]:
    node = WrongNode(context)
    yield node
    node.destroy_node()


def test_what_nobody_foresaw_leads_through_error_processing_with_its_reason(node: WrongNode):
    node.wrong = ValueError("seven")
    assert node.trigger_configure() == ERROR
    assert (node.failure, node.errors, node.released) == ("ValueError: seven", 1, 1)
    node.wrong = None
    assert node.trigger_configure() == SUCCESS
    assert not node.failure


def test_a_foreseen_reason_is_a_failure_and_no_error(node: WrongNode):
    node.wrong = ConfigError("rig: missing")
    assert node.trigger_configure() == FAILURE
    assert (node.failure, node.errors, node.released) == ("rig: missing", 0, 0)


def test_a_callback_that_raises_is_counted_and_the_node_goes_on(node: WrongNode, context: Context):
    node.wrong = KeyError("camera")
    node.create_timer(0.01, node.work)
    spinning = threading.Thread(target=node.spin)
    spinning.start()
    while node.fired < 5:
        time.sleep(0.01)
    context.shutdown()
    spinning.join(10)
    assert not spinning.is_alive()
    assert node.errors >= 4


def test_work_is_abandoned_when_the_node_is_to_end(node: WrongNode, context: Context):
    goes_on = threading.Event()
    threading.Timer(0.1, context.shutdown).start()
    with pytest.raises(InterruptedError):
        node.wait_for(goes_on.wait)
    assert node.is_abandoned
    goes_on.set()


def test_work_has_its_result_and_its_error(node: WrongNode):
    assert node.wait_for(lambda: 7) == 7
    node.wrong = ConfigError("rig")
    with pytest.raises(ConfigError, match="rig"):
        node.wait_for(node.work)
    assert not node.is_abandoned
