# SPDX-License-Identifier: Apache-2.0
"""Checks of what `finetune` would make of a recording: samples and held-out sets, and a pose network's answers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cvcdepth_core.errors import CvcDepthError, RecordingError
from cvcdepth_core.networks.checkpoint import load_checkpoint
from cvcdepth_core.rig.poses import inverse
from cvcdepth_core.training.pose_network import TRUSTED_RATIOS, MotionError, PoseAnswers, PoseScore, motion_error
from cvcdepth_ros.checks.context import CheckContext, CheckResult
from cvcdepth_ros.surround_sets.synchronizer import SurroundSet
from cvcdepth_ros.training_data.index import RecordingIndex, index_of_sets, thumbnail_of
from cvcdepth_ros.training_data.sample_choice import (
    Sample,
    describe_motion,
    describe_skipped_samples,
    describe_unprovable,
    find_samples,
    held_out_sets,
    why_no_sample,
)
from cvcdepth_ros.training_data.samples import SampleReader

_ASKED_STEPS = 12


def check_training(context: CheckContext) -> CheckResult:
    """Count training samples and held-out sets as `finetune` does."""
    index = _index(context)
    if isinstance(index, CheckResult):
        return index
    config = context.options.training
    samples, held_out = len(find_samples(index, config, "training")), held_out_sets(index, config)
    values = {"samples": samples, "held_out_sets": held_out, "sets": len(index)}
    finding = f"{samples} training samples and {held_out} held-out sets, motion: {describe_motion(index, config)}"
    if not samples:
        because = why_no_sample(index, config).removeprefix(f"{index.path}: ")
        remedy = "`finetune` refuses it; drive, or change `recordings` in the training file (--config)"
        return CheckResult("warning", f"0 samples because: {because}", remedy, values)
    if told := describe_unprovable(held_out):
        remedy = "take longer recordings or several, hold more out (recordings.held_out), or `finetune --no-promotion`"
        return CheckResult("warning", f"{finding}; {told}", remedy, values)
    if skipped := describe_skipped_samples(index, config):
        remedy = "record at a higher rate, or drive more slowly"
        return CheckResult("warning", f"{finding}; {skipped}", remedy, values)
    return CheckResult("passed", finding, values=values)


def check_pose_network(context: CheckContext) -> CheckResult:
    """Compare the answers of a checkpoint's pose network with the recorded motion, on some samples of the recording."""
    path = context.options.checkpoint
    if path is None:
        return CheckResult("skipped", "no checkpoint is named", "--checkpoint FILE compares its answers with odometry")
    if context.rig is None or context.motion is None:
        return CheckResult("skipped", "needs recorded motion, and all cameras with calibration and transform")
    index = _index(context)
    if isinstance(index, CheckResult):
        return index
    try:
        score = _pose_score(context, index)
    except CvcDepthError as error:
        return CheckResult("failed", str(error))
    if score is None:
        return CheckResult("skipped", "no pose network in the checkpoint, or no sample with motion to ask it for")
    values = {"ratio": round(score.ratio, 3), "degrees": round(score.degrees, 3), "steps": score.steps}
    if score.is_trusted:
        return CheckResult("passed", score.describe(), values=values)
    least, greatest = TRUSTED_RATIOS
    remedy = "where odometry is recorded or live it is used instead; `finetune` with recordings.motion: auto teaches it"
    return CheckResult("warning", f"{score.describe()}; {least} to {greatest} is right", remedy, values)


def _index(context: CheckContext) -> RecordingIndex | CheckResult:
    """Return the index of the sets that were read, or why there is none."""
    layout = context.layout
    if layout is None:
        return CheckResult("skipped", "needs cameras")
    sets = context.match(layout, context.options.tolerance)
    thumbnails: list[NDArray[np.uint8]] = []
    if context.motion is None:
        sets, thumbnails = _with_thumbnails(context, sets, layout.anchor_camera)
    if not sets:
        return CheckResult("skipped", "needs sets")
    try:
        return index_of_sets(context.recording.path, layout, sets, context.motion, thumbnails)
    except RecordingError as error:
        return CheckResult("warning", f"0 samples because: {error}", "stamp poses and images with the same clock")


def _with_thumbnails(
    context: CheckContext, sets: list[SurroundSet[int]], anchor: str
) -> tuple[list[SurroundSet[int]], list[NDArray[np.uint8]]]:
    """Return the sets whose anchor's picture can be decoded, and small pictures of those."""
    found = dict(_thumbnails(context, {one.images[anchor] for one in sets}, anchor))
    shown = [one for one in sets if one.images[anchor] in found]
    return shown, [found[one.images[anchor]] for one in shown]


def _thumbnails(context: CheckContext, log_times: set[int], anchor: str) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    layout = context.layout
    if layout is None or not log_times:
        return
    topic = next(camera.image_topic for camera in layout.cameras if camera.name == anchor)
    for message in context.recording.messages([topic], min(log_times), max(log_times) + 1):
        if message.log_time not in log_times:
            continue
        try:
            thumbnail = thumbnail_of(context.recording.deserialize(message), anchor)
        except RecordingError:
            continue
        if thumbnail is not None:
            yield message.log_time, thumbnail


def _pose_score(context: CheckContext, index: RecordingIndex) -> PoseScore | None:
    checkpoint = load_checkpoint(context.options.checkpoint or "")
    network = PoseAnswers.from_checkpoint(checkpoint)
    config = context.options.training
    samples = [*find_samples(index, config, "training"), *find_samples(index, config, "held_out")]
    if network is None or not samples or index.poses is None:
        return None
    asked = [samples[i] for i in np.unique(np.linspace(0, len(samples) - 1, _ASKED_STEPS).astype(int))]
    reader = SampleReader([index], asked, checkpoint.spec.height, checkpoint.spec.width, config)
    errors = (_pose_error(network, reader, index, index.poses, sample) for sample in asked)
    return PoseScore.of([error for error in errors if error is not None])


def _pose_error(
    network: PoseAnswers, reader: SampleReader, index: RecordingIndex, poses: NDArray[np.float64], sample: Sample
) -> MotionError | None:
    rig, anchor = reader.rigs[0], index.anchor
    base_T_camera = rig.base_T_camera
    earlier, later = (poses[row, anchor] @ base_T_camera[anchor] for row in (sample.before, sample.target))
    pictures = [reader.pictures(0, row) for row in (sample.before, sample.target)]
    intrinsics = rig.preprocessor.intrinsics
    answer = network.later_T_earlier(pictures[0], pictures[1], rig.poses_above_ground, anchor, intrinsics)
    return motion_error(answer, inverse(later) @ earlier)
