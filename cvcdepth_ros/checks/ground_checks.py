# SPDX-License-Identifier: Apache-2.0
"""Check of where the ground is: networks that are told their rig take their scale from it."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

from cvcdepth_core.errors import CvcDepthError, RigError
from cvcdepth_core.rig.ground import is_on_ground, refuse_unlikely_ground
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.ground_height import GroundEstimate
from cvcdepth_ros.checks.context import CheckContext, CheckResult
from cvcdepth_ros.recordings.ground import ground_by_lidar
from cvcdepth_ros.recordings.ground_pictures import ground_by_pictures
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.settings import MatchingSettings

_WRONG_SCALE = 0.05  # share of the cameras' mean height above the ground
_DISAGREE = 0.12  # by which LiDAR and pictures may differ, in the same measure
_TILTED = 2.0  # degrees


def check_ground(context: CheckContext) -> CheckResult:
    """Compare the height of the ground that the rig states with the one that LiDAR, and on request pictures, show."""
    if context.rig is None or context.assembler is None:
        return CheckResult("skipped", "needs all cameras with calibration and transform")
    by_lidar = _by_lidar(context, context.rig)
    by_pictures = _by_pictures(context) if context.options.pictures else None
    for found in (by_lidar, by_pictures):
        if isinstance(found, GroundEstimate):
            return _compared(context.rig, found, by_pictures)
    reasons = "; ".join(str(reason) for reason in (by_lidar, by_pictures) if reason is not None)
    return _not_found(context.rig, reasons)


def _by_lidar(context: CheckContext, rig: Rig) -> GroundEstimate | str:
    """Return the ground, or why it is not known."""
    if context.assembler is None:
        return "no rig"
    try:
        return ground_by_lidar(context.recording, rig, context.lidars, context.assembler.transforms)
    except RigError as error:
        return str(error)


def _by_pictures(context: CheckContext) -> GroundEstimate | str:
    options = context.options
    matching = MatchingSettings(tolerance=options.tolerance, queue_size=options.queue_size)
    try:
        recorded = RecordedRig.from_recording(context.recording, context.layout, options.base_frame)
        return ground_by_pictures(recorded, matching)
    except CvcDepthError as error:
        return str(error)


def _not_found(rig: Rig, reason: str) -> CheckResult:
    values: dict[str, Any] = {"stated": rig.ground_height, "found": None, "why_not_found": reason}
    for problem, remedy in _rig_problems(rig):
        return CheckResult("warning", f"{_stated(rig)}; {problem}", remedy, values)
    if rig.ground_height is not None:
        return CheckResult("passed", f"{_stated(rig)}; nothing to compare it with ({reason})", values=values)
    if is_on_ground(rig.base_frame):
        return CheckResult("passed", f"0 m in {rig.base_frame}, as REP 105 says", values=values)
    remedy = "networks that are told their rig need it; state it in the rig file: ground_height: -0.4"
    return CheckResult("skipped", f"{_stated(rig)} and not found ({reason}), so it is taken for 0", remedy, values)


def _compared(rig: Rig, found: GroundEstimate, by_pictures: GroundEstimate | str | None) -> CheckResult:
    above = sum(float(camera.base_T_camera[2, 3]) for camera in rig.cameras) / len(rig.cameras) - found.height
    told = [f"{_stated(rig)}; found at {found.height:.2f} m {found.describes}"]
    known = replace(rig, ground_height=found.height) if rig.ground_height is None else rig
    problems = [*_rig_problems(known), *_height_problems(rig, found, above), *_tilt_problems(rig, found)]
    if isinstance(by_pictures, GroundEstimate) and by_pictures is not found:
        told[0] += f", at {by_pictures.height:.2f} m {by_pictures.describes}"
        problems += _picture_problems(found, by_pictures, above)
    values = {
        "stated": rig.ground_height,
        "found": asdict(found),
        "by_pictures": asdict(by_pictures) if isinstance(by_pictures, GroundEstimate) else by_pictures,
    }
    remedies = [remedy for _, remedy in problems]
    if rig.ground_height is None:
        remedies.append(
            "run, evaluate and finetune find it too; for the node, `cvcdepth rig BAG` writes it into a file"
        )
    finding = "; ".join([*told, *(problem for problem, _ in problems)])
    return CheckResult("warning" if problems else "passed", finding, "; ".join(remedies) or None, values)


def _rig_problems(rig: Rig) -> list[tuple[str, str]]:
    """Return why networks that are told their rig refuse it: cameras in the ground, upside down, all at the sky."""
    try:
        refuse_unlikely_ground(rig)
    except RigError as error:
        return [(str(error), "correct the cameras' transforms; other networks do not need them")]
    return []


def _height_problems(rig: Rig, found: GroundEstimate, above: float) -> list[tuple[str, str]]:
    """Return that a stated height is wrong, with the remedy."""
    if rig.ground_height is None:
        return []
    wrong = (found.height - rig.ground_height) / above
    if abs(wrong) <= max(_WRONG_SCALE, 2 * found.uncertainty / above):
        return []
    problem = f"depth by a network that is told its rig is {abs(wrong):.0%} too {'near' if wrong < 0 else 'far'}"
    return [(problem, f"ground_height: {found.height:.2f} in the rig file; `cvcdepth rig BAG` writes it")]


def _tilt_problems(rig: Rig, found: GroundEstimate) -> list[tuple[str, str]]:
    ahead, left = found.rise_ahead or 0.0, found.rise_left or 0.0
    if max(abs(ahead), abs(left)) <= _TILTED:
        return []
    problem = f"it rises by {ahead:.1f} degrees ahead and {left:.1f} to the left"
    return [(problem, f"level {rig.base_frame}: its transforms are tilted, or the vehicle stands at a slope's edge")]


def _picture_problems(found: GroundEstimate, by_pictures: GroundEstimate, above: float) -> list[tuple[str, str]]:
    """Return that the pictures tell another height, which wrong focal lengths and wrong odometry make them do."""
    apart = found.height - by_pictures.height
    if abs(apart) <= max(_DISAGREE * above, 2 * by_pictures.uncertainty):
        return []
    ratio = (above + apart) / above
    problem = f"by the pictures the cameras are {ratio:.2f} times as high above it"
    remedy = f"calibrate the cameras (focal lengths off by {1 / ratio - 1:+.0%}?), or correct the odometry's scale"
    return [(problem, remedy)]


def _stated(rig: Rig) -> str:
    if rig.ground_height is None:
        return f"no height of the ground in {rig.base_frame} is stated"
    return f"stated at {rig.ground_height:.2f} m in {rig.base_frame}"
