# SPDX-License-Identifier: Apache-2.0
"""Checks of what the cameras see: each other's views, the vehicle itself, what the LiDAR sees, and motion."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import RecordingError, RigError, TransformError
from cvcdepth_core.images.rectifier import Rectifier
from cvcdepth_core.images.surround import self_occlusion_mask
from cvcdepth_core.rig.lens_use import lens_uses
from cvcdepth_core.rig.rig import Camera, Rig
from cvcdepth_core.rig_health.own_body import lane_share
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_ros.checks.context import CheckContext, CheckResult, Status
from cvcdepth_ros.messages.cloud_sources import describe_left_out_clouds
from cvcdepth_ros.messages.conversion import stamp_ns
from cvcdepth_ros.messages.transforms import TransformTree
from cvcdepth_ros.recordings.lidar import LidarSweeps
from cvcdepth_ros.recordings.rig_messages import cloud_topics
from cvcdepth_ros.settings import LIDAR_TOLERANCE

_NEEDS_RIG = CheckResult("skipped", "needs all cameras with calibration and transform")
_MOSTLY_MASKED = 0.6
_MASK_STEP = 4  # pixels of the image for one of the mask's that is looked at
_PLAUSIBLE_DEPTH = (0.5, 200.0)  # metres
_FEW_POINTS = 0.01
_MOVING = 0.5  # metres per second
_ENOUGH_MOTION = 0.2


def check_overlaps(context: CheckContext) -> CheckResult:
    """Look for a neighbour of every camera: metric scale is learned where two cameras see the same."""
    if context.rig is None:
        return _NEEDS_RIG
    neighbours, angles = context.rig.neighbours, {(o.camera, o.neighbour): o.angle for o in context.rig.overlaps}
    pairs = {tuple(sorted((name, other))) for name, others in neighbours.items() for other in others}
    values = {"degrees": {f"{a} - {b}": round(angles.get((a, b), 0.0), 1) for a, b in sorted(pairs)}}
    lonely = [name for name, others in neighbours.items() if not others]
    if lonely:
        remedy = _remedy_for_overlaps(context, lonely)
        if context.motion is not None:
            remedy += f"; or odometry: with recordings.motion: auto the scale comes from {context.motion.topic}"
        none_shared = len(lonely) == len(neighbours) > 1
        status: Status = "failed" if none_shared and context.motion is None else "warning"
        return CheckResult(status, f"{', '.join(lonely)} shares no view with another camera", remedy, values)
    narrowest = min(values["degrees"], key=values["degrees"].__getitem__)
    finding = f"{len(pairs)} pairs of cameras, the narrowest {narrowest} ({values['degrees'][narrowest]:.1f} degrees)"
    return CheckResult("passed", finding, values=values)


def _remedy_for_overlaps(context: CheckContext, lonely: Collection[str]) -> str:
    """Return what helps: a right calibration, or where lenses see more than is shown of them, to show it."""
    uses = lens_uses(context.assembler.completed_layout()) if context.assembler else []
    is_hidden = any(use.is_wasted and use.possible_overlap > use.overlap and {*use.cameras} & {*lonely} for use in uses)
    whole, right = "show all of each lens (`cvcdepth rig BAG --view lens`)", "correct the calibration or transform"
    return f"{whole if is_hidden else right}; training needs overlaps, depth from a checkpoint does not"


def check_masks(context: CheckContext) -> CheckResult:
    """Measure which share of each image the rig file's masks take away, and where."""
    if context.rig is None:
        return _NEEDS_RIG
    masked = [camera for camera in context.rig.cameras if camera.mask is not None]
    if not masked:
        remedy = "where a camera sees the vehicle itself, name a mask in the rig file: that is no scene to learn from"
        return CheckResult("skipped", "the rig has no masks", remedy)
    try:
        shares = {camera.name: _masked_shares(camera) for camera in masked}
    except RigError as error:
        return CheckResult("failed", str(error), "give a PNG of the image's size, 0 on the vehicle, 255 elsewhere")
    values = {name: {part: round(share, 4) for part, share in of.items()} for name, of in shares.items()}
    finding = ", ".join(f"{name} {_masked_text(of)}" for name, of in shares.items()) + " masked"
    odd = [name for name, of in shares.items() if not _is_plausible(of)]
    if odd:
        remedy = "0 is the vehicle and 255 the scene: a mask takes away a smaller, lower part of the image"
        return CheckResult("warning", f"{finding}; not plausible: {', '.join(odd)}", remedy, values)
    return CheckResult("passed", finding, values=values)


def _is_plausible(shares: Mapping[str, float]) -> bool:
    return 0 < shares["share"] <= _MOSTLY_MASKED and shares["upper_half"] <= shares["share"]


def _masked_text(shares: Mapping[str, float]) -> str:
    lane = f" ({shares['lane']:.0%} of where the vehicle drives)" if shares["lane"] else ""
    return f"{shares['share']:.0%}{lane}"


def _masked_shares(camera: Camera) -> dict[str, float]:
    """Return the masked share of the whole image, of its upper half, and of where the vehicle drives."""
    width, height = (max(2, size // _MASK_STEP) for size in camera.calibration.image_size)
    scene = self_occlusion_mask(camera, Rectifier(camera.calibration, height, width, camera.rectified)) >= 0.5
    upper_half = float((~scene[: height // 2]).mean())
    return {"share": float((~scene).mean()), "upper_half": upper_half, "lane": lane_share(camera, scene)}


def check_lidar(context: CheckContext) -> CheckResult:
    """Project a sweep of each LiDAR into every camera at the moment of its nearest image."""
    clouds = cloud_topics(context.recording)
    silent = [topic for topic in context.lidars if topic not in clouds or topic not in context.sweeps]
    if silent and context.options.lidar is not None:
        there_are = f"in the whole recording there are {', '.join(clouds) or 'none'}"
        remedy = f"name topics with point clouds in the part that is read; {there_are}"
        return CheckResult("failed", f"no sweep on {', '.join(silent)}", remedy, {"missing": silent})
    if context.options.lidar == ():
        return CheckResult("skipped", "no LiDAR is wanted")
    result = _judged_lidars(context, [topic for topic in context.lidars if topic not in silent])
    if silent:
        remedy = "read a part that has sweeps, or name the LiDARs with --lidar"
        return _worsened(result, f"no sweep on {', '.join(silent)} in this part", remedy)
    return result


def _judged_lidars(context: CheckContext, lidars: Sequence[str]) -> CheckResult:
    if not lidars:
        remedy = "without a LiDAR, `evaluate` gives the label-free scores only"
        return _with_left_out(context, CheckResult("warning", "no LiDAR's point cloud is recorded", remedy))
    rig, assembler = context.rig, context.assembler
    if rig is None or assembler is None:
        return _NEEDS_RIG
    shares, refusals = _projections(context, lidars, rig, assembler.transforms)
    result = _judge_projection(shares) if shares else CheckResult("failed", "no sweep can be used")
    return _with_left_out(context, _with_refusals(result, refusals))


def _projections(
    context: CheckContext, lidars: Sequence[str], rig: Rig, transforms: TransformTree
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Return the shares of `_projected` by LiDAR, and why the other LiDARs have none."""
    shares: dict[str, dict[str, float]] = {}
    refusals = []
    for topic in lidars:
        try:
            shares[topic] = _projected(context, rig, topic, transforms)
        except (RecordingError, TransformError) as error:
            refusals.append(str(error))
    return shares, refusals


def _with_refusals(result: CheckResult, refusals: Sequence[str]) -> CheckResult:
    if not refusals:
        return result
    remedy = "publish the LiDAR's frame on /tf_static; clouds need x, y and z as float32 or float64"
    return _worsened(result, "; ".join(refusals), remedy)


def _with_left_out(context: CheckContext, result: CheckResult) -> CheckResult:
    if not context.other_clouds:
        return result
    finding = describe_left_out_clouds(context.other_clouds)
    return _worsened(result, finding, "name the LiDARs with --lidar, and nothing else is looked at")


def _worsened(result: CheckResult, finding: str, remedy: str) -> CheckResult:
    """Return a check's result with a further finding that is no more than a warning."""
    status: Status = "failed" if result.status == "failed" else "warning"
    remedy = f"{result.remedy}; {remedy}" if result.remedy else remedy
    return replace(result, status=status, finding=f"{result.finding}; {finding}", remedy=remedy)


def _judge_projection(shares: dict[str, dict[str, float]]) -> CheckResult:
    cameras = dict.fromkeys(camera for found in shares.values() for camera in found)
    best = {camera: max(found.get(camera, 0.0) for found in shares.values()) for camera in cameras}
    unseen = [camera for camera, share in best.items() if share < _FEW_POINTS]
    finding = "; ".join(
        f"{topic}: {', '.join(f'{camera} {share:.0%}' for camera, share in found.items()) or 'no image near a sweep'}"
        for topic, found in shares.items()
    )
    finding += " of the points are in the image"
    remedy = "compare the LiDAR's transform with the cameras', and their clocks"
    if len(unseen) == len(best):
        return CheckResult("failed", finding, remedy, shares)
    if unseen:
        return CheckResult("warning", f"{finding}; hardly any in {', '.join(unseen)}", remedy, shares)
    return CheckResult("passed", finding, values=shares)


def _projected(context: CheckContext, rig: Rig, topic: str, transforms: TransformTree) -> dict[str, float]:
    """Return for each camera the share of one sweep's points that are in its image at a plausible depth.

    Of the sweeps that were kept it is the first whose cameras' moments the recorded motion reaches.
    """
    refusal: TransformError | None = None
    for message in context.sweeps[topic]:
        if isinstance(message, RecordingError):
            raise message
        lidar = LidarSweeps([topic], rig.base_frame, transforms, context.motion, LIDAR_TOLERANCE)
        lidar.add(topic, message)
        try:
            return {
                camera.name: _share_inside(camera, points)
                for camera in rig.cameras
                if (points := lidar.points_at(_nearest(context.times(camera.name), stamp_ns(message)))) is not None
            }
        except TransformError as error:
            refusal = error
    if refusal is not None:
        raise refusal
    return {}


def _nearest(times: NDArray[np.int64], stamp: int) -> int:
    """Return the time nearest to a stamp; the stamp where there are none."""
    return int(times[np.argmin(abs(times - stamp))]) if times.size else stamp


def _share_inside(camera: Camera, points: NDArray[np.float64]) -> float:
    view = camera.rectified_view
    (u, v), z = (found.T for found in view.project(points))
    nearest, farthest = _PLAUSIBLE_DEPTH
    inside = (u >= -0.5) & (u < view.width - 0.5) & (v >= -0.5) & (v < view.height - 0.5)
    return float((inside & (z > nearest) & (z < farthest)).mean()) if len(points) else 0.0


def check_motion(context: CheckContext) -> CheckResult:
    """Measure how far and how long the vehicle moves: there is nothing to learn from one that stands still."""
    layout = context.layout
    if layout is None:
        return _NEEDS_RIG
    if context.motion is None:
        remedy = f"record /tf or an odometry topic that ends in {layout.base_frame}; training then need not guess"
        return CheckResult("warning", "motion unknown: neither /tf nor odometry is recorded", remedy)
    times, positions = _track(context, layout.anchor_camera)
    if len(times) < 2:
        impossible = context.refused_motion.reasons
        reason = impossible[0] if impossible else f"{context.motion.topic} does not reach the images' stamps"
        return CheckResult("warning", f"motion unknown: {reason}", "stamp poses and images with the same clock")
    steps, seconds = np.linalg.norm(np.diff(positions, axis=0), axis=1), np.diff(times)
    distance, duration = float(steps.sum()), float(seconds.sum())
    share = float(seconds[steps / seconds > _MOVING].sum()) / duration
    values = {"metres": round(distance, 2), "seconds": round(duration, 2), "moving_share": round(share, 3)}
    finding = f"{distance:.1f} m in {duration:.1f} s, faster than {_MOVING:g} m/s for {share:.0%} of it"
    remedy = "training needs a moving vehicle: choose another recording, or another part with --start and --duration"
    if share < _ENOUGH_MOTION:
        return CheckResult("warning" if share else "failed", finding, remedy, values)
    return CheckResult("passed", f"{finding} ({context.motion.topic})", values=values)


def _track(context: CheckContext, camera: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times [M] (s) and positions [M, 3] (m) of the vehicle at the camera's images, where they are known."""
    times, positions = [], []
    for time in np.unique(context.times(camera)).tolist():
        try:
            positions.append(context.motion.base_pose(time)[:3, 3] if context.motion else np.zeros(3))
        except TransformError:
            continue
        times.append(time / NANOSECONDS)
    return np.array(times), np.array(positions).reshape(-1, 3)
