# SPDX-License-Identifier: Apache-2.0
"""What the node says of itself on /diagnostics, as plain values. No ROS import: recorded and live messages both fit."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict

DIAGNOSTICS_TOPIC = "/diagnostics"

_PERCENTILES = ("p50", "p95", "max")
_ERROR = 2  # diagnostic_msgs/DiagnosticStatus.ERROR
_LOST = "lost in transport"
_DROPPED = "dropped: "
# Counters on a set's way; every other one says why a set went no further.
_NO_REASONS = ("matched", "received", "delivered", "published")


class Latency(BaseModel):
    """One stage's percentiles over the last 1000 sets, in milliseconds."""

    model_config = ConfigDict(frozen=True)

    p50_ms: float
    p95_ms: float
    max_ms: float


class NodeReport(BaseModel):
    """The last state of the node."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    error: str = ""
    """Why the node does not work; empty while it does."""
    set_error: str = ""
    """Why the last set was refused; empty while none is."""
    model: str = ""
    """The network that runs, as the node calls it."""
    sets: dict[str, int] = {}
    """Counters of the sets: matched, then what became of them."""
    images_lost: dict[str, int] = {}
    """By camera: images that DDS lost on the way to the node."""
    images_dropped: dict[str, int] = {}
    """By reason: images that became part of no set."""
    latencies: dict[str, Latency] = {}
    """By stage."""

    @property
    def matched(self) -> int:
        """Sets that the synchroniser put together."""
        return self.sets.get("matched", 0)

    @property
    def published(self) -> int:
        """Sets of which everything was published."""
        return self.sets.get("published", 0)

    @property
    def dropped(self) -> dict[str, int]:
        """By reason: sets that were matched and not published."""
        return {reason: count for reason, count in self.sets.items() if reason not in _NO_REASONS and count}

    def settled(self) -> bool:
        """Whether every matched set has met its fate: published, or dropped for a reason."""
        return self.matched == self.published + sum(self.dropped.values())


def read_report(message: Any, node: str) -> NodeReport | None:
    """Read a DiagnosticArray; None when it is of another node than `node` (its full name, as in /surround_depth)."""
    statuses = {status.name.partition(": ")[2]: status for status in message.status if status.hardware_id == node}
    if not statuses:
        return None
    values = {subject: {v.key: v.value for v in status.values} for subject, status in statuses.items()}
    cameras = {s.removeprefix("camera "): v for s, v in values.items() if s.startswith("camera ")}
    return NodeReport(
        error=_message(statuses, "node", failed=True),
        set_error=_message(statuses, "inference", failed=True),
        model=_message(statuses, "inference", failed=False),
        sets={key: int(value) for key, value in values.get("synchronisation", {}).items()},
        images_lost={camera: int(v[_LOST]) for camera, v in cameras.items()},
        images_dropped=_summed(cameras),
        latencies=_latencies(values.get("inference", {})),
    )


def _message(statuses: Mapping[str, Any], subject: str, *, failed: bool) -> str:
    """Return the message of a status that is (or is not) an error, else nothing."""
    if subject not in statuses:
        return ""
    level = statuses[subject].level
    # A `byte` field is bytes in rclpy and a number in rosbags.
    is_error = (level[0] if isinstance(level, bytes) else int(level)) >= _ERROR
    return str(statuses[subject].message) if is_error == failed else ""


def _summed(cameras: Mapping[str, Mapping[str, str]]) -> dict[str, int]:
    """Add the cameras' counters of dropped images, by reason."""
    dropped: Counter[str] = Counter()
    for values in cameras.values():
        dropped.update({key.removeprefix(_DROPPED): int(v) for key, v in values.items() if key.startswith(_DROPPED)})
    return dict(dropped)


def _latencies(values: Mapping[str, str]) -> dict[str, Latency]:
    stages = [key.removesuffix(" p50 (ms)") for key in values if key.endswith(" p50 (ms)")]
    return {s: Latency(**{f"{kind}_ms": float(values[f"{s} {kind} (ms)"]) for kind in _PERCENTILES}) for s in stages}
