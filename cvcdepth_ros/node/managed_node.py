# SPDX-License-Identifier: Apache-2.0
"""A managed (lifecycle) node that survives errors of its own code and impossible requests of its manager."""

import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

from cvcdepth_core.errors import CvcDepthError

T = TypeVar("T")

_INTERRUPTION_SECONDS = 0.1


class ManagedNode(LifecycleNode):  # type: ignore[misc] # rclpy is not annotated
    """rclpy's managed node, which answers and logs what that one does not.

    There, the request for a transition that the state does not allow raises in the service's callback, which ends the
    process and leaves the client without an answer; and the reason for a transition's failure is lost.
    """

    def __init__(self, name: str, **options: Any) -> None:
        """`options` are those of rclpy's Node."""
        super().__init__(name, **options)
        self.failure = ""
        """Why the last transition failed; empty when it did not."""
        self.errors = 0
        """Callbacks that raised an unforeseen error."""
        self.is_abandoned = False
        """Whether a thread is still busy that is no longer waited for."""
        self._is_ending = False
        for service in self.services:
            if service.srv_name.endswith("/change_state"):
                service.callback = partial(self._answer_change_state, service.callback)

    def request_end(self) -> None:
        """Have `spin` return and `wait_for` give up soon; may be called by a signal's handler."""
        self._is_ending = True

    @property
    def is_ending(self) -> bool:
        """Whether the node was asked to end, or its context has ended."""
        return self._is_ending or not self.context.ok()

    def spin(self) -> None:
        """Serve until the end is requested, or the context ends."""
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self)
        while not self.is_ending:
            with self.survives_errors():
                # Python's handlers of signals run between two callbacks: the executor must not wait long for one.
                executor.spin_once(timeout_sec=_INTERRUPTION_SECONDS)
        executor.remove_node(self)

    @contextmanager
    def survives_errors(self) -> Iterator[None]:
        """Log an error of the block instead of raising it."""
        try:
            yield
        except Exception as error:
            self.report(error)

    def report(self, error: Exception) -> str:
        """Log and count an unforeseen error; return its type and message."""
        # The end of the context invalidates whatever a callback has just asked rclpy for; work was interrupted by us.
        if not self.is_ending:
            self.errors += 1
            self.get_logger().error("".join(traceback.format_exception(error)), throttle_duration_sec=5.0)
        return f"{type(error).__name__}: {error}"

    def attempt(self, transition: Callable[[], None]) -> TransitionCallbackReturn:
        """Make a transition; the family's errors are a FAILURE with its reason, all others lead to error processing."""
        try:
            transition()
        except CvcDepthError as error:
            self.failure = str(error)
            self.get_logger().error(self.failure)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.failure = self.report(error)
            return TransitionCallbackReturn.ERROR
        self.failure = ""
        return TransitionCallbackReturn.SUCCESS

    def wait_for(self, work: Callable[[], T]) -> T:
        """Return the result of `work`; InterruptedError, and the thread is abandoned, when the node is to end first."""
        pool = ThreadPoolExecutor(1, thread_name_prefix="build")
        future = pool.submit(work)
        pool.shutdown(wait=False)
        while not wait([future], _INTERRUPTION_SECONDS).done:
            if self.is_ending:
                self.is_abandoned = True
                raise InterruptedError("the node ends")
        return future.result()

    def _answer_change_state(self, handle: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        try:
            return handle(request, response)
        except Exception as error:  # rclpy's RCLError, which has no public name
            asked = request.transition.label or request.transition.id
            self.get_logger().warning(f"transition {asked} is impossible now: {error}", throttle_duration_sec=5.0)
            response.success = False
            return response
