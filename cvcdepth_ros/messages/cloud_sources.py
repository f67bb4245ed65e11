# SPDX-License-Identifier: Apache-2.0
"""Which point clouds are a LiDAR's: not those of radars, obstacles, maps and cameras, which are no ground truth."""

import re
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

_COLOURS = {"rgb", "rgba"}
# What radars measure and no LiDAR does; FMCW LiDARs have a `velocity` too.
_RADAR_FIELDS = {
    "rcs",
    "doppler",
    "doppler_velocity",
    "v_doppler",
    "v_doppler_mps",
    "radial_velocity",
    "radial_speed",
    "range_rate",
    "vx_comp",
    "vy_comp",
    "dyn_prop",
    "snr",
    "snr_db",
}
_NAMES = {
    "their name is a radar's or sonar's": r"radar|mmwave|\bars\d|\bsrr|sonar|ultrasonic",
    "their name is that of obstacles": r"obstacle|cluster|no_?n?ground|costmap|occupancy|\bobjects?\b",
    "their name is a map's": r"\b(sub|global|local|pointcloud_)?map\b|\bslam\b",
    "their name is a depth camera's": r"\b(depth|stereo|disparity)\b",
}


def why_no_lidar(topic: str, message: Any) -> str | None:
    """Say why a topic's PointCloud2s are no LiDAR's, by their fields and name; None where they may be one's."""
    fields = {str(field.name).lower() for field in message.fields}
    if fields & _COLOURS:
        return "their points have colours"
    if found := sorted(fields & _RADAR_FIELDS):
        return f"their points have {', '.join(found)}, as a radar's"
    # Words are told apart by slashes, and by underscores too.
    name = topic.lower().replace("/", " ")
    words = f"{name} {name.replace('_', ' ')}"
    return next((reason for reason, pattern in _NAMES.items() if re.search(pattern, words)), None)


def describe_left_out_clouds(reasons: Mapping[str, str]) -> str:
    """Say which topics are not taken for a LiDAR's, and why; `reasons` are those of `why_no_lidar` by topic."""
    topics: dict[str, list[str]] = defaultdict(list)
    for topic, reason in reasons.items():
        topics[reason].append(topic)
    told = "; ".join(f"since {reason}: {', '.join(names)}" for reason, names in topics.items())
    return f"not taken for a LiDAR's, {told}"
