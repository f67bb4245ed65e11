# SPDX-License-Identifier: Apache-2.0
"""Will this recording and this rig work? Numbered checks, each with its remedy. Nothing here imports ROS."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

from cvcdepth_ros.checks.context import CheckContext, CheckOptions, CheckResult, Status
from cvcdepth_ros.checks.depth_checks import check_mounts, check_odometry
from cvcdepth_ros.checks.ground_checks import check_ground
from cvcdepth_ros.checks.picture_checks import check_brightness, check_places
from cvcdepth_ros.checks.rig_checks import (
    check_camera_infos,
    check_cameras,
    check_encodings,
    check_lenses,
    check_transforms,
)
from cvcdepth_ros.checks.scene_checks import check_lidar, check_masks, check_motion, check_overlaps
from cvcdepth_ros.checks.time_checks import check_sets, check_stamps
from cvcdepth_ros.checks.training_checks import check_pose_network, check_training

__all__ = ["CHECKS", "CheckContext", "CheckOptions", "CheckResult", "NumberedResult", "Status", "run_checks"]

CHECKS: Mapping[str, Callable[[CheckContext], CheckResult]] = {
    "cameras": check_cameras,
    "camera_info": check_camera_infos,
    "transforms": check_transforms,
    "stamps": check_stamps,
    "sets": check_sets,
    "overlaps": check_overlaps,
    "ego masks": check_masks,
    "LiDAR": check_lidar,
    "motion": check_motion,
    "encodings": check_encodings,
    "brightness": check_brightness,
    "places": check_places,
    "training": check_training,
    "pose network": check_pose_network,
    "lenses": check_lenses,
    "mounts": check_mounts,
    "odometry": check_odometry,
    "ground": check_ground,
}


_LEFT_OUT = CheckResult("skipped", "left out as you wanted")


class NumberedResult(NamedTuple):
    """Result of one of `CHECKS`; numbers count from 1."""

    number: int
    name: str
    result: CheckResult


def run_checks(context: CheckContext, left_out: Collection[str] = ()) -> list[NumberedResult]:
    """Run all checks, each whatever the others found, without those named in `left_out`."""
    return [
        NumberedResult(number, name, _LEFT_OUT if name in left_out else check(context))
        for number, (name, check) in enumerate(CHECKS.items(), 1)
    ]
