# SPDX-License-Identifier: Apache-2.0
"""Checks by depth: whether neighbours' pictures agree with the mounts, and the vehicle's motion with the pictures.

The network is run for them, so only where that is asked for.
"""

from __future__ import annotations

import numpy as np

from cvcdepth_core.errors import CvcDepthError
from cvcdepth_ros.checks.context import CheckContext, CheckResult
from cvcdepth_ros.recordings.compared_pictures import ComparedPictures, compare_pictures, mounts_to_json, parts_of
from cvcdepth_ros.recordings.ground import with_ground
from cvcdepth_ros.recordings.rig import RecordedRig
from cvcdepth_ros.settings import MatchingSettings, ModelSettings

_NOT_ASKED = CheckResult("skipped", "not asked for", "--pictures runs the network to compare pictures, for a minute")
_PARTS, _PART_SECONDS = 2, 2.5
_LARGEST_TURN = 0.3  # degrees


def check_mounts(context: CheckContext) -> CheckResult:
    """Look for the small turns that make neighbours' pictures agree."""
    compared = _compared(context)
    if isinstance(compared, CheckResult):
        return compared
    rig, values = compared.rig, mounts_to_json(compared.rig, compared.mounts)
    told = [pair for pair in compared.mounts.pairs if pair.problem is None]
    if not told:
        reasons = [pair.problem for pair in compared.mounts.pairs]
        return CheckResult("skipped", f"the pictures do not tell: {(*reasons, 'no overlaps')[0]}", values=values)
    worst = max(told, key=lambda pair: float(np.linalg.norm(pair.turn)))
    degrees = float(np.linalg.norm(worst.turn))
    finding = (
        f"neighbours disagree by {degrees:.1f} degrees ({rig.names[worst.camera]} - {rig.names[worst.neighbour]}), "
        f"their pictures correlate by {worst.before:.2f}, turned by {worst.after:.2f}"
    )
    if degrees <= _LARGEST_TURN:
        return CheckResult("passed", finding, values=values)
    return CheckResult("warning", finding, "`cvcdepth rig BAG --refine` turns the mounts", values)


def check_odometry(context: CheckContext) -> CheckResult:
    """Compare recorded motion with what the pictures show."""
    compared = _compared(context)
    if isinstance(compared, CheckResult):
        return compared
    if not compared.has_odometry:
        return CheckResult("skipped", "neither /tf nor odometry is recorded")
    if compared.odometry_problem:
        remedy = "correct scale, frame or stamps of odometry; where it is far off, refinement and training do without"
        return CheckResult("warning", compared.odometry_problem, remedy)
    if not compared.has_judged_odometry:
        return CheckResult("skipped", f"too few sets in a row to tell: {compared.sets}")
    return CheckResult("passed", f"agrees with the pictures of {compared.sets} sets")


def _compared(context: CheckContext) -> ComparedPictures | CheckResult:
    """Return what the pictures say, found once for both checks; or why that is not known."""
    if not context.options.pictures:
        return _NOT_ASKED
    if context.rig is None or context.layout is None:
        return CheckResult("skipped", "needs all cameras with calibration and transform")
    if context.compared is None:
        context.compared = _compare(context)
    return context.compared


def _compare(context: CheckContext) -> ComparedPictures | CheckResult:
    options, recording = context.options, context.recording
    start = recording.start if options.start is None else options.start
    stop = recording.end + 1 if options.stop is None else min(options.stop, recording.end + 1)
    path = "" if options.checkpoint is None else str(options.checkpoint)
    matching = MatchingSettings(tolerance=options.tolerance, queue_size=options.queue_size)
    try:
        recorded = RecordedRig.from_recording(recording, context.layout, options.base_frame)
        network = ModelSettings.model_validate({"checkpoint": path}).build_estimator()
        if network.spec.is_told_its_rig:
            recorded, _ = with_ground(recorded, options.lidar)
        return compare_pictures(recorded, network, parts_of(start, stop, _PARTS, _PART_SECONDS), matching)
    except CvcDepthError as error:
        return CheckResult("skipped", str(error))
