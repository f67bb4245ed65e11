# SPDX-License-Identifier: Apache-2.0
"""Real nodes over real DDS for the tests: the node as a process of its own, publishers and subscribers beside it.

Knows nothing of the package's code but the node's module name and its topics.

Importing torch takes more processor time than most tests of the node, so their processes are forked from one that has
imported the node and done nothing else. test_demo.py and others start it as users do.
"""

import gc
import importlib
import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from domains import own_domain
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from repository import ROOT

NODE_MODULE = "cvcdepth_ros.surround_depth_node"
PROFILE = ROOT / "config" / "fastdds_large_shm.xml"
TIMEOUT = 60.0


def reliable(depth: int = 100, latched: bool = False) -> QoSProfile:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )


def best_effort(depth: int = 10) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


class Resources(NamedTuple):
    """What a process holds."""

    resident_mib: float
    files: int
    threads: int


class NodeProcess:
    """A running surround_depth_node, used like a subprocess.Popen."""

    _forks = multiprocessing.get_context("forkserver")
    _forks.set_forkserver_preload([NODE_MODULE, "cvcdepth_ros.node.surround_node"])

    def __init__(self, arguments: Sequence[str], environment: dict[str, str], log: Path) -> None:
        self._process = self._forks.Process(target=_run_node, args=(arguments, environment, log))
        self._process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while it runs."""
        return self._process.exitcode

    def wait(self, seconds: float | None = None) -> int:
        """Return the exit code; subprocess.TimeoutExpired when it has not ended by then."""
        self._process.join(seconds)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired(NODE_MODULE, seconds or 0.0)
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self._process.kill()

    def resources(self) -> Resources:
        """Return what it holds now."""
        folder = Path(f"/proc/{self.pid}")
        resident = int(folder.joinpath("statm").read_text().split()[1]) * 4096 / 2**20
        return Resources(resident, *(len(list(folder.joinpath(kind).iterdir())) for kind in ("fd", "task")))


def _run_node(arguments: Sequence[str], environment: dict[str, str], log: Path) -> None:
    """Be `python -m cvcdepth_ros.surround_depth_node`."""
    os.environ.update(environment)
    with log.open("wb") as output:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
            os.dup2(output.fileno(), stream.fileno())
    try:
        importlib.import_module(NODE_MODULE).main([NODE_MODULE, *arguments])
    finally:
        gc.collect()  # A forked process ends without it, and DDS would leave its shared memory behind.


class RosGraph:
    """One domain with this process's node and the processes it started."""

    def __init__(self) -> None:
        self._resources = ExitStack()
        self.domain = self._resources.enter_context(own_domain())
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = os.environ["FASTDDS_DEFAULT_PROFILES_FILE"] = str(PROFILE)
        self._context = Context()
        rclpy.init(context=self._context, domain_id=self.domain)
        self.node = Node("test", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.received: dict[str, list[Any]] = defaultdict(list)
        self.statuses: dict[str, Any] = {}
        self._processes: list[tuple[NodeProcess, Path]] = []
        self._clients: dict[str, Client] = {}
        self._folder = Path(self._resources.enter_context(tempfile.TemporaryDirectory()))
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def start_node(self, *arguments: str, **parameters: Any) -> NodeProcess:
        """Start surround_depth_node with these parameters."""
        pairs = [
            f"{name}:={str(value).lower() if isinstance(value, bool) else value}" for name, value in parameters.items()
        ]
        options = itertools.chain.from_iterable(("-p", pair) for pair in pairs)
        log = self._folder / f"{len(self._processes)}.log"
        log.touch()
        environment = os.environ | {"ROS_DOMAIN_ID": str(self.domain)}
        process = NodeProcess(["--ros-args", *options, *arguments], environment, log)
        self._processes.append((process, log))
        return process

    def log(self) -> str:
        """What the processes have printed."""
        return "\n".join(path.read_text(errors="replace") for _, path in self._processes)

    def subscribe(self, message_class: type, *topics: str) -> None:
        """Collect the messages of these topics in `received`."""
        for topic in topics:
            self.node.create_subscription(message_class, topic, self.received[topic].append, reliable())

    def spin_until(self, condition: Callable[[], Any], what: str, timeout: float = TIMEOUT) -> None:
        """Spin until the condition holds; fail with what was awaited and the processes' output."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                texts = {name: status.message for name, status in self.statuses.items()}
                raise AssertionError(
                    f"waited {timeout:.0f} s in vain for {what}; diagnostics {texts}; log:\n{self.log()}"
                )
            self._executor.spin_once(timeout_sec=0.05)

    def spin(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while (remaining := deadline - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=remaining)

    def await_status(self, subject: str, text: str, timeout: float = TIMEOUT) -> Any:
        """Wait until the node's diagnostic status of this subject says this text; return the status."""

        def says() -> bool:
            status = self.statuses.get(f"surround_depth: {subject}")
            return status is not None and text in status.message

        self.spin_until(says, f"status '{subject}' to say '{text}'", timeout)
        return self.statuses[f"surround_depth: {subject}"]

    def values(self, subject: str) -> dict[str, str]:
        status = self.statuses.get(f"surround_depth: {subject}")
        return {pair.key: pair.value for pair in status.values} if status else {}

    def call(self, service_class: type, name: str, request: Any) -> Any:
        """Return the service's response."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(service_class, name)
        assert self._clients[name].wait_for_service(20), name
        future = self._clients[name].call_async(request)
        self.spin_until(future.done, f"an answer of {name}")
        return future.result()

    def set_parameters(self, **parameters: Any) -> list[SetParametersResult]:
        """Set parameters of the node; return its answers."""
        messages = [Parameter(name, value=value).to_parameter_msg() for name, value in parameters.items()]
        request = SetParameters.Request(parameters=messages)
        return list(self.call(SetParameters, "/surround_depth/set_parameters", request).results)

    def await_subscribers(self, topics: Sequence[str]) -> None:
        """Wait until each topic has a subscriber."""
        self.spin_until(lambda: all(self.node.count_subscribers(topic) for topic in topics), f"subscribers of {topics}")

    def await_matches(self, publishers: Iterable[Publisher]) -> None:
        """Wait until each publisher has a subscription that gets what it publishes from now on."""
        waiting = list(publishers)
        self.spin_until(lambda: all(publisher.get_subscription_count() for publisher in waiting), "all subscriptions")

    def close(self) -> None:
        for process, _ in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process, _ in self._processes:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)
        gc.collect()  # It is the end of the context that frees DDS's shared memory.
        self._resources.close()

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            self.statuses[status.name] = status
