# SPDX-License-Identifier: Apache-2.0
"""What the node says of itself on `/diagnostics`, in diagnostic_updater's form: `node: subject`, level, values."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from cvcdepth_ros.latencies import StageSummary
from cvcdepth_ros.mailbox import MailboxStatistics
from cvcdepth_ros.synchronizer import CameraStatistics, SynchronizerStatistics

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def status(level: bytes, subject: str, message: str, values: Mapping[str, Any] | None = None) -> DiagnosticStatus:
    """Build one status; the node's name is put before `subject` when it is published."""
    pairs = [KeyValue(key=key, value=_text(value)) for key, value in (values or {}).items()]
    return DiagnosticStatus(level=level, name=subject, message=message, values=pairs)


def camera_status(camera: str, problem: str | None, statistics: CameraStatistics, lost: int) -> DiagnosticStatus:
    """One camera: why nothing comes of it, or how its images fared."""
    values = {
        "received": statistics.received,
        "matched": statistics.matched,
        "queued": statistics.queued,
        "lost in transport": lost,
        **{f"dropped: {reason}": count for reason, count in statistics.dropped.items()},
        "clock steps": statistics.clock_steps,
        "rate (Hz)": 1e9 / statistics.period_ns if statistics.period_ns else "unknown",
    }
    waiting = "waiting for images" if not statistics.received else None
    trouble = problem or waiting
    level = ERROR if problem else WARN if waiting else OK
    return status(level, f"camera {camera}", trouble or "ok", values)


def synchronisation_status(
    synchroniser: SynchronizerStatistics, mailbox: MailboxStatistics, counters: Mapping[str, int]
) -> DiagnosticStatus:
    """How many sets were matched, and what became of them."""
    values = {"matched": synchroniser.sets, **asdict(mailbox), **counters}
    message = f"{synchroniser.sets} sets matched, {counters['published']} published"
    return status(OK if synchroniser.sets else WARN, "synchronisation", message, values)


def latency_status(summaries: Mapping[str, StageSummary], level: bytes, message: str) -> DiagnosticStatus:
    """How long each stage takes, in milliseconds."""
    values = {
        f"{stage} {name}": value
        for stage, summary in summaries.items()
        for name, value in (("p50 (ms)", summary.p50_ms), ("p95 (ms)", summary.p95_ms), ("max (ms)", summary.max_ms))
    }
    return status(level, "inference", message, values)


def _text(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)
