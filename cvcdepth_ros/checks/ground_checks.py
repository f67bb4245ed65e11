# SPDX-License-Identifier: Apache-2.0
"""Check of where the ground is: networks that are told their rig take their scale from it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from cvcdepth_core.errors import RigError
from cvcdepth_core.rig.ground import is_on_ground
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.ground_height import GroundEstimate
from cvcdepth_ros.checks.context import CheckContext, CheckResult
from cvcdepth_ros.recordings.ground import ground_by_lidar

_WRONG_SCALE = 0.05  # share of the cameras' mean height above the ground
_TILTED = 2.0  # degrees


def check_ground(context: CheckContext) -> CheckResult:
    """Compare the height of the ground that the rig states with the one that the recording shows."""
    if context.rig is None or context.assembler is None:
        return CheckResult("skipped", "needs all cameras with calibration and transform")
    try:
        found = ground_by_lidar(context.recording, context.rig, context.lidars, context.assembler.transforms)
    except RigError as error:
        return _not_found(context.rig, str(error))
    return _compared(context.rig, found)


def _not_found(rig: Rig, reason: str) -> CheckResult:
    values: dict[str, Any] = {"stated": rig.ground_height, "found": None, "why_not_found": reason}
    if rig.ground_height is not None:
        return CheckResult("passed", f"{_stated(rig)}; nothing to compare it with ({reason})", values=values)
    if is_on_ground(rig.base_frame):
        return CheckResult("passed", f"0 m in {rig.base_frame}, as REP 105 says", values=values)
    remedy = "networks that are told their rig need it; state it in the rig file: ground_height: -0.4"
    return CheckResult("skipped", f"{_stated(rig)}, and not found ({reason})", remedy, values)


def _compared(rig: Rig, found: GroundEstimate) -> CheckResult:
    values = {"stated": rig.ground_height, "found": asdict(found)}
    above = [float(camera.base_T_camera[2, 3]) - found.height for camera in rig.cameras]
    wrong = (found.height - rig.ground_z) / (sum(above) / len(above))
    finding = f"{_stated(rig)}; at {found.height:.2f} m {found.describes}"
    remedies = []
    if abs(wrong) > _WRONG_SCALE:
        finding += f": depth by a network that is told its rig is {abs(wrong):.0%} too {'near' if wrong < 0 else 'far'}"
        remedies.append(f"ground_height: {found.height:.2f} in the rig file; `cvcdepth rig BAG` writes it")
    if max(abs(found.rise_ahead), abs(found.rise_left)) > _TILTED:
        finding += f"; it rises by {found.rise_ahead:.1f} degrees ahead and {found.rise_left:.1f} to the left"
        remedies.append(f"level {rig.base_frame}: the transforms tilt the vehicle, or it stands on a slope's edge")
    return CheckResult("warning" if remedies else "passed", finding, "; ".join(remedies) or None, values)


def _stated(rig: Rig) -> str:
    if rig.ground_height is None:
        return f"no height of the ground in {rig.base_frame} is stated, so it is taken for 0"
    return f"stated at {rig.ground_height:.2f} m in {rig.base_frame}"
