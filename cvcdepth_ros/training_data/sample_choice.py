# SPDX-License-Identifier: Apache-2.0
"""Which surround sets of a recording form training samples, and which are held out. No ROS here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import cv2
import numpy as np

from cvcdepth_core.errors import RecordingError
from cvcdepth_core.networks.pose import MAX_TRANSLATION
from cvcdepth_core.scoring.comparison import SETS_TO_PROVE
from cvcdepth_core.stamps import NANOSECONDS
from cvcdepth_core.training.config import RecordingsConfig
from cvcdepth_ros.training_data.index import RecordingIndex

_OWN_INTERVALS = 1.5

Part = Literal["training", "held_out"]


class Sample(NamedTuple):
    """Which sets of which recording form a training sample."""

    recording: int
    target: int
    before: int
    after: int


def takes_recorded_motion(index: RecordingIndex, config: RecordingsConfig) -> bool:
    """Return whether the losses know from the recording how the cameras moved between a sample's sets."""
    return config.motion != "network" and index.poses is not None


def describe_motion(index: RecordingIndex, config: RecordingsConfig) -> str:
    """Return where the losses' motion of a recording comes from, in words."""
    if takes_recorded_motion(index, config):
        return f"recorded ({index.motion_topic})"
    if config.motion == "network":
        return "pose network"
    return f"pose network, for {index.motion_problem or 'none is recorded'}"


def takes_recorded_exposures(index: RecordingIndex, config: RecordingsConfig) -> bool:
    """Return whether the recording tells where each camera was when it fired."""
    if index.poses is None or config.exposure_motion == "none":
        return False
    return config.exposure_motion in ("auto", "recorded") or takes_recorded_motion(index, config)


def first_held_out(index: RecordingIndex, held_out: float) -> int:
    """Return the number of the first set that is held out; of no set where none is.

    Sets are counted, not seconds: stamps may jump, from 1970 to now when the clock is set while the vehicle drives.
    """
    return len(index) - math.ceil(held_out * (len(index) - 1))


def find_samples(index: RecordingIndex, config: RecordingsConfig, part: Part, recording: int = 0) -> list[Sample]:
    """Return the samples of one part of a recording, none of whose sets is of the other part.

    A sample's contexts are the nearest sets before and after the target that the vehicle has moved far enough from.
    Where they are known to be farther than wanted, or than the pose network can express, there is no sample, see
    `describe_skipped_samples`.
    """
    found = _within_interval(index, config, part, recording)
    return [sample for sample in found if _travel(index, sample) <= _greatest_travel(index, config)]


def find_variants(index: RecordingIndex, config: RecordingsConfig, recording: int = 0) -> list[list[Sample]]:
    """Return each training sample and, for recorded motion, the same target with contexts that are farther away.

    Where sets are far apart or the end is near, there are fewer than `further_travels` has.
    """
    leasts = config.further_travels if takes_recorded_motion(index, config) else ()
    further = [config.model_copy(update={"min_travel": max(least, config.min_travel)}) for least in leasts]
    by_target = [{one.target: one for one in find_samples(index, each, "training", recording)} for each in further]
    return [
        list(dict.fromkeys([sample, *(found[sample.target] for found in by_target if sample.target in found)]))
        for sample in find_samples(index, config, "training", recording)
    ]


def describe_skipped_samples(index: RecordingIndex, config: RecordingsConfig) -> str | None:
    """Return how many training samples are left out since the vehicle moves too far between their sets; None: none."""
    travels = [_travel(index, sample) for sample in _within_interval(index, config, "training")]
    greatest = _greatest_travel(index, config)
    too_far = [travel for travel in travels if travel > greatest]
    if not too_far:
        return None
    limit = "and the pose network tells no more than" if greatest == MAX_TRANSLATION else "max_travel is"
    return (
        f"{len(too_far)} training samples are left out: the vehicle moves up to {max(too_far):.1f} m between two of "
        f"their sets, {limit} {greatest:g}"
    )


def _greatest_travel(index: RecordingIndex, config: RecordingsConfig) -> float:
    """Return the metres to a context frame that what tells the motion can tell."""
    return config.max_travel if takes_recorded_motion(index, config) else min(config.max_travel, MAX_TRANSLATION)


def _travel(index: RecordingIndex, sample: Sample) -> float:
    """Return the recorded metres from the target to the farther context; 0 where no motion is recorded."""
    if index.poses is None:
        return 0.0
    return max(change_between(index, sample.target, other) for other in (sample.before, sample.after))


def _within_interval(index: RecordingIndex, config: RecordingsConfig, part: Part, recording: int = 0) -> list[Sample]:
    held_out = np.arange(len(index)) >= first_held_out(index, config.held_out)
    longest = longest_interval(index, config)
    samples = []
    for target in np.flatnonzero(held_out == (part == "held_out")).tolist():
        before = _context(index, config, longest, target, -1)
        after = _context(index, config, longest, target, +1)
        if before is not None and after is not None and held_out[before] == held_out[after] == held_out[target]:
            samples.append(Sample(recording, target, before, after))
    return samples


def refuse_standstill(indexes: Sequence[RecordingIndex], config: RecordingsConfig) -> None:
    """Raise RecordingError, naming recording and values, when none of the recordings has a training sample."""
    if not any(find_samples(index, config, "training") for index in indexes):
        raise RecordingError("; ".join(why_no_sample(index, config) for index in indexes))


def describe_unprovable(held_out_sets: int) -> str | None:
    """Return why no weights can be promoted by so many held-out sets; None where some can."""
    if held_out_sets >= SETS_TO_PROVE:
        return None
    return f"promotion impossible: {held_out_sets} held-out sets, {SETS_TO_PROVE} are needed"


def held_out_sets(index: RecordingIndex, config: RecordingsConfig) -> int:
    """Return how many sets of a recording are held out."""
    return len(index) - first_held_out(index, config.held_out)


def _context(index: RecordingIndex, config: RecordingsConfig, longest: float, target: int, step: int) -> int | None:
    """Return the nearest set before (step -1) or after (+1) the target, within seconds, that is far enough, or None."""
    stamps = index.stamps[:, index.anchor]
    other = target + step
    while 0 <= other < len(index) and 0 < step * (stamps[other] - stamps[target]) <= longest * NANOSECONDS:
        if _has_moved(index, config, target, other):
            return other
        other += step
    return None


def longest_interval(index: RecordingIndex, config: RecordingsConfig) -> float:
    """Return the seconds to a context frame at most: where the way is known, from one set to the next is never long."""
    if index.poses is None or len(index) < 2:
        return config.max_interval
    own = float(np.median(np.diff(index.stamps[:, index.anchor]))) / NANOSECONDS
    return max(config.max_interval, _OWN_INTERVALS * own)


def _has_moved(index: RecordingIndex, config: RecordingsConfig, first: int, second: int) -> bool:
    needed = config.min_travel if index.poses is not None else config.min_image_change
    return change_between(index, first, second) >= needed


def change_between(index: RecordingIndex, first: int, second: int) -> float:
    """Return metres travelled between two sets, or, without recorded motion, by how much the picture changed."""
    if index.poses is not None:
        positions = index.poses[[first, second], index.anchor, :3, 3]
        return float(np.linalg.norm(positions[1] - positions[0]))
    if index.thumbnails is None:
        raise RecordingError(f"{index.path}: its index has neither motion nor thumbnails")
    difference = cv2.norm(index.thumbnails[first], index.thumbnails[second], cv2.NORM_L1)
    return float(difference / index.thumbnails[0].size)


def why_no_sample(index: RecordingIndex, config: RecordingsConfig) -> str:
    """Return why a recording has no training sample, with the recording's name and the values."""
    changes = [change_between(index, first, second) for first, second in pairwise(range(len(index)))]
    largest = max(changes, default=0.0)
    lost = f", {index.without_motion} more lie outside of the recorded motion" if index.without_motion else ""
    if beyond := describe_skipped_samples(index, config):
        return f"{index.path}: no training sample in {len(index)} sets{lost}: {beyond}"
    if index.poses is not None:
        motion = f"the vehicle moves {largest:.3f} m at most from one to the next, min_travel is {config.min_travel:g}"
    else:
        motion = f"pictures change by {largest:.2f} at most, min_image_change is {config.min_image_change:g}"
    return (
        f"{index.path}: no training sample in {len(index)} sets{lost}: {motion} within max_interval "
        f"{longest_interval(index, config):g} s on both sides of a set; held_out is {config.held_out:g}"
    )
