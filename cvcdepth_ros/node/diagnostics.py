# SPDX-License-Identifier: Apache-2.0
"""The node's statuses on `/diagnostics`, in diagnostic_updater's form: `node: subject`, level, values."""

from collections.abc import Collection, Mapping
from dataclasses import asdict
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from cvcdepth_core.estimator import DepthEstimator
from cvcdepth_core.obstacles.ground import GroundPlane
from cvcdepth_core.rig.ground import is_on_ground, unstated_ground
from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.rig_health.overlap_monitor import OverlapMonitor
from cvcdepth_ros.live.camera_states import CameraCondition, CameraState, CameraWatch
from cvcdepth_ros.live.mailbox import MailboxStatistics
from cvcdepth_ros.live.vehicle_poses import VehiclePoses
from cvcdepth_ros.surround_sets.latencies import StageSummary
from cvcdepth_ros.surround_sets.refinement import RefinementStage
from cvcdepth_ros.surround_sets.synchronizer import CameraStatistics, SynchronizerStatistics

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

UNKNOWN_LATENCY = "not known: images are not stamped in the node's time"

_EVIDENCE = {
    "odometry": "earlier pictures by odometry, and neighbours",
    "alignment": "earlier pictures by motion from the pictures, and neighbours",
    "unknown": "neighbours only",
}

_LEVELS = {
    CameraState.OK: OK,
    CameraState.REJECTED: ERROR,
    CameraState.FROZEN: ERROR,
    CameraState.STALE: ERROR,
}


def status(level: bytes, subject: str, message: str, values: Mapping[str, Any] | None = None) -> DiagnosticStatus:
    """Return one status; the node's name is put before `subject` when it is published."""
    pairs = [KeyValue(key=key, value=_text(value)) for key, value in (values or {}).items()]
    return DiagnosticStatus(level=level, name=subject, message=message, values=pairs)


def camera_status(
    camera: str, condition: CameraCondition, statistics: CameraStatistics, watch: CameraWatch, lost: int
) -> DiagnosticStatus:
    """Return a camera's status: its state, the reason for it, and the counts of its images."""
    silence = watch.seconds_since_image
    values = {
        "state": condition.state.value,
        "received": statistics.received + watch.repeated,
        "matched": statistics.matched,
        "queued": statistics.queued,
        "sets without it": statistics.missed,
        "refused": watch.refused,
        "left out: frozen": watch.repeated,
        "lost in transport": lost,
        **{f"dropped: {reason}": count for reason, count in statistics.dropped.items()},
        "clock steps": statistics.clock_steps,
        "rate (Hz)": 1e9 / statistics.period_ns if statistics.period_ns else "unknown",
        "seconds since last image": "never" if silence is None else silence,
    }
    return status(_LEVELS.get(condition.state, WARN), f"camera {camera}", condition.text, values)


def synchronisation_status(
    synchroniser: SynchronizerStatistics, mailbox: MailboxStatistics, counters: Mapping[str, int], problem: str = ""
) -> DiagnosticStatus:
    """Return the counts of matched, published and dropped sets, and `problem`: why none gets through."""
    values = {"matched": synchroniser.sets, **asdict(mailbox), **counters}
    message = f"{synchroniser.sets} sets matched, {counters['published']} published"
    level = WARN if problem or not synchroniser.sets else OK
    return status(level, "synchronisation", "; ".join(filter(None, (problem, message))), values)


def inference_status(
    summaries: Mapping[str, StageSummary],
    mailbox: MailboxStatistics,
    problem: str,
    model_id: str,
    unknown: Collection[str] = (),
) -> DiagnosticStatus:
    """Return the stages' latencies in milliseconds, and the number of sets that never reached the network.

    The latencies of `unknown` stages cannot be known.
    """
    values: dict[str, Any] = {
        f"{stage} {name}": value
        for stage, summary in summaries.items()
        for name, value in (("p50 (ms)", summary.p50_ms), ("p95 (ms)", summary.p95_ms), ("max (ms)", summary.max_ms))
    }
    values |= dict.fromkeys(unknown, UNKNOWN_LATENCY)
    misses = {"deadline misses": mailbox.replaced + mailbox.stale}
    return status(ERROR if problem else OK, "inference", problem or model_id, values | misses)


def model_status(estimator: DepthEstimator) -> DiagnosticStatus:
    """Return the network's name, its device and the size of its input."""
    values = {"device": estimator.device, "height": estimator.spec.height, "width": estimator.spec.width}
    return status(OK, "model", estimator.model_id, values)


def ground_status(layout: RigLayout) -> DiagnosticStatus:
    """Return how high the ground lies for networks that are told it, and what helps where nobody says it."""
    values = {f"ground in {layout.base_frame} (m)": layout.ground_z}
    problem = ground_problem(layout)
    told = f"{layout.ground_z:.2f} m in {layout.base_frame}"
    return status(WARN if problem else OK, "ground", problem or told, values)


def ground_problem(layout: RigLayout) -> str:
    """Return that nobody says how high the ground lies, with the remedy; empty where somebody does."""
    is_known = layout.ground_height is not None or is_on_ground(layout.base_frame)
    return "" if is_known else unstated_ground(layout.base_frame)


def overlap_status(monitor: OverlapMonitor) -> DiagnosticStatus:
    """Return how well neighbouring cameras agree, pair by pair, and which of them have changed."""
    values: dict[str, Any] = {}
    for (camera, neighbour), pair in monitor.pairs().items():
        values[f"{camera} - {neighbour}: turned (deg)"] = pair.misalignment
        values[f"{camera} - {neighbour}: depth differs by"] = pair.disagreement
        values[f"{camera} - {neighbour}: usually by"] = pair.baseline_disagreement
    values |= {f"{camera}: sharper by (log)": change for camera, change in monitor.sharpness_changes().items()}
    findings = "; ".join(map(str, monitor.findings()))
    return status(WARN if findings else OK, "cross-view consistency", findings or "ok", values)


def refinement_status(stage: RefinementStage, motion: VehiclePoses) -> DiagnosticStatus:
    """Return where motion comes from, and with how many pictures each camera's was compared in the last set."""
    last = stage.last
    if last is None:
        return status(OK, "refinement", "no set yet", {"motion topic": motion.topic or "none"})
    cameras, refined = last
    values: dict[str, Any] = {"motion": refined.source, "motion topic": motion.topic or "none"}
    found = refined.depth
    for name, share, earlier, beside in zip(cameras, found.checked, found.earlier, found.beside, strict=True):
        values[f"{name}: checked share"] = float(share)
        values[f"{name}: earlier pictures"] = int(earlier)
        values[f"{name}: neighbours"] = int(beside)
    problem = refined.odometry_problem or motion.problem
    return status(WARN if problem else OK, "refinement", problem or _EVIDENCE[refined.source], values)


def ground_plane_status(ground: GroundPlane) -> DiagnosticStatus:
    """Return where the ground was taken to be in the last set whose obstacles were asked for."""
    values = {"height (m)": ground.height, "slope along x": ground.slope_x, "slope along y": ground.slope_y}
    return status(OK if ground.is_fitted else WARN, "ground plane", ground.describe(), values)


def deskew_status(deskewed: bool | None) -> DiagnosticStatus:
    """Return whether the points of the last merged cloud were moved to its moment; None: there was no cloud yet."""
    if deskewed is None:
        return status(OK, "deskew", "no cloud yet")
    if deskewed:
        return status(OK, "deskew", "points are moved to the cloud's moment")
    return status(
        WARN, "deskew", "points stay where they were seen: the vehicle's motion is not known at the exposures"
    )


def _text(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)
