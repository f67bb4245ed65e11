# SPDX-License-Identifier: Apache-2.0
"""The result of a demo: counts of what was sent, of what the node reported, and of what arrived."""

from typing import Any

from pydantic import BaseModel, ConfigDict

from cvcdepth_ros.console import table
from cvcdepth_ros.messages.node_report import NodeReport

UNTRAINED_WARNING = "UNTRAINED NETWORK: this depth means nothing"


class DemoResult(BaseModel):
    """The content of demo.json."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    version: str
    """The package's version."""
    recording: str
    """What was played."""
    rate: float
    """How many times real time it was played."""
    parameters: dict[str, Any]
    """The node's parameters."""
    untrained: bool
    """Whether the network has random weights."""
    sent: int
    """Sets of which the player sent every image."""
    received: int
    """Sets of which every message arrived at the recorder, with exactly the stamps that were sent."""
    incomplete: dict[int, list[str]]
    """Sets (counted from 1) of which only a part arrived: the topics without a message."""
    never_sent: dict[str, int]
    """By topic: messages that arrived with the stamp of no set that was sent."""
    node: NodeReport
    """The node's last diagnostics."""
    images_sent: int
    """Images that the player sent on the rig's topics."""
    messages_received: dict[str, int]
    """By topic: what the recorder stored."""
    messages_lost: dict[str, int]
    """By topic: what DDS lost on the way to the recorder; only topics that lost any."""

    def problems(self) -> list[str]:
        """Return what went wrong; nothing when every set was matched and every published set arrived."""
        node = self.node
        checks = {
            "the recording has no set of which every image was sent": self.sent > 0,
            f"{self.sent} sets were sent complete, but {node.matched} matched": node.matched == self.sent,
            f"no set was published: {node.error or node.set_error or self._dropped()}": node.published > 0,
            f"{node.published} sets were published, but {self.received} received": self.received == node.published,
            f"messages came with stamps of no set that was sent: {_listed(self.never_sent)}": not self.never_sent,
        }
        return [problem for problem, passed in checks.items() if not passed]

    def counts(self) -> list[tuple[str, str]]:
        """Return the counts of sets and images as rows of name and value."""
        return [
            ("speed, 1 is real time", f"{self.rate:.3g}"),
            ("sets sent complete", str(self.sent)),
            ("sets matched", str(self.node.matched)),
            ("sets published", str(self.node.published)),
            ("sets received complete", str(self.received)),
            ("sets dropped", self._dropped()),
            ("images sent", str(self.images_sent)),
            ("images lost on the way to the node", _listed(self.node.images_lost)),
            ("images that matched no set", _listed(self.node.images_dropped)),
            ("messages lost on the way from the node", _listed(self.messages_lost)),
        ]

    def latencies(self) -> list[tuple[str, str, str]]:
        """Return the stages as rows of name, p50 and p95 in milliseconds."""
        return [(stage, f"{t.p50_ms:.1f}", f"{t.p95_ms:.1f}") for stage, t in self.node.latencies.items()]

    def text(self) -> str:
        """Return both tables for the terminal."""
        latencies = table(("stage", "p50 (ms)", "p95 (ms)"), list(self.latencies()))
        return f"{table(('what', 'count'), list(self.counts()))}\n\n{latencies}"

    def _dropped(self) -> str:
        incomplete = {"not received complete": len(self.incomplete)}
        return _listed(self.node.dropped | incomplete)


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count) or "none"
