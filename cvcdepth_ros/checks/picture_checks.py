# SPDX-License-Identifier: Apache-2.0
"""Checks of the pictures' content: whether they show anything, and whether cameras were swapped."""

from __future__ import annotations

import cv2
import numpy as np

from cvcdepth_core.errors import ImageError, RigError
from cvcdepth_core.images.decoding import Picture
from cvcdepth_core.images.surround import SurroundPreprocessor
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig_health.swapped_cameras import Exchange, PlacedPictures, best_exchange
from cvcdepth_ros.checks.context import CheckContext, CheckResult, Status

_THUMBNAIL = (96, 54)
_BLACK, _UNIFORM = 16.0, 2.0  # of 255: what the brightest hundredth stays below; the deviation of a picture of nothing
_HEIGHT, _WIDTH = 48, 80  # enough to recognise a view, and a small picture tolerates small errors of the rig
_MUCH_BETTER = 0.85  # of the error; in right rigs the best exchange has about 1.5 times the error


def check_brightness(context: CheckContext) -> CheckResult:
    """Look for cameras whose pictures are black, or of one colour: a lens cap, a dead sensor, a night without light."""
    shown = context.shown_sets
    if not shown:
        return CheckResult("skipped", "needs a set of pictures")
    empty = {camera: sum(_shows_nothing(found[camera]) for found in shown if camera in found) for camera in shown[0]}
    problems = {camera: count for camera, count in empty.items() if count}
    if not problems:
        return CheckResult("passed", f"the pictures of {len(empty)} cameras show something")
    listed = ", ".join(f"{camera} ({count} of {len(shown)})" for camera, count in problems.items())
    remedy = "uncover or mend the camera, or give a rig file without it (--rig); there is nothing to learn from it"
    status: Status = "failed" if len(shown) in problems.values() else "warning"
    return CheckResult(status, f"black, or of one colour: pictures of {listed}", remedy, {"pictures": problems})


def _shows_nothing(picture: Picture) -> bool:
    grey = cv2.cvtColor(cv2.resize(picture, _THUMBNAIL, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    return bool(np.percentile(grey, 99) < _BLACK or grey.std() < _UNIFORM)


def check_places(context: CheckContext) -> CheckResult:
    """Exchange any two cameras and see whether neighbours' pictures then fit better: if so, they were swapped."""
    if context.rig is None:
        return CheckResult("skipped", "needs all cameras with calibration and transform")
    try:
        placed = _placed_pictures(context, context.rig)
    except (ImageError, RigError) as error:
        return CheckResult("skipped", f"needs pictures that fit their calibration and mask: {error}")
    if placed is None:
        return CheckResult("skipped", "needs a set of pictures that can be decoded")
    best = best_exchange(placed)
    if best is None:
        return CheckResult("skipped", "no two cameras share a view")
    return _judge(best, context.rig)


def _placed_pictures(context: CheckContext, rig: Rig) -> PlacedPictures | None:
    preprocessor = SurroundPreprocessor(rig, _HEIGHT, _WIDTH)
    sets = [
        np.stack([preprocessor.rectify(index, found[name]) for index, name in enumerate(rig.names)])
        for found in context.shown_sets
        if len(found) == len(rig.names)
    ]
    if not sets:
        return None
    poses = np.stack([camera.base_T_camera for camera in rig.cameras])
    return PlacedPictures(np.stack(sets), preprocessor.intrinsics, preprocessor.valid, poses, rig.lenses)


def _judge(best: Exchange, rig: Rig) -> CheckResult:
    names = [rig.names[best.first], rig.names[best.second]]
    error, exchanged = float(best.error.mean()), float(best.exchanged_error.mean())
    both = " and ".join(names)
    values = {"cameras": names, "error": round(error, 4), "exchanged_error": round(exchanged, 4)}
    numbers = f"photometric error to the neighbours {error:.3f}, exchanged {exchanged:.3f}"
    if float(np.median(best.ratio)) < _MUCH_BETTER and bool((best.ratio < 1).all()):
        remedy = f"compare topics, frames and transforms of {both}; `cvcdepth rig` shows where they look"
        return CheckResult("failed", f"{both} seem to be swapped: {numbers}", remedy, values)
    return CheckResult("passed", f"no two cameras fit better when exchanged; {both}: {numbers}", values=values)
