# SPDX-License-Identifier: Apache-2.0
"""Checks of the times: whether stamps ascend, and the cameras' images make sets."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cvcdepth_core.rig.rig_file import RigLayout
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.checks.context import CheckContext, CheckResult, Status
from cvcdepth_ros.recordings.topic_timing import Timing
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet

_FEW_STEPS_BACK = 0.01
_ENOUGH_SETS = 0.9
_TOLERANCE_STEP = 0.005


def check_stamps(context: CheckContext) -> CheckResult:
    """Look for stamps that are zero, step back or repeat, in images and LiDAR sweeps."""
    timings = {topic: timing.timing() for topic, timing in context.timings.items()}
    if not timings:
        return CheckResult("skipped", "no images and no LiDAR sweeps")
    problems = {topic: problem for topic, timing in timings.items() if (problem := _stamp_problem(timing))}
    finding = "; ".join(f"{topic}: {problem}" for topic, problem in problems.items())
    if not problems:
        return CheckResult("passed", f"ascending on {len(timings)} topics")
    remedy = "have the driver stamp each exposure with one clock that is never set back (chrony or PTP, slewing)"
    worst = max(timing.steps_back / timing.messages for timing in timings.values())
    unstamped = any(not timing.stamped for timing in timings.values())
    status: Status = "failed" if unstamped or worst > _FEW_STEPS_BACK else "warning"
    return CheckResult(status, finding, remedy, {"problems": problems})


def _stamp_problem(timing: Timing) -> str | None:
    if not timing.stamped:
        return "all stamps are zero"
    found = ((timing.steps_back, "step back"), (timing.repeated, "repeat"))
    return ", ".join(f"{count} of {timing.messages} stamps {what}" for count, what in found if count) or None


def check_sets(context: CheckContext) -> CheckResult:
    """Match the images as the node does; where sets are missing, say which camera is in the way and what would help."""
    layout = context.layout
    if layout is None:
        return CheckResult("skipped", "needs cameras")
    received = {name: context.stamps(name).size for name in layout.names}
    silent = [name for name, count in received.items() if not count]
    if silent:
        remedy = "record their images, or give a rig file without them (--rig)"
        return CheckResult("failed", f"no image of {', '.join(silent)}", remedy, {"images": received})
    sets = context.match(layout, context.options.tolerance)
    anchor, tolerance = layout.anchor_camera, context.options.tolerance
    values = {"sets": len(sets), "images": received, "tolerance": tolerance, **_spread(sets, layout)}
    finding = f"{len(sets)} sets of the {received[anchor]} images of {anchor} at a tolerance of {tolerance:g} s"
    if sets:
        finding += f", {1e3 * values['spread']:.0f} ms from {values['first']} to {values['last']}"
    if len(sets) >= _ENOUGH_SETS * received[anchor]:
        return CheckResult("passed", finding, values=values)
    limit, remedy, proposal = _limit(context, layout, received, len(sets))
    status: Status = "warning" if sets else "failed"
    return CheckResult(status, f"{finding}; {limit}", remedy, {**values, **proposal})


def _spread(sets: Sequence[SurroundSet[int]], layout: RigLayout) -> dict[str, Any]:
    """Return the median spread (s) of the sets' corrected stamps, and which cameras are first and last."""
    if not sets:
        return {}
    later = _seconds_later(sets, layout)
    spread = float(np.median([found.spread_ns for found in sets])) / NANOSECONDS
    order = sorted(later, key=later.__getitem__)
    return {"spread": spread, "first": order[0], "last": order[-1], "seconds_later": later}


def _seconds_later(sets: Sequence[SurroundSet[int]], layout: RigLayout) -> dict[str, float]:
    """Return the median seconds by which each camera's corrected stamp is later than the anchor's."""
    anchor = layout.anchor_camera

    def later(camera: str) -> float:
        return float(np.median([found.times_ns[camera] - found.times_ns[anchor] for found in sets])) / NANOSECONDS

    return {camera: later(camera) for camera in layout.names}


def _limit(
    context: CheckContext, layout: RigLayout, received: Mapping[str, int], sets: int
) -> tuple[str, str, dict[str, Any]]:
    """Return what prevents sets, the remedy, and both as values: clocks, the tolerance, or lost images."""
    offsets = _clock_differences(context, layout)
    shifted = len(context.match(layout, context.options.tolerance, offsets))
    if offsets and shifted > sets:
        listed = ", ".join(f"{name} {offset:+.3f} s" for name, offset in offsets.items())
        remedy = f"give stamp_offset in a rig file ({listed}): {shifted} sets; or set the cameras' clocks alike"
        proposal = {"limited_by": list(offsets), "stamp_offset": offsets}
        return f"limited by the clock of {', '.join(offsets)}", remedy, proposal
    wide = context.match(layout, max(context.options.tolerance, _period(context, layout)))
    if len(wide) > sets:
        return _limit_by_spread(context, layout, wide)
    fewest = min(received, key=received.__getitem__)
    remedy = "look for lost images (`cvcdepth inspect` shows gaps); choose the slowest camera as anchor in a rig file"
    return f"limited by {fewest} with {received[fewest]} images", remedy, {"limited_by": [fewest]}


def _limit_by_spread(
    context: CheckContext, layout: RigLayout, wide: Sequence[SurroundSet[int]]
) -> tuple[str, str, dict[str, Any]]:
    """Propose the tolerance that most of the sets need which a wide one finds."""
    needed = float(np.percentile([found.spread_ns for found in wide], 95)) / NANOSECONDS
    tolerance = round(math.ceil(needed / _TOLERANCE_STEP) * _TOLERANCE_STEP, 3)
    ends = _spread(wide, layout)
    cameras = [ends["first"], ends["last"]]
    remedy = f"--tolerance {tolerance:g} gives {len(context.match(layout, tolerance))} sets"
    limit = f"limited by {' and '.join(cameras)}, {1e3 * ends['spread']:.0f} ms apart"
    return limit, remedy, {"limited_by": cameras, "proposed_tolerance": tolerance}


def _clock_differences(context: CheckContext, layout: RigLayout) -> dict[str, float]:
    """Return the stamp offsets of cameras whose clocks differ from the anchor's by more than half a period.

    That is judged by the log times; a smaller difference may as well be that of cameras that fire at another time.
    """
    found = {c.name: context.timings[c.image_topic].timing().clock_offset for c in layout.cameras}
    clocks = {name: offset.median for name, offset in found.items() if offset is not None}
    anchor = clocks.get(layout.anchor_camera)
    if anchor is None:
        return {}
    ahead = {name: round(anchor - clock, 3) for name, clock in clocks.items()}
    return {name: seconds for name, seconds in ahead.items() if abs(seconds) > _period(context, layout) / 2}


def _period(context: CheckContext, layout: RigLayout) -> float:
    anchor = next(camera for camera in layout.cameras if camera.name == layout.anchor_camera)
    return context.timings[anchor.image_topic].timing().interval or 0.0
