# SPDX-License-Identifier: Apache-2.0
"""Child processes in a DDS domain of their own: watched, and always stopped, each by its own pid."""

import errno
import json
import os
import queue
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import dropwhile
from pathlib import Path
from typing import IO, Any

from cvcdepth_core.errors import CvcDepthError

THREADS_VARIABLE = "OMP_NUM_THREADS"

_LAST_LINES = 5
_STOP_SECONDS = 15.0
_LAST_DOMAIN = 101  # beyond it, DDS ports run into Linux's ephemeral ones


class DemoError(CvcDepthError):
    """A process of the demo failed, or something that was waited for did not happen."""


class Child:
    """A Python program as a child process; its output goes to a log file, and the lines of stdout can be read here."""

    def __init__(self, name: str, arguments: Sequence[str], environment: Mapping[str, str], log: Path) -> None:
        """Start `python -m ARGUMENTS`, with the interpreter that is running."""
        self.name = name
        self.log = log
        self._lines: queue.Queue[str] = queue.Queue()
        log.unlink(missing_ok=True)
        with log.open("a", encoding="utf-8") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-m", *arguments],
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                # Ctrl-C shall reach the demo alone, which then stops its children in order.
                start_new_session=True,
                text=True,
                bufsize=1,
            )
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True)
        self._reader.start()

    def ended(self, timeout: float = 0.0) -> bool:
        """Return whether it has ended within `timeout` seconds; DemoError, with its last lines, when it failed."""
        try:
            code = self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        self._reader.join()
        if code:
            raise self.failure(f"ended with code {code}")
        return True

    def reports(self, timeout: float) -> Iterator[dict[str, Any]]:
        """Give the JSON objects printed since the last call; a first one is waited for up to `timeout` seconds."""
        try:
            yield from _json_object(self._lines.get(timeout=timeout))
            while True:
                yield from _json_object(self._lines.get_nowait())
        except queue.Empty:
            return

    def result(self) -> dict[str, Any]:
        """Return the JSON document that it has printed, once it has ended; DemoError when there is none."""
        lines = [self._lines.get() for _ in range(self._lines.qsize())]
        # Where /dev/shm is small, as in Docker, FastDDS says so on stdout, and goes on over UDP.
        printed = "".join(dropwhile(lambda line: not line.startswith("{"), lines))
        try:
            document: dict[str, Any] = json.loads(printed)
        except ValueError as error:
            raise self.failure(f"printed no JSON document ({error})") from error
        return document

    def peak_memory_mb(self) -> float:
        """Return its greatest resident size so far in MiB; 0 where /proc does not tell it."""
        try:
            lines = Path(f"/proc/{self._process.pid}/status").read_text(encoding="utf-8").splitlines()
        except OSError:
            return 0.0
        peak = next((line for line in lines if line.startswith("VmHWM:")), "VmHWM: 0 kB")
        return int(peak.split()[1]) / 2**10

    def failure(self, reason: str) -> DemoError:
        """Return an error with its name, the reason and the last lines of its log."""
        lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-_LAST_LINES:]
        said = "".join(f"\n  {line}" for line in lines) or " (it printed nothing)"
        return DemoError(f"{self.name} {reason}; see {self.log}:{said}")

    def stop(self) -> None:
        """Interrupt it and wait for its end; kill it when it does not listen."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            if self._process.poll() is not None:
                return
            self._process.send_signal(number)
            try:
                self._process.wait(_STOP_SECONDS)
            except subprocess.TimeoutExpired:
                continue

    def _read(self, stdout: IO[str]) -> None:
        with self.log.open("a", encoding="utf-8") as log:
            for line in stdout:
                log.write(line)
                log.flush()
                self._lines.put(line)


class Children:
    """A family of child processes in one DDS domain, which no packet leaves."""

    def __init__(self, logs: Path) -> None:
        """Choose the domain; `logs` is the folder for their log files."""
        self._logs = logs
        self._children: list[Child] = []
        self.domain = os.environ.get("ROS_DOMAIN_ID") or str(free_domain())
        self._environment = {
            THREADS_VARIABLE: str(spared_threads()),
            **os.environ,
            "ROS_DOMAIN_ID": self.domain,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            **({"ROS_LOCALHOST_ONLY": "1"} if os.environ.get("ROS_DISTRO") == "humble" else {}),  # which knows this one
            "PYTHONUNBUFFERED": "1",
        }

    def start(self, name: str, *arguments: str) -> Child:
        """Start `python -m ARGUMENTS`; `name` is what messages and its log file call it."""
        child = Child(name, arguments, self._environment, self._logs / f"{name}.log")
        self._children.append(child)
        return child

    def stop(self) -> None:
        """Stop all, the last started first."""
        for child in reversed(self._children):
            child.stop()


@contextmanager
def children(logs: Path) -> Iterator[Children]:
    """Give a family of processes that is stopped at the end, whatever happens; SIGTERM counts as an exception."""
    family = Children(logs)
    previous = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield family
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)
        family.stop()
        signal.signal(signal.SIGTERM, previous)
        signal.signal(signal.SIGINT, interrupt)


def wait_until(what: str, condition: Callable[[], bool], seconds: float) -> None:
    """Wait until `condition`, which itself waits a moment, is true; DemoError names `what` when it never is."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise DemoError(f"waited {seconds:.0f} s in vain {what}")


def spared_threads() -> int:
    """Return how many threads inference gets where the user does not say: all processors but one.

    That one is for the player and the recorder. As many threads as processors wait for each other whenever one of them
    is taken away: on two busy processors two threads were found to need up to four times as long as one.
    """
    return max(len(os.sched_getaffinity(0)) - 1, 1)


def free_domain() -> int:
    """Return a DDS domain id in which nobody on this machine takes part, as far as its first port tells."""
    domains = random.sample(range(1, _LAST_DOMAIN + 1), _LAST_DOMAIN)
    return next((domain for domain in domains if _is_free(domain)), domains[0])


def _is_free(domain: int) -> bool:
    """Return whether the unicast discovery port of the domain's first participant (RTPS 9.6.2) can be bound."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("0.0.0.0", 7400 + 250 * domain + 10))
        except OSError as error:
            return error.errno != errno.EADDRINUSE
    return True


def _json_object(line: str) -> Iterator[dict[str, Any]]:
    if line.startswith("{"):
        yield json.loads(line)


def _terminate(number: int, _: object) -> None:
    sys.exit(128 + number)
