# SPDX-License-Identifier: Apache-2.0
"""The managed node itself: its transitions, its log and its statuses."""

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_core.estimator import DepthEstimator
from cvcdepth_core.rig.rig_file import RigLayout, load_rig_layout
from cvcdepth_ros.live.problem_log import ProblemLog
from cvcdepth_ros.live.set_progress import NodeClock
from cvcdepth_ros.messages.rig_assembly import RigAssembler
from cvcdepth_ros.node.diagnostics import ERROR, OK, UNKNOWN_LATENCY, WARN, status
from cvcdepth_ros.node.live_rig import LiveRigDiscovery
from cvcdepth_ros.node.managed_node import ManagedNode
from cvcdepth_ros.node.parameters import declare_parameters, read_parameters, unknown_parameters
from cvcdepth_ros.node.session import SurroundSession
from cvcdepth_ros.process_setup import return_memory
from cvcdepth_ros.settings import AUTO, CHANGEABLE_WHILE_RUNNING, NodeParameters

_POLL_SECONDS = 0.25
_DIAGNOSTICS_SECONDS = 1.0
_CLOCK_TOPIC = "/clock"


class SurroundDepthNode(ManagedNode):
    """Configure loads rig and network, activate subscribes and publishes; problems go to the log and /diagnostics."""

    def __init__(self) -> None:
        super().__init__("surround_depth")
        declare_parameters(self)
        for line in unknown_parameters(self):
            self.get_logger().warning(line)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self._settings: NodeParameters | None = None
        self._estimator: DepthEstimator | None = None
        self._layout: RigLayout | None = None
        self._discovery: LiveRigDiscovery | None = None
        self._session: SurroundSession | None = None
        self._problem_log = ProblemLog(self.get_logger())
        self._refused = 0
        self._is_idleness_told = False
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Steady time: with use_sim_time and no /clock yet, these must run all the same.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_POLL_SECONDS, self._poll, clock=steady)
        self.create_timer(_DIAGNOSTICS_SECONDS, self._publish_diagnostics, clock=steady)

    def autostart(self) -> None:
        """Configure and activate, unless the parameter says that somebody else will."""
        if self.get_parameter("autostart").value and self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, the rig file and the checkpoint; FAILURE with the reason in the log."""
        return self.attempt(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and publish; with rig 'auto' as soon as the cameras are found."""
        return self.attempt(self._activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop subscribing and publishing."""
        return self.attempt(self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget rig and network."""
        return self.attempt(self._release)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End for good."""
        return self.attempt(self._release)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give up what a failed transition has left, and be unconfigured; `failure` keeps the reason."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def stop(self) -> bool:
        """End the active period; False when the worker is still inside its last inference."""
        if self._discovery is not None:
            self._discovery.close()
            self._discovery = None
        session, self._session = self._session, None
        self._is_idleness_told = False
        self._problem_log.forget()
        if session is None:
            return True
        for stage, summary in session.latencies.summaries().items():
            self.get_logger().info(
                f"{stage}: p50 {summary.p50_ms:.1f} ms, p95 {summary.p95_ms:.1f} ms, max {summary.max_ms:.1f} ms"
            )
        for stage in session.unknown_latencies:
            self.get_logger().info(f"{stage}: {UNKNOWN_LATENCY}")
        return session.close()

    def _configure(self) -> None:
        parameters = read_parameters(self)
        parameters.check_complete()
        layout = None if parameters.rig == AUTO else load_rig_layout(Path(parameters.rig).expanduser())
        self._estimator = self._built_estimator(parameters)
        self._settings, self._layout = parameters, layout
        return_memory()

    def _activate(self) -> None:
        if self._layout is None:
            parameters = read_parameters(self)
            self._discovery = LiveRigDiscovery(self, parameters.base_frame, parameters.min_cameras)
        else:
            self._start_session(RigAssembler(self._layout))

    def _deactivate(self) -> None:
        self.stop()
        return_memory()

    def _release(self) -> None:
        self.stop()
        self._settings = self._estimator = self._layout = None
        return_memory()

    def _built_estimator(self, parameters: NodeParameters) -> DepthEstimator:
        self.get_logger().info(f"building the network for {parameters.device} with backend {parameters.backend}")
        estimator = self.wait_for(parameters.build_estimator)
        self.get_logger().info(f"model: {estimator.model_id} on {estimator.device}")
        if parameters.notice:
            self.get_logger().warning(parameters.notice)
        return estimator

    def _start_session(self, assembler: RigAssembler) -> None:
        if self._settings is not None and self._estimator is not None:
            self._session = SurroundSession(self, assembler, self._estimator, self._settings)
            self._session.poll()

    def _await_rig(self, discovery: LiveRigDiscovery) -> None:
        assembler = discovery.poll()
        if assembler is None:
            return
        try:
            self._start_session(assembler)
        except CvcDepthError as error:
            self.get_logger().error(f"rig auto: {error}")
            discovery.refuse(str(error))
        else:
            self.get_logger().info(f"rig auto: {', '.join(assembler.layout.names)}")
            discovery.close()
            self._discovery = None

    def _poll(self) -> None:
        if self._discovery is not None:
            self._await_rig(self._discovery)
        session = self._session
        if session is not None:
            session.poll()
            self._report_refusals(session.refused, session.problem)
            self._report_idleness(session)
        conditions = session.conditions() if session else {}
        self._problem_log.tell(self._problems(), conditions, is_matching=session is None or session.is_matching)

    def _problems(self) -> dict[str, str]:
        """Return what is wrong with the whole of it, by subject, each with its remedy; empty texts for what is not."""
        session, clock = self._session, self._node_clock()
        return {
            "rig auto": self._discovery.problem() if self._discovery else "",
            "clock": clock.problem if session else "",
            "sets": session.standstill(clock) if session else "",
            "transport": session.transport_problem if session else "",
            "cross-view consistency": session.overlap_findings() if session else "",
            "refinement": session.odometry_problem() if session else "",
        }

    def _node_clock(self) -> NodeClock:
        is_simulated = bool(self.get_parameter("use_sim_time").value)
        return NodeClock(is_simulated, has_publisher=self.count_publishers(_CLOCK_TOPIC) > 0)

    def _report_idleness(self, session: SurroundSession) -> None:
        """Log once that depth could be computed, and nobody wants it: no subscriber looks like no depth."""
        if session.has_idle_sets and not self._is_idleness_told:
            self._is_idleness_told = True
            self.get_logger().info(
                "sets are matched, but nothing subscribes to the node's topics: no depth is computed"
            )

    def _report_refusals(self, count: int, reason: str) -> None:
        if count > self._refused and reason:
            self.get_logger().error(f"set refused: {reason}", throttle_duration_sec=5.0)
        self._refused = count

    def _publish_diagnostics(self) -> None:
        statuses = [self._node_status(), *(self._session.diagnostics(self._node_clock()) if self._session else [])]
        for entry in statuses:
            entry.name = f"{self.get_name()}: {entry.name}"
            entry.hardware_id = self.get_fully_qualified_name()
        message = DiagnosticArray(status=statuses)
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _node_status(self) -> DiagnosticStatus:
        level, message = OK, "active"
        if self.failure:
            level, message = ERROR, self.failure
        elif self._discovery is not None:
            level, message = WARN, f"rig auto: {self._discovery.problem()}"
        elif self._session is None:
            message = "inactive" if self._settings else "unconfigured"
        return status(level, "node", message, {"unforeseen errors": self.errors})

    def _on_set_parameters(self, changed: Sequence[Parameter]) -> SetParametersResult:
        fixed = [
            p.name for p in changed if p.name in NodeParameters.model_fields and p.name not in CHANGEABLE_WHILE_RUNNING
        ]
        if fixed and self._settings is not None:
            return SetParametersResult(successful=False, reason=f"{', '.join(fixed)}: clean the node up first")
        try:
            parameters = read_parameters(self, changed)
            if self._settings is not None and any(p.name == "checkpoint" for p in changed):
                self._replace_model(parameters)
        except CvcDepthError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:
            return SetParametersResult(successful=False, reason=self.report(error))
        return SetParametersResult(successful=True)

    def _replace_model(self, parameters: NodeParameters) -> None:
        """Load another checkpoint beside the one that runs, and swap them between two sets; the family's errors.

        Images that arrive meanwhile wait or are dropped, for this is a callback: half a second on two cores with NCNN,
        but a minute where the network is compiled.
        """
        parameters.check_complete()
        session = self._session
        try:
            estimator = self._built_estimator(parameters)
            if session is not None:
                self.wait_for(lambda: session.set_model(estimator))
        finally:
            if session is not None:
                session.resume_listening()
        self._settings, self._estimator = parameters, estimator
        return_memory()


def run(arguments: Sequence[str]) -> None:
    """Run the node until it is interrupted or terminated; SystemExit says in one line why it cannot start."""
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
        node = SurroundDepthNode()
    except Exception as error:  # rclpy raises many kinds for arguments or a parameter override that are wrong
        sys.exit(f"surround_depth_node: {str(error).splitlines()[0]}")
    # rclpy's own handlers would end the context at once, and with it the log, while there is still something to say.
    # A KeyboardInterrupt would come in the middle of anything: while a message is taken, rclpy's extension makes a
    # RuntimeError of it. `ros2 launch` sends SIGINT to the group and again to each child; that changes nothing here.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: node.request_end())
    with node.survives_errors():
        node.autostart()
    node.spin()
    _end(node)


def _end(node: SurroundDepthNode) -> None:
    """Stop within two seconds, also in the middle of inference or of building a network."""
    finished = node.stop()
    if node.is_abandoned or not finished:
        # A thread inside an inference or a compiler cannot be stopped; leaving is safe, for nothing of it is published.
        os._exit(0)
    node.destroy_node()
    rclpy.try_shutdown()
