# SPDX-License-Identifier: Apache-2.0
"""A recording played to a live node, whose outputs are recorded: three processes, as on a vehicle."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cvcdepth_ros.console import progress_bar
from cvcdepth_ros.end_to_end.paths import DemoPaths
from cvcdepth_ros.end_to_end.processes import Child, Children, DemoError, wait_until
from cvcdepth_ros.end_to_end.received import Output
from cvcdepth_ros.messages.node_report import DIAGNOSTICS_TOPIC, NodeReport

_START_SECONDS = 120.0
_SETTLE_SECONDS = 60.0
_POLL_SECONDS = 0.5
_EQUAL_REPORTS = 2


@dataclass(frozen=True)
class LiveOutcome:
    """What was sent and received, and the node's last report."""

    rate: float
    """How many times real time it was played."""
    sent: dict[str, int]
    """By topic: messages that the player published."""
    received: dict[str, int]
    """By topic: messages that the recorder stored."""
    lost: dict[str, int]
    """By topic: messages that DDS lost on the way to the recorder."""
    node: NodeReport
    node_peak_mb: float
    """The node's greatest resident size, MiB."""


class LiveRun:
    """Starts player, node and recorder one after the other, each when the former is ready for it."""

    def __init__(
        self,
        family: Children,
        paths: DemoPaths,
        node: str,
        module: str = "cvcdepth_ros.surround_depth_node",
        inputs: Mapping[str, str] | None = None,
    ) -> None:
        """Run the node's program from `module`; `inputs` are the player's topics to record, with their types."""
        self._family = family
        self._paths = paths
        self._node_name = node
        self._module = module
        self._inputs = inputs or {}
        self._report: dict[str, Any] = {}
        self._equal_reports = 0

    def write_rig(self, recording: Path) -> None:
        """Write the rig file, by `cvcdepth rig`."""
        rig = self._family.start("rig", "cvcdepth_ros.bag_replay", "rig", str(recording), "-o", str(self._paths.rig))
        wait_until("for the rig file", lambda: rig.ended(_POLL_SECONDS), _START_SECONDS)

    def play(self, recording: Path, rate: float, duration: float, outputs: Sequence[Output]) -> LiveOutcome:
        """Play the recording to the node and record what it publishes, until its last set is done with."""
        self._node = self._family.start(
            "node", self._module, "--ros-args", "--params-file", str(self._paths.parameters)
        )
        self._recorder = self._start_recorder(outputs)
        wait_until("for the node and the recorder to find each other", self._ready, _START_SECONDS)
        player = self._start_player(recording, rate, duration)
        self._follow(player)
        self._equal_reports = 0
        wait_until("for the node to finish its last set", self._settled, _SETTLE_SECONDS)
        return self._end(player, rate)

    def _start_recorder(self, outputs: Sequence[Output]) -> Child:
        topics = [argument for output in outputs for argument in ("--topic", output.topic, output.type_name)]
        topics += [argument for topic, type_ in self._inputs.items() for argument in ("--input", topic, type_)]
        return self._family.start(
            "recorder",
            "cvcdepth_ros.end_to_end.recorder",
            str(self._paths.recording),
            "--node",
            self._node_name,
            *topics,
        )

    def _start_player(self, recording: Path, rate: float, duration: float) -> Child:
        options = ["--clock", "--json", "--wait-for-subscribers", f"{_START_SECONDS:g}"]
        span = ["--rate", f"{rate:g}", "--duration", f"{duration:g}"]
        return self._family.start("player", "cvcdepth_ros.bag_replay", "play", str(recording), *span, *options)

    def _follow(self, player: Child) -> None:
        """Wait for the player's end; a bar shows how many sets have been published."""
        with progress_bar(None, "sets published", label="playing", decimals=0) as show:
            while not player.ended():
                self._read_reports()
                show(self._published())

    def _end(self, player: Child, rate: float) -> LiveOutcome:
        """Stop the recorder, and return what was sent and received."""
        self._recorder.stop()
        self._recorder.ended()
        summary = list(self._recorder.reports(0.0))[-1]
        return LiveOutcome(
            rate=rate,
            sent=player.result()["published"],
            received=summary["received"],
            lost=summary["lost"],
            node=NodeReport.model_validate(self._report["node"]),
            node_peak_mb=self._node.peak_memory_mb(),
        )

    def _ready(self) -> bool:
        self._read_reports()
        return bool(self._report.get("ready"))

    def _settled(self) -> bool:
        """Return whether the node has nothing in hand, by its own report and since its reports no longer change."""
        self._read_reports()
        return self._equal_reports >= _EQUAL_REPORTS and NodeReport.model_validate(self._report["node"]).settled()

    def _published(self) -> int:
        return NodeReport.model_validate(self._report["node"]).published

    def _read_reports(self) -> None:
        """Read the recorder's new reports, waiting a moment for one; DemoError when a process or the node failed."""
        for child in (self._node, self._recorder):
            if child.ended():
                raise child.failure("ended too early")
        for report in self._recorder.reports(_POLL_SECONDS):
            del report["received"][DIAGNOSTICS_TOPIC]
            self._equal_reports = self._equal_reports + 1 if report == self._report else 0
            self._report = report
            if report["node"]["error"]:
                raise DemoError(f"the node reports: {report['node']['error']}; see {self._node.log}")
